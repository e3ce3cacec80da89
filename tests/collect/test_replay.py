"""A stored run can be shown to come from the training it names."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import weighttraj as wt
from weighttraj.collect import replay
from weighttraj.errors import CollectError
from weighttraj.store.catalog import read_dataset_info, write_dataset_info


@pytest.mark.parametrize(("n", "seed"), [(1, None), (6, 2), (49, 1), (1000, 0)])
def test_an_honest_run_repeats(small_dataset: Path, n: int, seed: int | None) -> None:
    assert replay(small_dataset, n, seed=seed) == []


def test_another_training_is_found_out(small_dataset: Path, tmp_path: Path) -> None:
    """The recipe says a learning rate that the run was not trained with."""
    path = tmp_path / "dataset"
    shutil.copytree(small_dataset, path)
    info = read_dataset_info(path)
    ppo = {**info.recipe["ppo"], "learning_rate": 1e-3}
    write_dataset_info(path, replace(info, recipe={**info.recipe, "ppo": ppo}))
    (problem,) = replay(path, 9)
    assert "snapshot 1 of 9 is the first that differs" in problem
    assert "in the same circumstances" in problem
    torch.set_num_threads(2)  # the run is trained again with its own number
    try:
        assert "in the same circumstances" in replay(path, 9)[0]
    finally:
        torch.set_num_threads(1)


def test_no_snapshots_are_refused(small_dataset: Path) -> None:
    with pytest.raises(CollectError, match="at least 1"):
        replay(small_dataset, -5)


def test_an_unknown_seed_is_refused(small_dataset: Path) -> None:
    with pytest.raises(CollectError, match=r"seeds \[0, 1, 2, 3\]"):
        replay(small_dataset, 5, seed=9)
    assert wt.verify(small_dataset) == []


@pytest.mark.parametrize("threads", [-1, 2**31])
def test_threads_that_no_machine_has_are_refused(
    threads: int, small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", asked.append)
    run = wt.open(small_dataset)[0]
    info = replace(run.info, provenance=replace(run.info.provenance, threads=threads))
    monkeypatch.setattr(wt.Run, "info", info)
    with pytest.raises(CollectError, match="so many threads"):
        wt.collect.replay(small_dataset, 1)
    assert asked == []
