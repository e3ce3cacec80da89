from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, default_collate

import weighttraj as wt
from weighttraj.errors import WindowError
from weighttraj.load import SnapshotDataset, WindowDataset, windows


def test_a_window_is_a_slice_of_its_run(small_dataset: Path) -> None:
    data = wt.open(small_dataset).split("train").to_torch(window=5, stride=3)
    assert len(data) == 2 * ((49 - 5) // 3 + 1)
    runs = {run.id: run for run in data.runs}
    for i in (0, 7, len(data) - 1):
        window = data[i]
        rows = runs[window["run"]].weights[window["t"] - 4 : window["t"] + 1]
        assert window["weights"].dtype == torch.float32
        assert np.array_equal(window["weights"].numpy(), rows)
    assert data[0]["t"] == 4
    assert repr(data) == "<WindowDataset 30 windows of (5, 122), 2 runs>"


def test_windows_stay_inside_their_run(small_dataset: Path) -> None:
    data = wt.open(small_dataset).to_torch(window=49)
    assert [(w["run"], w["t"]) for w in (data[i] for i in range(len(data)))] == [
        (f"seed000{i}", 48) for i in range(4)
    ]


def test_a_snapshot_is_a_row_of_its_run(small_dataset: Path) -> None:
    data = wt.open(small_dataset).split("test").to_torch_snapshots(stride=10)
    assert [(item["run"], item["t"]) for item in (data[i] for i in range(len(data)))] == [
        (run, t) for run in ("seed0002", "seed0003") for t in (0, 10, 20, 30, 40)
    ]
    assert data[-1]["weights"].shape == (122,)
    assert np.array_equal(data[-1]["weights"].numpy(), data.runs[1].weights[40])
    assert repr(data) == "<SnapshotDataset 10 snapshots of (122,), 2 runs>"
    assert len(wt.open(small_dataset).to_torch_snapshots()) == 4 * 49


@pytest.mark.parametrize("kind", ["windows", "snapshots"])
def test_a_batch_is_what_torch_would_make_of_its_items(small_dataset: Path, kind: str) -> None:
    dataset = wt.open(small_dataset)
    data = dataset.to_torch(window=6) if kind == "windows" else dataset.to_torch_snapshots()
    indices = [0, len(data) - 1, 50, 3, 50]
    expected = default_collate([data[i] for i in indices])
    shape = (5, 6, 122) if kind == "windows" else (5, 122)
    for batch in (data.batch(indices), default_collate(data.__getitems__(indices))):
        assert batch["weights"].shape == shape
        assert torch.equal(batch["weights"], expected["weights"])
        assert torch.equal(batch["t"], expected["t"])
        assert (batch["t"].dtype, batch["run"]) == (torch.int64, expected["run"])


def test_what_is_given_out_may_be_written_to(small_dataset: Path) -> None:
    data = wt.open(small_dataset).to_torch(window=5)
    before = data.runs[0].weights[:5]
    data[0]["weights"].zero_()
    data.__getitems__([0])[0]["weights"].zero_()
    data.batch([0])["weights"].zero_()
    assert np.array_equal(data[0]["weights"].numpy(), before)


def test_nothing_is_decoded_before_it_is_asked_for(small_dataset: Path, cache: Path) -> None:
    data = wt.open(small_dataset).to_torch(window=20)
    assert not cache.exists()
    data[0]
    assert len(list(cache.glob("*.npy"))) == 1


@pytest.mark.parametrize(
    ("made", "context"),
    [
        ("before", "fork"),
        ("before", "spawn"),
        ("by the workers", "fork"),
        ("by the workers", "forkserver"),
        pytest.param("before", "forkserver", marks=pytest.mark.long),
        pytest.param("by the workers", "spawn", marks=pytest.mark.long),
    ],
)
def test_worker_processes_read_the_same(small_dataset: Path, made: str, context: str) -> None:
    data = wt.open(small_dataset).split("train").to_torch(window=20, stride=7)
    if made == "before":
        data.batch(range(len(data)))
    loader = DataLoader(data, batch_size=4, num_workers=2, multiprocessing_context=context)
    batches = list(loader)
    weights = torch.cat([b["weights"] for b in batches])
    assert weights.shape == (len(data), 20, 122)
    assert torch.equal(weights, data.batch(range(len(data)))["weights"])


def test_it_is_pickled_without_its_rows(wide_run: wt.Run) -> None:
    data = WindowDataset([wide_run], window=20)
    first = data[0]["weights"]
    text = pickle.dumps(data)
    assert len(text) < 60_000
    assert torch.equal(pickle.loads(text)[0]["weights"], first)  # noqa: S301


def test_few_runs_are_mapped_at_once(small_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "MAX_MAPS", 2)
    data = wt.open(small_dataset).to_torch(window=20)
    order = np.random.default_rng(0).permutation(len(data)).tolist()
    weights = data.batch(order)["weights"]
    assert len(data._maps) == 2
    for i, window in zip(order, weights, strict=True):
        run, t = data.index[i]
        assert np.array_equal(window.numpy(), data.runs[run].weights[t - 19 : t + 1])


def test_the_fingerprint_tells_data_sets_apart(small_dataset: Path) -> None:
    train = wt.open(small_dataset).split("train")
    same = [train.to_torch(window=5), wt.open(small_dataset).split("train").to_torch(window=5)]
    others = [
        train.to_torch(window=6),
        train.to_torch(window=5, stride=2),
        train.to_torch_snapshots(),
        train.to_torch(window=1),
        wt.open(small_dataset).split("test").to_torch(window=5),
        wt.open(small_dataset).to_torch(window=5),
        WindowDataset(train.runs[::-1], window=5),
    ]
    assert len({data.fingerprint for data in same}) == 1
    assert len({data.fingerprint for data in [*same, *others]}) == 1 + len(others)


@pytest.mark.parametrize(
    ("window", "stride", "message"),
    [(50, 1, "shorter than a window"), (0, 1, "no windows"), (5, 0, "no windows")],
)
def test_impossible_windows_are_refused(
    small_dataset: Path, window: int, stride: int, message: str
) -> None:
    with pytest.raises(WindowError, match=message):
        wt.open(small_dataset).to_torch(window=window, stride=stride)


def test_runs_of_different_layouts_do_not_mix(small_dataset: Path, tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    with wt.RunWriter(tmp_path / "r.zarr", wt.RunInfo(run_id="r", layout=layout)) as writer:
        writer.append(np.zeros(3, np.float32), num_timesteps=0)
    runs = [wt.open(small_dataset).runs[0], wt.open_run(tmp_path / "r.zarr")]
    with pytest.raises(WindowError, match="one data set for each layout"):
        WindowDataset(runs, window=1)


def test_a_run_without_snapshots_has_no_items(tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    wt.RunWriter(tmp_path / "r.zarr", wt.RunInfo(run_id="r", layout=layout)).close("crashed")
    with pytest.raises(WindowError, match="at least 1 snapshots\n  got: 0"):
        SnapshotDataset([wt.open_run(tmp_path / "r.zarr")])
