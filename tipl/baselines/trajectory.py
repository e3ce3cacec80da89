"""What baselines read of a run: few rows at a time, of all its parameters or of a sample of them.

A large run is 1.4 GB of float32. A forecast from snapshot t reads the rows that it looks back on
and none after t; a fit keeps some parameters of one run at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int

from weighttraj import ParamLayout, Run

MAX_BYTES = 2**25
"""Rows that are read at once, beyond those that one start needs."""
SAMPLE = 2048
"""Parameters of a run that a fit looks at."""


@runtime_checkable
class Rows(Protocol):
    """An array of a run, or one in memory: rows are read when it is indexed."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows, and the shape of one."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, key: Any, /) -> Any: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """A run as baselines see it."""

    weights: Rows
    """float32 (time, param)."""
    phase: Rows
    """Part of its iteration that ends at each snapshot, (time,)."""
    tensor: Int[np.ndarray, " param"]
    """Which tensor of the layout a parameter belongs to, from 0."""
    matrix: Bool[np.ndarray, " param"]
    """Whether that tensor is a weight matrix: neither bias nor deviation."""
    importance: Float64[np.ndarray, " param"]
    """How many parameters of the run each one stands for; 1: itself."""

    @classmethod
    def of(cls, run: Run) -> Trajectory:
        """All parameters of a run. Nothing is read yet."""
        tensor, matrix = _tensors(run.layout)
        return cls(
            weights=run.weights,
            phase=run["index/phase"],
            tensor=tensor,
            matrix=matrix,
            importance=np.ones(len(tensor)),
        )

    def __len__(self) -> int:
        """Number of snapshots."""
        return len(self.weights)

    def sample(self, limit: int, rng: np.random.Generator) -> Trajectory:
        """At most about so many parameters, in memory, some of each tensor."""
        columns, counts = stratified(self.tensor, limit, rng)
        return Trajectory(
            weights=columns_of(self.weights, columns),
            phase=np.asarray(self.phase[:]),
            tensor=self.tensor[columns],
            matrix=self.matrix[columns],
            importance=self.importance[columns] * counts,
        )

    def windows(
        self, starts: Sequence[int], history: int
    ) -> Iterator[tuple[int, Float64[np.ndarray, "row param"]]]:
        """The snapshots that each start looks back on.

        Args:
            starts: snapshots, in any order.
            history: snapshots before each start.

        Yields:
            The place of a start among the starts, and its window, oldest snapshot first: the start
            is the last row. There are fewer than ``history + 1`` near the beginning of the run.
        """
        reader = Reader(self.weights, max(starts))
        for place in np.argsort(np.asarray(starts), kind="stable").tolist():
            t = starts[place]
            yield place, reader.rows(max(0, t - history), t + 1)


class Reader:
    """Reads rows that lie close together from one block.

    Args:
        weights: an array of a run.
        last: the last row that may be read.
    """

    def __init__(self, weights: Rows, last: int) -> None:
        self._weights, self._last = weights, last
        self._ahead = max(1, MAX_BYTES // (4 * weights.shape[1]))
        self._first = self._stop = 0
        self._block: np.ndarray = np.empty((0, weights.shape[1]), np.float32)

    def rows(self, first: int, stop: int) -> Float64[np.ndarray, "row param"]:
        """Rows from first to stop (exclusive)."""
        if first < self._first or stop > self._stop:
            self._first, self._stop = first, min(stop + self._ahead, self._last + 1)
            self._block = self._weights[self._first : self._stop]
        part = self._block[first - self._first : stop - self._first]
        return part.astype(np.float64)


def stratified(
    tensor: Int[np.ndarray, " param"], limit: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " some"], Float64[np.ndarray, " some"]]:
    """At most about so many parameters, some of each tensor, and how many each stands for.

    Each tensor has a share by its size, small ones at least half of an equal share.
    """
    size, tensors = len(tensor), int(tensor.max()) + 1
    chosen, counts = [], []
    for number in range(tensors):
        mine = np.flatnonzero(tensor == number)
        share = max(limit * len(mine) // size, limit // (2 * tensors), 1)
        some = np.sort(rng.permutation(mine)[:share]) if size > limit else mine
        chosen.append(some)
        counts.append(np.full(len(some), len(mine) / len(some)))
    return np.concatenate(chosen), np.concatenate(counts)


def samples(
    runs: Sequence[Run], seed: int, *, limit: int = SAMPLE
) -> Iterator[tuple[Run, Trajectory]]:
    """Each run with some of its parameters, others of each run."""
    for number, run in enumerate(runs):
        yield run, Trajectory.of(run).sample(limit, np.random.default_rng([seed, number]))


def thinned(
    n: int, limit: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " start"], Float[np.ndarray, " start"]]:
    """At most so many of the starts 0, ..., n - 1, and how many each of them stands for.

    The first half of the limit is taken whole: there the steps are largest. The others are drawn
    at random, as every k-th could fall on the same phase again and again.
    """
    if n <= limit:
        return np.arange(n), np.ones(n)
    head = limit // 2
    tail = np.sort(head + rng.permutation(n - head)[: limit - head])
    counts = np.full(limit, (n - head) / (limit - head))
    counts[:head] = 1
    return np.concatenate([np.arange(head), tail]), counts


def renewal(t: int) -> int:
    """The last moment up to t at which what is costly to find in the past is found again.

    These are the snapshots 1, 2, ..., 20 and then each that makes the past a tenth longer.

    >>> [renewal(t) for t in (0, 7, 21, 22, 25, 1000)]
    [0, 7, 20, 22, 24, 972]
    """
    now = 0
    while (following := max(now + 1, now * 11 // 10)) <= t:
        now = following
    return now


def _tensors(layout: ParamLayout) -> tuple[np.ndarray, np.ndarray]:
    sizes = [param.size for param in layout.params]
    matrix = [param.role == "weight" for param in layout.params]
    return np.repeat(np.arange(len(sizes)), sizes), np.repeat(matrix, sizes)


def columns_of(weights: Rows, columns: np.ndarray) -> Float32[np.ndarray, "time some"]:
    """Some columns of all rows, read block by block."""
    rows = max(1, 4 * MAX_BYTES // (4 * weights.shape[1]))
    blocks = [weights[a : a + rows][:, columns] for a in range(0, len(weights), rows)]
    return np.ascontiguousarray(np.concatenate(blocks))


__all__ = [
    "SAMPLE",
    "Reader",
    "Rows",
    "Trajectory",
    "columns_of",
    "renewal",
    "samples",
    "stratified",
    "thinned",
]
