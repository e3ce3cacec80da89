"""Windows of consecutive snapshots, and single snapshots, as torch ``Dataset``s."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NotRequired, TypedDict, cast

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.utils.data import Dataset, default_collate, get_worker_info

from weighttraj.errors import WindowError
from weighttraj.load.cache import CachedWeights
from weighttraj.load.fields import WEIGHTS, expand, mean_returns, values
from weighttraj.remote.address import RemotePath
from weighttraj.run import Run

MAX_MAPS = 200
"""Runs that one data set keeps mapped: each takes a file handle, and processes may have 1024."""


class Item(TypedDict):
    """One item. It also has one tensor for each other field that was asked for."""

    weights: NotRequired[Tensor]
    """float32 (window, param) of a window; (param,) of a snapshot."""
    t: int
    """Snapshot of its last row; the rows are t - window + 1, ..., t."""
    run: str
    """Id of the run."""


class Batch(TypedDict):
    """Items that were put together, with one tensor for each other field that was asked for."""

    weights: NotRequired[Tensor]
    """float32 (batch, window, param) of windows; (batch, param) of snapshots."""
    t: Tensor
    """int64 (batch,)."""
    run: list[str]
    """Id of each item's run."""


class RunDataset(Dataset[Item]):
    """Base of the data sets below: pieces of runs, each inside one run and known by (run, t).

    Weights come from the cache, where a run is decoded when its first row is asked for; worker
    processes may be forked or spawned. Other fields are held in memory.
    """

    window: int
    """Snapshots in an item."""

    def __init__(
        self,
        runs: Sequence[Run],
        window: int,
        stride: int,
        fields: Sequence[str] = ("weights",),
        evaluated: bool = False,
    ) -> None:
        _check(runs, window, stride)
        self.runs = list(runs)
        self.window = window
        self.stride = stride
        self.fields = expand(fields, self.runs)
        """Names of the tensors in an item."""
        self.evaluated = evaluated
        counts = [(len(run) - window) // stride + 1 for run in runs]
        run = np.repeat(np.arange(len(runs)), counts)
        t = np.concatenate([window - 1 + stride * np.arange(n) for n in counts])
        self.index = np.stack([run, t], axis=1)
        """int64 (item, 2): position of the run in ``runs``, and t."""
        if evaluated:
            means = [mean_returns(run) for run in runs]
            self.index = self.index[[bool(np.isfinite(means[r][t])) for r, t in self.index]]
            _check_some(self.index, runs)
        self._ids = [run.id for run in runs]
        self._others = [name for name in self.fields if name != WEIGHTS]
        self._values: dict[int, dict[str, np.ndarray]] = {}
        self._cached = [CachedWeights(run) for run in runs]
        for position, cached in enumerate(self._cached):
            if isinstance(cached.run.path, RemotePath):
                cached.map()  # now: a forked worker could not read it
                self._fields_of(position)
        self._maps: dict[int, np.ndarray] = {}

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of what the items are: equal data sets, also of copied or packed runs.

        Raises:
            DamageError: a run's digests are damaged.
        """
        runs = [(cached.run.id, cached.key) for cached in self._cached]
        what: list[Any] = [type(self).__name__, self.window, self.stride, runs]
        if self._others or self.evaluated:
            what += [self.fields, self.evaluated]
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def batch(self, indices: Sequence[int]) -> Batch:
        """Some items as one batch, as torch's ``default_collate`` would make it, copied once.

        Raises:
            IndexError: there is no such item.
            CacheError: the cache's folder cannot be used.
            DamageError: a run is damaged.
        """
        index = self.index[np.asarray(indices)]
        pairs = index.tolist()
        stack = _stack if get_worker_info() is None else _stack_shared
        batch: dict[str, Any] = {}
        if WEIGHTS in self.fields:
            batch[WEIGHTS] = stack([self._view(run, t) for run, t in pairs])
        for name in self._others:
            batch[name] = stack([self._field(name, run, t) for run, t in pairs])
        batch |= {
            "t": torch.from_numpy(index[:, 1].copy()),
            "run": [self._ids[r] for r, _ in pairs],
        }
        return cast(Batch, batch)

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, i: int) -> Item:
        """Return one item; raises as ``batch`` does."""
        run, t = self.index[i].tolist()
        if not self._others:
            weights = torch.from_numpy(self._view(run, t).copy())
            return {"weights": weights, "t": t, "run": self._ids[run]}
        item: Any = {"t": t, "run": self._ids[run]}
        if WEIGHTS in self.fields:
            item[WEIGHTS] = torch.from_numpy(self._view(run, t).copy())
        for name in self._others:
            item[name] = torch.from_numpy(np.array(self._field(name, run, t)))
        return cast(Item, item)

    def __getitems__(self, indices: Sequence[int]) -> list[Item]:
        """Items of one batch, for torch's ``DataLoader``; faster than one by one."""
        batch: dict[str, Any] = {**self.batch(indices)}
        columns = [
            value.tolist() if name == "t" else value if name == "run" else value.unbind(0)
            for name, value in batch.items()
        ]
        return [
            cast(Item, dict(zip(batch, row, strict=True))) for row in zip(*columns, strict=True)
        ]

    def _view(self, run: int, t: int) -> np.ndarray:
        """Return rows of the map itself. To write to them would end the process: copies go out."""
        rows = self._maps.get(run)
        if rows is None:
            rows = self._rows(run)
        return rows[t - self.window + 1 : t + 1]

    def _field(self, name: str, run: int, t: int) -> np.ndarray:
        """Return rows of another field, as ``_view`` those of the weights."""
        return self._fields_of(run)[name][t - self.window + 1 : t + 1]

    def _rows(self, run: int) -> Float32[np.ndarray, "time param"]:
        rows = self._maps.get(run)
        if rows is None:
            if len(self._maps) >= MAX_MAPS:
                del self._maps[next(iter(self._maps))]
            rows = self._maps[run] = self._cached[run].map()
        return rows

    def _fields_of(self, run: int) -> dict[str, np.ndarray]:
        """Return all other fields of a run, read when the first item of it is asked for."""
        if run not in self._values:
            self._values[run] = {name: values(self.runs[run], name) for name in self._others}
        return self._values[run]

    def __getstate__(self) -> dict[str, Any]:
        """Return what a spawned worker gets: where the rows are, not the rows."""
        return {**self.__dict__, "_maps": {}}


class WindowDataset(RunDataset):
    """All windows of K consecutive snapshots of some runs.

    Args:
        runs: runs of the same layout.
        window: snapshots in a window, K.
        stride: snapshots from one window's end to the next one's.
        fields: what an item holds; see ``weighttraj.load.fields``.
        evaluated: only windows whose last snapshot has a mean return.

    Raises:
        WindowError: the runs differ in layout, a run is shorter than a window, or a run stores no
            such field.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        window: int = 20,
        *,
        stride: int = 1,
        fields: Sequence[str] = ("weights",),
        evaluated: bool = False,
    ) -> None:
        super().__init__(runs, window, stride, fields, evaluated)

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
        fields: what an item holds; see ``weighttraj.load.fields``.
        evaluated: only snapshots that have a mean return.

    Raises:
        WindowError: the runs differ in layout, a run has no snapshots, or stores no such field.
    """

    def __init__(
        self,
        runs: Sequence[Run],
        *,
        stride: int = 1,
        fields: Sequence[str] = ("weights",),
        evaluated: bool = False,
    ) -> None:
        super().__init__(runs, 1, stride, fields, evaluated)

    def _view(self, run: int, t: int) -> np.ndarray:
        row: np.ndarray = self._rows(run)[t]
        return row

    def _field(self, name: str, run: int, t: int) -> np.ndarray:
        return np.asarray(self._fields_of(run)[name][t])

    def __repr__(self) -> str:
        size = self.runs[0].layout.size
        return f"<SnapshotDataset {len(self)} snapshots of ({size},), {len(self.runs)} runs>"


def _stack(views: list[np.ndarray]) -> Tensor:
    """Copies of some rows, put together. Numpy's memory comes in huge pages, torch's does not."""
    if not views[0].ndim:
        return torch.from_numpy(np.array(views))
    return torch.from_numpy(np.concatenate(views).reshape(len(views), *views[0].shape))


def _stack_shared(views: list[np.ndarray]) -> Tensor:
    """Return the same in a worker, right into the memory that it shares with the main process."""
    with warnings.catch_warnings():  # torch fears for the map, which here is only read
        warnings.filterwarnings("ignore", "The given NumPy array is not writable")
        stacked: Tensor = default_collate([torch.from_numpy(view) for view in views])
        return stacked


def _check_some(index: np.ndarray, runs: Sequence[Run]) -> None:
    if not len(index):
        raise WindowError(
            "no snapshot of these runs has a mean return",
            got=f"{len(runs)} runs",
            where=runs[0].path,
            do="evaluate the snapshots with `weighttraj returns`",
        )


def _check(runs: Sequence[Run], window: int, stride: int) -> None:
    if not runs or window < 1 or stride < 1:
        raise WindowError(
            "no windows can be made of this",
            expected="at least one run, window and stride at least 1",
            got=f"{len(runs)} runs, window {window}, stride {stride}",
            do="choose runs and sizes that give windows",
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
