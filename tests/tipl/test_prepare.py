from __future__ import annotations

from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import weighttraj as wt
from tipl.errors import TrainError
from tipl.models.tipl.data import prepare
from weighttraj import writer
from weighttraj.errors import FormatError
from weighttraj.format.schema import Cadence, DatasetInfo, RunEntry
from weighttraj.store.catalog import write_dataset_info


def walk(n: int, size: int = 6, seed: int = 0) -> np.ndarray:
    steps = np.random.default_rng(seed).normal(size=(n, size))
    return np.cumsum(steps, axis=0).astype(np.float32)


def dataset(path: Path, *runs: tuple[str, np.ndarray, int]) -> Path:
    """A data set of runs, each a split, its weights and its cadence."""
    entries = []
    for i, (split, weights, every) in enumerate(runs):
        layout = wt.ParamLayout.of({"w": ((weights.shape[1],), "other", ("fixed",))})
        info = wt.RunInfo(run_id=f"r{i}", layout=layout, cadence=Cadence(every=every), block=8)
        with wt.RunWriter(path / f"runs/r{i}.zarr", info) as out:
            for t, row in enumerate(weights):
                out.append(row, num_timesteps=t)
        entries.append(RunEntry(id=f"r{i}", path=f"runs/r{i}.zarr", split=split))  # type: ignore[arg-type]
    write_dataset_info(path, DatasetInfo(id="toy-v1", runs=tuple(entries), status="complete"))
    return path


def test_each_run_has_its_own_basis(tmp_path: Path) -> None:
    data = dataset(
        tmp_path, ("train", walk(30), 64), ("validation", walk(45, seed=1), 64),
        ("test", walk(30, seed=2), 64), ("train", walk(20, seed=3), 64),
    )  # fmt: skip
    prepared = prepare(data, rank=3, window=5)
    assert [run.coefficients.shape for run in prepared.train] == [(30, 3), (20, 3)]
    for run in prepared.train:
        np.testing.assert_allclose(run.coefficients.T @ run.coefficients, np.eye(3), atol=1e-5)
    assert (prepared.every, prepared.longest) == (64, 30)
    assert prepared.checksums.keys() == {"r0", "r3"}
    # What comes after the last time embedding is left out.
    (held_out,) = prepared.validation
    assert held_out.coefficients.shape == (30, 3)


def test_a_data_set_without_the_split_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"one of \['test'\](.|\n)*'train'"):
        prepare(dataset(tmp_path, ("test", walk(30), 64)), rank=3, window=5)


def test_a_window_longer_than_the_runs_is_refused(tmp_path: Path) -> None:
    data = dataset(tmp_path, ("train", walk(7), 64), ("train", walk(9), 64))
    prepare(data, rank=3, window=9)
    with pytest.raises(TrainError, match=r"longer than every training run(.|\n)*at most 9"):
        prepare(data, rank=3, window=10)


@pytest.mark.parametrize(
    ("split", "size", "every", "message"),
    [
        ("train", 7, 64, r"different layouts(.|\n)*r0: 6 parameters(.|\n)*r1: 7 parameters"),
        ("train", 6, 32, r"different cadences(.|\n)*every 64(.|\n)*r1: 6 parameters, every 32"),
        ("validation", 7, 64, "different layouts"),
    ],
)
def test_runs_that_do_not_belong_together_are_refused(
    tmp_path: Path, split: str, size: int, every: int, message: str
) -> None:
    data = dataset(tmp_path, ("train", walk(30), 64), (split, walk(30, size), every))
    with pytest.raises(TrainError, match=message):
        prepare(data, rank=3, window=5)


def test_a_rank_above_the_weights_is_refused(tmp_path: Path) -> None:
    data = dataset(tmp_path, ("train", walk(30), 64))
    with pytest.raises(TrainError, match=r"run r0 has no such coefficients(.|\n)*1 to 6"):
        prepare(data, rank=7, window=5)


def test_a_rank_above_the_directions_of_a_run_is_refused(tmp_path: Path) -> None:
    flat = walk(30) * np.array([1, 1, 1, 0, 0, 0], np.float32)
    data = dataset(tmp_path, ("train", walk(30), 64), ("train", flat, 64))
    prepare(data, rank=3, window=5)
    with pytest.raises(TrainError, match=r"run r1 has no such(.|\n)*at most 3"):
        prepare(data, rank=4, window=5)


def test_a_run_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    broken = walk(30)
    broken[17, 2] = np.nan
    with mock.patch.object(writer, "check_finite", lambda _, row: row):  # it would refuse it
        data = dataset(tmp_path, ("train", walk(30), 64), ("train", broken, 64))
    with pytest.raises(TrainError, match=r"run r1 has no such(.|\n)*not finite"):
        prepare(data, rank=3, window=5)
