"""Windows of consecutive snapshots as a torch ``Dataset``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypedDict

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from weighttraj.errors import WindowError
from weighttraj.format import Run


class Window(TypedDict):
    """One window."""

    weights: Tensor
    """float32 (window, param)."""
    t: int
    """Snapshot of its last row; the rows are t - window + 1, ..., t."""
    run: str
    """Id of the run."""


class WindowDataset(Dataset[Window]):
    """All windows of K consecutive snapshots of some runs.

    Every window lies inside one run, and is known by (run, t). Each process decodes a run when it
    first needs it and keeps it; worker processes may be forked or spawned.

    Args:
        runs: runs of the same layout.
        window: snapshots in a window, K.
        stride: snapshots from one window's end to the next one's.

    Raises:
        WindowError: the runs differ in layout, or a run is shorter than a window.
    """

    def __init__(self, runs: Sequence[Run], window: int = 20, *, stride: int = 1) -> None:
        _check(runs, window, stride)
        self.runs = list(runs)
        self.window = window
        counts = [(len(run) - window) // stride + 1 for run in runs]
        run = np.repeat(np.arange(len(runs)), counts)
        t = np.concatenate([window - 1 + stride * np.arange(n) for n in counts])
        self.index = np.stack([run, t], axis=1)
        """int64 (window, 2): position of the run in ``runs``, and t."""
        self._decoded: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, i: int) -> Window:
        run, t = (int(x) for x in self.index[i])
        if run not in self._decoded:
            self._decoded[run] = self.runs[run].weights[:]
        rows = self._decoded[run][t - self.window + 1 : t + 1]
        return Window(weights=torch.from_numpy(rows.copy()), t=t, run=self.runs[run].id)

    def __getstate__(self) -> dict[str, Any]:
        """What a spawned worker gets: the decoded runs stay behind."""
        return {**self.__dict__, "_decoded": {}}

    def __repr__(self) -> str:
        size = self.runs[0].layout.size
        return (
            f"<WindowDataset {len(self)} windows of ({self.window}, {size}), {len(self.runs)} runs>"
        )


class SeededSampler(Sampler[int]):
    """A shuffled order that is a function of (seed, epoch) alone.

    Args:
        n: length of the data set.
        seed: seed of the order.

    Set ``epoch`` before each epoch.
    """

    def __init__(self, n: int, *, seed: int = 0) -> None:
        self.n, self.seed, self.epoch = n, seed, 0

    def __iter__(self) -> Iterator[int]:
        yield from np.random.default_rng([self.seed, self.epoch]).permutation(self.n).tolist()

    def __len__(self) -> int:
        return self.n


def _check(runs: Sequence[Run], window: int, stride: int) -> None:
    if not runs or window < 1 or stride < 1:
        raise WindowError(
            "no windows can be made of this",
            expected="at least one run, window and stride at least 1",
            got=f"{len(runs)} runs, window {window}, stride {stride}",
        )
    for run in runs:
        if run.layout != runs[0].layout:
            raise WindowError(
                "the runs have different layouts, so their windows do not fit into one batch",
                expected=f"the layout of {runs[0].id}, {runs[0].layout.size} parameters",
                got=f"{run.layout.size} parameters",
                where=run.path,
                do="make one WindowDataset for each layout",
            )
        if len(run) < window:
            raise WindowError(
                "a run is shorter than a window",
                expected=f"at least {window} snapshots",
                got=len(run),
                where=run.path,
                do="choose a smaller window, or leave the run out",
            )
