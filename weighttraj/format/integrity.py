"""Is a run or data set whole? Reads every byte and says what is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from weighttraj.errors import WeightTrajError
from weighttraj.format.reader import Dataset, Run, StoredArray, open_dataset, open_run

MONOTONE = ("index/iteration", "index/gradient_step", "index/num_timesteps")


def verify(path: str | Path) -> list[str]:
    """Problems of the data set or run at a path; an empty list means that it is whole.

    Every committed chunk is decoded, its crc32c checked, each snapshot compared with its digest;
    counters must not go back and weights must be finite.

    Raises:
        FileNotFoundError: there is neither a data set nor a run at the path.
    """
    path = Path(path)
    try:
        if (path / "dataset.json").is_file():
            return verify_dataset(open_dataset(path))
        return verify_run(open_run(path))
    except WeightTrajError as error:
        return [str(error)]


def verify_dataset(dataset: Dataset) -> list[str]:
    """Problems of all runs."""
    return [problem for run in dataset for problem in verify_run(run)]


def verify_run(run: Run) -> list[str]:
    """Problems of one run."""
    problems = []
    for name, array in run.arrays.items():
        try:
            problems += _verify_array(name, array, where=str(run.path))
        except WeightTrajError as error:
            problems.append(str(error))
    return problems


def _verify_array(name: str, array: StoredArray, *, where: str) -> list[str]:
    problems = []
    last = None
    for start in range(0, len(array), 64):
        rows = array[start : start + 64]
        if name == "policy/weights" and not np.isfinite(rows).all():
            problems.append(f"{where}, {name}: not finite between rows {start} and {start + 64}")
        if name in MONOTONE:
            steps = np.diff(rows, prepend=rows[:1] if last is None else last)
            if (steps < 0).any():
                problems.append(f"{where}, {name}: goes back at row {start + np.argmax(steps < 0)}")
            last = rows[-1:]
    return problems
