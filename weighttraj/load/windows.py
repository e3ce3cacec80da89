"""Windows of consecutive snapshots, and single snapshots, as torch ``Dataset``s."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Sequence
from functools import cached_property
from typing import Any, TypedDict

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.utils.data import Dataset, default_collate, get_worker_info

from weighttraj.errors import WindowError
from weighttraj.load.cache import CachedWeights
from weighttraj.remote.address import RemotePath
from weighttraj.run import Run

MAX_MAPS = 200
"""Runs that one data set keeps mapped: each takes a file handle, and processes may have 1024."""


class Item(TypedDict):
    """One item."""

    weights: Tensor
    """float32 (window, param) of a window; (param,) of a snapshot."""
    t: int
    """Snapshot of its last row; the rows are t - window + 1, ..., t."""
    run: str
    """Id of the run."""


class Batch(TypedDict):
    """Items that were put together."""

    weights: Tensor
    """float32 (batch, window, param) of windows; (batch, param) of snapshots."""
    t: Tensor
    """int64 (batch,)."""
    run: list[str]
    """Id of each item's run."""


class RunDataset(Dataset[Item]):
    """Base of the data sets below: pieces of runs, each inside one run and known by (run, t).

    Rows come from the cache, where a run is decoded when its first row is asked for; worker
    processes may be forked or spawned.
    """

    window: int
    """Snapshots in an item."""

    def __init__(self, runs: Sequence[Run], window: int, stride: int) -> None:
        _check(runs, window, stride)
        self.runs = list(runs)
        self.window = window
        self.stride = stride
        counts = [(len(run) - window) // stride + 1 for run in runs]
        run = np.repeat(np.arange(len(runs)), counts)
        t = np.concatenate([window - 1 + stride * np.arange(n) for n in counts])
        self.index = np.stack([run, t], axis=1)
        """int64 (item, 2): position of the run in ``runs``, and t."""
        self._ids = [run.id for run in runs]
        self._cached = [CachedWeights(run) for run in runs]
        for cached in self._cached:
            if isinstance(cached.run.path, RemotePath):
                cached.map()  # now: a forked worker could not read it
        self._maps: dict[int, np.ndarray] = {}

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of what the items are: equal data sets, also of copied or packed runs.

        Raises:
            DamageError: a run's digests are damaged.
        """
        runs = [(cached.run.id, cached.key) for cached in self._cached]
        what = [type(self).__name__, self.window, self.stride, runs]
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def batch(self, indices: Sequence[int]) -> Batch:
        """Some items as one batch, as torch's ``default_collate`` would make it, copied once.

        Raises:
            IndexError: there is no such item.
            CacheError: the cache's folder cannot be used.
            DamageError: a run is damaged.
        """
        views, t, run = self._find(indices)
        weights = _stack(views) if get_worker_info() is None else _stack_shared(views)
        return Batch(weights=weights, t=torch.from_numpy(t), run=run)

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, i: int) -> Item:
        """One item; raises as ``batch`` does."""
        run, t = self.index[i].tolist()
        return Item(weights=torch.from_numpy(self._view(run, t).copy()), t=t, run=self._ids[run])

    def __getitems__(self, indices: Sequence[int]) -> list[Item]:
        """Items of one batch, for torch's ``DataLoader``; faster than one by one."""
        views, t, run = self._find(indices)
        columns = zip(_stack(views).unbind(0), t.tolist(), run, strict=True)
        return [Item(weights=w, t=t, run=run) for w, t, run in columns]

    def _find(self, indices: Sequence[int]) -> tuple[list[np.ndarray], np.ndarray, list[str]]:
        """Rows, t and run id of some items."""
        index = self.index[np.asarray(indices)]
        views = [self._view(run, t) for run, t in index.tolist()]
        return views, index[:, 1].copy(), [self._ids[run] for run in index[:, 0].tolist()]

    def _view(self, run: int, t: int) -> np.ndarray:
        """Rows of the map itself. To write to them would end the process: copies go out."""
        return self._rows(run)[t - self.window + 1 : t + 1]

    def _rows(self, run: int) -> Float32[np.ndarray, "time param"]:
        rows = self._maps.get(run)
        if rows is None:
            if len(self._maps) >= MAX_MAPS:
                del self._maps[next(iter(self._maps))]
            rows = self._maps[run] = self._cached[run].map()
        return rows

    def __getstate__(self) -> dict[str, Any]:
        """What a spawned worker gets: where the rows are, not the rows."""
        return {**self.__dict__, "_maps": {}}


class WindowDataset(RunDataset):
    """All windows of K consecutive snapshots of some runs.

    Args:
        runs: runs of the same layout.
        window: snapshots in a window, K.
        stride: snapshots from one window's end to the next one's.

    Raises:
        WindowError: the runs differ in layout, or a run is shorter than a window.
    """

    def __init__(self, runs: Sequence[Run], window: int = 20, *, stride: int = 1) -> None:
        super().__init__(runs, window, stride)

    def __repr__(self) -> str:
        size = self.runs[0].layout.size
        return (
            f"<WindowDataset {len(self)} windows of ({self.window}, {size}), {len(self.runs)} runs>"
        )


class SnapshotDataset(RunDataset):
    """Single snapshots of some runs.

    Args:
        runs: runs of the same layout.
        stride: snapshots from one item to the next; the first is snapshot 0.

    Raises:
        WindowError: the runs differ in layout, or a run has no snapshots.
    """

    def __init__(self, runs: Sequence[Run], *, stride: int = 1) -> None:
        super().__init__(runs, 1, stride)

    def _view(self, run: int, t: int) -> np.ndarray:
        row: np.ndarray = self._rows(run)[t]
        return row

    def __repr__(self) -> str:
        size = self.runs[0].layout.size
        return f"<SnapshotDataset {len(self)} snapshots of ({size},), {len(self.runs)} runs>"


def _stack(views: list[np.ndarray]) -> Tensor:
    """Copies of some rows, put together. Numpy's memory comes in huge pages, torch's does not."""
    return torch.from_numpy(np.concatenate(views).reshape(len(views), *views[0].shape))


def _stack_shared(views: list[np.ndarray]) -> Tensor:
    """The same in a worker, right into the memory that it shares with the main process."""
    with warnings.catch_warnings():  # torch fears for the map, which here is only read
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        stacked: Tensor = default_collate([torch.from_numpy(view) for view in views])
        return stacked


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
                do="make one data set for each layout",
            )
        if len(run) < window:
            raise WindowError(
                "a run is shorter than a window",
                expected=f"at least {window} snapshots",
                got=len(run),
                where=run.path,
                do="choose a smaller window, or leave the run out",
            )
