from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import weighttraj as wt
from weighttraj.errors import WindowError
from weighttraj.load import SeededSampler, WindowDataset


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


@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_worker_processes_read_the_same(small_dataset: Path, context: str) -> None:
    data = wt.open(small_dataset).split("train").to_torch(window=20, stride=7)
    data[0]
    loader = DataLoader(data, batch_size=4, num_workers=2, multiprocessing_context=context)
    batches = list(loader)
    weights = torch.cat([b["weights"] for b in batches])
    assert weights.shape == (len(data), 20, 122)
    assert torch.equal(weights, torch.stack([data[i]["weights"] for i in range(len(data))]))


def test_the_order_is_a_function_of_seed_and_epoch() -> None:
    sampler = SeededSampler(50, seed=1)
    first = list(sampler)
    assert sorted(first) == list(range(50))
    assert first == list(SeededSampler(50, seed=1))
    assert first != list(SeededSampler(50, seed=2))
    sampler.epoch = 1
    assert first != list(sampler)
    assert len(sampler) == 50


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
    with pytest.raises(WindowError, match="one WindowDataset for each layout"):
        WindowDataset(runs, window=1)
