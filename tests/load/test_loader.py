from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import weighttraj as wt
from weighttraj.errors import DamageError
from weighttraj.load import LoaderError, ResumableLoader, WindowDataset, clear_cache
from weighttraj.load.loader import epoch_order

ROOT = Path(__file__).parents[2]


@pytest.fixture
def data(small_dataset: Path) -> WindowDataset:
    """60 windows."""
    return wt.open(small_dataset).split("train").to_torch(window=20)


def places(batches: Iterable[Any]) -> list[list[tuple[str, int]]]:
    """(run, t) of each item of each batch."""
    return [list(zip(batch["run"], batch["t"].tolist(), strict=True)) for batch in batches]


def three_epochs(data: WindowDataset) -> list[list[tuple[str, int]]]:
    loader = ResumableLoader(data, 16, seed=5)
    return [batch for _ in range(3) for batch in places(loader)]


def test_the_order_is_a_function_of_seed_and_epoch() -> None:
    first = epoch_order(50, 1, 0).tolist()
    assert sorted(first) == list(range(50))
    assert first == epoch_order(50, 1, 0).tolist()
    assert first != epoch_order(50, 1, 1).tolist()
    assert first != epoch_order(50, 2, 0).tolist()


def test_the_order_stays_with_the_years() -> None:
    assert epoch_order(10, 0, 0).tolist() == [3, 2, 1, 8, 6, 0, 7, 4, 5, 9]


def test_an_epoch_has_each_item_once(data: WindowDataset) -> None:
    loader = ResumableLoader(data, 16, seed=1)
    assert len(loader) == 4
    first, second = places(loader), places(loader)
    assert [len(batch) for batch in first] == [16, 16, 16, 12]
    everything = sorted((data.runs[run].id, int(t)) for run, t in data.index)
    for epoch in (first, second):
        assert sorted(place for batch in epoch for place in batch) == everything
    assert first != second
    assert loader.epoch == 2


def test_batches_are_what_their_places_say(data: WindowDataset) -> None:
    runs = {run.id: run for run in data.runs}
    for batch in ResumableLoader(data, 16):
        for window, t, run in zip(batch["weights"], batch["t"], batch["run"], strict=True):
            assert np.array_equal(window.numpy(), runs[run].weights[int(t) - 19 : int(t) + 1])


def test_without_shuffling_the_order_is_the_data_sets_own(data: WindowDataset) -> None:
    loader = ResumableLoader(data, 16, shuffle=False, drop_last=True)
    index = [(data.runs[run].id, int(t)) for run, t in data.index]
    for _ in range(2):
        assert places(loader) == [index[:16], index[16:32], index[32:48]]


def test_an_iteration_goes_on_where_the_last_one_stopped(data: WindowDataset) -> None:
    whole, loader = three_epochs(data), ResumableLoader(data, 16, seed=5)
    seen: list[Any] = []
    for stop in (1, 2, 9):
        for n, batch in enumerate(loader, start=1):
            seen += places([batch])
            if n == stop:
                break
    assert seen == whole[:4]
    assert places(loader) == whole[4:8]


@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize("stop", [1, 3, 4, 6])
def test_what_workers_hold_ready_is_not_lost(
    data: WindowDataset, stop: int, persistent: bool
) -> None:
    options: dict[str, Any] = {
        "num_workers": 2,
        "prefetch_factor": 4,
        "persistent_workers": persistent,
    }
    whole, loader = three_epochs(data), ResumableLoader(data, 16, seed=5, **options)
    seen: list[Any] = []
    while len(seen) < stop:
        for batch in loader:
            seen += places([batch])
            if len(seen) == stop:
                break
    state = json.loads(json.dumps(loader.state_dict()))
    assert (state["epoch"], state["batch"]) == divmod(stop, 4) if stop != 4 else (0, 4)
    assert seen == whole[:stop]
    fresh = ResumableLoader(data, 16, **options)
    fresh.load_state_dict(state)
    for go_on in (fresh, loader):
        rest = places(go_on) + places(go_on)
        assert rest == whole[stop : stop + len(rest)]
        assert len(rest) >= 4


RESTARTED = """
import json, sys
import weighttraj as wt
from weighttraj.load import ResumableLoader

if __name__ == "__main__":
    data = wt.open(sys.argv[1]).split("train").to_torch(window=20)
    context, state, stop = sys.argv[2], sys.argv[3], 5
    number = {"none": 0, "fork": 2}.get(context, 1)  # others import torch in each worker
    workers = dict(num_workers=number, multiprocessing_context=context) if number else {}
    loader = ResumableLoader(data, 16, **workers)
    loader.load_state_dict(json.loads(state))
    while stop:
        for batch in loader:
            print(json.dumps(list(zip(batch["run"], batch["t"].tolist()))))
            stop -= 1
            if not stop:
                break
"""


@pytest.mark.parametrize(
    "context", ["none", "fork", "spawn", pytest.param("forkserver", marks=pytest.mark.long)]
)
def test_a_new_process_gets_exactly_what_is_left(
    data: WindowDataset, small_dataset: Path, tmp_path: Path, context: str
) -> None:
    script = tmp_path / "train.py"  # spawned workers import it
    script.write_text(RESTARTED)
    loader = ResumableLoader(data, 16, seed=5)
    batches = iter(loader)
    for _ in range(3):
        next(batches)
    state = json.dumps(loader.state_dict())
    command = [sys.executable, str(script), str(small_dataset), context, state]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    seen = [[tuple(place) for place in json.loads(line)] for line in done.stdout.splitlines()]
    assert seen == three_epochs(data)[3:8]


def test_the_end_of_an_epoch_is_a_place_of_its_own(data: WindowDataset) -> None:
    loader = ResumableLoader(data, 16, seed=5)
    batches = iter(loader)
    for _ in range(4):
        next(batches)
    state = loader.state_dict()
    fresh = ResumableLoader(data, 16)
    fresh.load_state_dict(state)
    assert (list(fresh), fresh.epoch) == ([], 1)
    assert places(fresh) == three_epochs(data)[4:8]


def test_torchs_random_state_is_left_alone(data: WindowDataset) -> None:
    before = torch.get_rng_state()
    list(ResumableLoader(data, 16))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"batch_size": 8}, "batch_size"),
        ({"shuffle": False}, "shuffle"),
        ({"drop_last": True}, "drop_last"),
        ({"window": 19}, "items"),
        ({"split": "test"}, "data"),
    ],
)
def test_a_state_of_something_else_is_refused(
    data: WindowDataset, small_dataset: Path, change: dict[str, Any], named: str
) -> None:
    state = ResumableLoader(data, 16).state_dict()
    split, window = change.pop("split", "train"), change.pop("window", 20)
    other = wt.open(small_dataset).split(split).to_torch(window=window)
    loader = ResumableLoader(other, **{"batch_size": 16, **change})
    with pytest.raises(LoaderError, match=f"(?s)over other data.*'{named}'"):
        loader.load_state_dict(state)
    assert loader.state_dict()["batch"] == 0


@pytest.mark.parametrize(
    "harm", [{"batch": -1}, {"batch": "2"}, {"epoch": 1.5}, {"data": None}, {"seed": True}]
)
def test_what_is_no_state_is_refused(data: WindowDataset, harm: dict[str, Any]) -> None:
    loader = ResumableLoader(data, 16)
    with pytest.raises(LoaderError, match="no state of a ResumableLoader"):
        loader.load_state_dict({**loader.state_dict(), **harm})
    with pytest.raises(LoaderError, match="no state of a ResumableLoader"):
        loader.load_state_dict({})


@pytest.mark.parametrize("options", [{}, {"num_workers": 2, "persistent_workers": True}])
def test_an_iteration_that_was_overtaken_says_so(
    data: WindowDataset, options: dict[str, Any]
) -> None:
    loader = ResumableLoader(data, 16, seed=5, **options)
    old = iter(loader)
    next(old)
    new = iter(loader)
    second = places([next(new)])
    with pytest.raises(LoaderError, match="another was begun"):
        next(old)
    assert second + places(new) == three_epochs(data)[1:4]


@pytest.mark.parametrize(("batch_size", "seed"), [(0, 0), (4, -1)])
def test_impossible_loaders_are_refused(data: WindowDataset, batch_size: int, seed: int) -> None:
    with pytest.raises(LoaderError, match="no loader can be made"):
        ResumableLoader(data, batch_size, seed=seed)


def test_damage_that_a_worker_meets_is_said_by_its_name(wide_run: wt.Run, tmp_path: Path) -> None:
    shutil.copytree(wide_run.path, tmp_path / "r.zarr")
    next((tmp_path / "r.zarr/policy/weights/c").glob("*/0")).unlink()
    loader = ResumableLoader(WindowDataset([wt.open_run(tmp_path / "r.zarr")]), 4, num_workers=1)
    with pytest.raises(DamageError, match="committed data is missing"):
        next(iter(loader))


@pytest.mark.parametrize("workers", [0, 2])
def test_the_cache_may_be_cleared_amid_an_epoch(data: WindowDataset, workers: int) -> None:
    loader = ResumableLoader(data, 16, seed=5, num_workers=workers)
    batches = iter(loader)
    seen = places([next(batches)])
    assert clear_cache() > 0
    assert seen + places(batches) == three_epochs(data)[:4]
