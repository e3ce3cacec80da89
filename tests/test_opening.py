"""Finding runs and snapshots in a data set."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from weighttraj.errors import DamageError, WeightTrajError


def ids(dataset: wt.Dataset) -> list[str]:
    return [run.id for run in dataset]


def test_runs_are_selected_by_what_they_are(small_dataset: Path) -> None:
    ds = wt.open(small_dataset)
    assert ids(ds.select(seed=2)) == ["seed0002"]
    assert ids(ds.select(seed=range(1, 3))) == ["seed0001", "seed0002"]
    assert ids(ds.select(env="InvertedPendulum-v4", algorithm="PPO", split="train")) == [
        "seed0000",
        "seed0001",
    ]
    assert ids(ds.select(n_epochs=2, batch_size=lambda size: size > 8)) == ids(ds)
    assert ids(ds.select(gamma=0.5)) == []
    best = max(run.final_return for run in ds)
    assert [r.final_return for r in ds.select(final_return=lambda value: value >= best)] == [best]
    with pytest.raises(KeyError, match=r"no \['gama'\].*'gamma'"):
        ds.select(gama=0.5)


def test_a_run_without_a_property_does_not_fit(small_dataset: Path, tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    with wt.RunWriter(tmp_path / "a.zarr", wt.RunInfo(run_id="a", layout=layout)) as writer:
        writer.append(np.ones(3, np.float32), num_timesteps=0)
    small = wt.open(small_dataset)
    mixed = wt.Dataset(small.path, small.info, [*small.runs, wt.open_run(tmp_path / "a.zarr")])
    assert len(mixed.select(n_epochs=lambda value: value > 0)) == len(small)
    assert len(mixed.select(env=lambda name: name.startswith("Inv"))) == len(small)
    assert [run.id for run in mixed.select(env=None)] == ["a"]


def test_only_what_is_asked_for_is_read(small_dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "small"
    shutil.copytree(small_dataset, path)
    (path / "runs/seed0003.zarr.zip").write_bytes(b"damaged")
    for wanted in (
        {"id": "seed0001"},
        {"seed": 1},
        {"seed": range(3), "final_return": np.isfinite},
    ):
        assert "seed0001" in ids(wt.open(path).select(**wanted))
    with pytest.raises(DamageError):
        wt.open(path).select(status="complete")


def test_rows_are_read_as_numpy_would(small_dataset: Path) -> None:
    weights = wt.open(small_dataset).runs[0].weights
    all_of_them = weights[:]
    for key in (..., [], [3, -1], np.arange(49) % 2 == 0, slice(-5, None, 2), 7, np.int32(7)):
        np.testing.assert_array_equal(weights[key], all_of_them[key])
    for key in (slice(None, None, -1), [[1]], 49, [1.5], np.ones((49, 2), bool)):
        with pytest.raises(IndexError, match="where") as caught:
            weights[key]
        assert isinstance(caught.value, WeightTrajError)


def test_dots_stand_for_what_is_not_named(small_dataset: Path) -> None:
    run = wt.open(small_dataset).runs[0]
    for name in ("probe/observations", "policy/weights", "index/num_timesteps"):
        array = run[name]
        whole = array[:]
        for key in ((), (...,), (..., 1), (1, ..., 1), (..., slice(1, 3)), (..., [0, 1])):
            if sum(k is not ... for k in key) <= whole.ndim:
                np.testing.assert_array_equal(array[key], whole[key])
        np.testing.assert_array_equal(array[..., *(1,) * whole.ndim], whole[(1,) * whole.ndim])


def test_runs_are_found_by_id(small_dataset: Path) -> None:
    ds = wt.open(small_dataset)
    assert ds["seed0002"].info.seed == 2
    with pytest.raises(KeyError, match="seed0000"):
        ds["seed9"]


def test_the_snapshot_at_an_environment_step(small_dataset: Path) -> None:
    run = wt.open(small_dataset).runs[0]
    assert run.at(num_timesteps=0) == 0
    assert run.at(num_timesteps=63) == 0
    last_of_first_iteration = np.flatnonzero(run.num_timesteps == 64)[-1]
    assert run.at(num_timesteps=64) == run.at(num_timesteps=127) == last_of_first_iteration
    assert run.at(num_timesteps=10**9) == len(run) - 1
    with pytest.raises(IndexError, match="no snapshot at or before step -1"):
        run.at(num_timesteps=-1)


def test_runs_are_opened_when_they_are_used(small_dataset: Path, tmp_path: Path) -> None:
    """So that a data set of many runs opens in no time, and one bad run does not hide the rest."""
    for file in small_dataset.rglob("*"):
        if file.is_file():
            copy = tmp_path / file.relative_to(small_dataset)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(file.read_bytes())
    (tmp_path / "runs/seed0000.zarr.zip").write_bytes(b"no zip file")
    ds = wt.open(tmp_path)
    assert ids(ds) == ["seed0000", "seed0001", "seed0002", "seed0003"]
    assert len(ds["seed0001"]) == 49
    with pytest.raises(DamageError, match="no whole zip file"):
        len(ds["seed0000"])


def test_a_run_opens_as_a_data_set_of_one_run(small_dataset: Path, tmp_path: Path) -> None:
    packed = Path(shutil.copy(small_dataset / "runs/seed0000.zarr.zip", tmp_path / "r.zarr.zip"))
    for path in (packed, tmp_path / "r.zarr", f"file://{packed}"):
        found = wt.open(path)
        assert [run.id for run in found] == ["seed0000"]
        assert (found.info.id, found.info.status) == ("seed0000", "complete")
        assert found.runs[0].weights.shape == (49, 122)


def test_a_folder_that_holds_a_data_set_in_data_opens(small_dataset: Path, tmp_path: Path) -> None:
    shutil.copytree(small_dataset, tmp_path / "mine/data")
    assert wt.open(tmp_path / "mine").path == tmp_path / "mine/data"
    assert len(wt.open(tmp_path / "mine")) == 4


@pytest.mark.parametrize("path", ["", ".", "/"])
def test_a_folder_without_a_name_is_no_run(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match="no run at"):
        wt.open_run(path)
