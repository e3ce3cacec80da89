"""What an item of a torch data set holds beside weights."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, default_collate

import weighttraj as wt
from weighttraj.errors import WindowError
from weighttraj.load import ResumableLoader

FIELDS = ["weights", "mean_return", "returns", "obs_norm", "num_timesteps", "train/approx_kl"]


@pytest.fixture(scope="module")
def dataset() -> wt.Dataset:
    return wt.open("hopper-v4-ppo-16x16-v1", runs=["seed0000", "seed0040"])


def test_fields_of_a_snapshot_are_rows_of_the_run(dataset: wt.Dataset) -> None:
    data = dataset.to_torch_snapshots(fields=FIELDS)
    run, item = dataset["seed0040"], data[976 + 40]
    assert (item["run"], item["t"]) == ("seed0040", 40)
    assert np.array_equal(item["weights"].numpy(), run.weights[40])
    assert item["mean_return"].item() == np.float32(run.mean_return(deterministic=True)[40])
    assert np.array_equal(item["returns"].numpy(), run.returns[40].astype("f4"))
    assert np.array_equal(item["obs_norm/mean"].numpy(), run["obs_norm/mean"][40].astype("f4"))
    assert np.array_equal(item["obs_norm/var"].numpy(), run["obs_norm/var"][40].astype("f4"))
    assert item["num_timesteps"].item() == run.num_timesteps[40]
    assert item["num_timesteps"].dtype == torch.int64
    assert item["train/approx_kl"].shape == ()


def test_fields_of_a_window_are_rows_of_the_run(dataset: wt.Dataset) -> None:
    data = dataset.to_torch(window=5, fields=["phase", "obs_norm/mean"])
    item = data[10]
    assert set(item) == {"phase", "obs_norm/mean", "t", "run"}
    assert item["phase"].tolist() == dataset[0].phase[10:15].tolist()
    assert np.array_equal(
        item["obs_norm/mean"].numpy(), dataset[0]["obs_norm/mean"][10:15].astype("f4")
    )


@pytest.mark.parametrize("window", [None, 4])
def test_a_batch_is_what_torch_would_make_of_its_items(
    dataset: wt.Dataset, window: int | None
) -> None:
    data = (
        dataset.to_torch_snapshots(fields=FIELDS)
        if window is None
        else dataset.to_torch(window, fields=FIELDS)
    )
    indices = [0, 1000, 40, len(data) - 1]
    expected = default_collate([data[i] for i in indices])
    loaded = next(iter(DataLoader(data, sampler=indices, batch_size=4, num_workers=1)))
    for batch in (data.batch(indices), default_collate(data.__getitems__(indices)), loaded):
        assert set(batch) == set(expected)
        for name in set(expected) - {"run"}:
            assert torch.equal(batch[name].nan_to_num(-1.5), expected[name].nan_to_num(-1.5)), name
        assert batch["run"] == expected["run"]


def test_evaluated_items_alone_have_a_mean_return(dataset: wt.Dataset) -> None:
    data = dataset.to_torch_snapshots(fields=["weights", "mean_return"], evaluated=True)
    expected = sum(int(np.isfinite(run.mean_return()).sum()) for run in dataset)
    assert len(data) == expected < 2 * 976
    batch = next(iter(ResumableLoader(data, batch_size=len(data))))
    assert torch.isfinite(batch["mean_return"]).all()


def test_a_process_that_is_spawned_gets_no_rows(dataset: wt.Dataset) -> None:
    data = dataset.to_torch_snapshots(fields=FIELDS)
    expected = data[3]
    again = pickle.loads(pickle.dumps(data))  # noqa: S301
    assert torch.equal(again[3]["obs_norm/mean"], expected["obs_norm/mean"])
    assert len(pickle.dumps(data)) < 1_000_000


def test_other_fields_are_another_data_set(dataset: wt.Dataset) -> None:
    plain, more = dataset.to_torch(4), dataset.to_torch(4, fields=["weights", "phase"])
    assert plain.fingerprint != more.fingerprint
    assert plain.fingerprint == dataset.to_torch(4, fields=["weights"]).fingerprint


@pytest.mark.parametrize(
    ("fields", "missing"),
    [(["no_such"], "no_such"), (["probe/observations"], "probe/observations"), (["a/b"], "a/b")],
)
def test_a_field_that_a_run_lacks_is_named(
    dataset: wt.Dataset, fields: list[str], missing: str
) -> None:
    with pytest.raises(WindowError, match=missing) as error:
        dataset.to_torch(fields=fields)
    assert "obs_norm/mean" in str(error.value)


def test_runs_without_returns_have_no_mean_return(wide_run: wt.Run) -> None:
    one = wt.open(wide_run.path)
    with pytest.raises(WindowError, match="weighttraj returns"):
        one.to_torch(fields=["mean_return"])
    with pytest.raises(WindowError, match="weighttraj returns"):
        one.to_torch(4, evaluated=True)
