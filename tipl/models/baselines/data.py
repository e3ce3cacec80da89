"""A run as the baselines see it: all its parameters, or a sample of them in memory.

A forecast from snapshot t reads the rows that it looks back on and none after t; a fit keeps some
parameters of one run at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from tipl.runs import Rows, columns_of, fault_of, stratified, weights_of, without_faults
from weighttraj import Run

SAMPLE = 2048
"""Number of parameters of a run that a fit looks at."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """A run as baselines see it."""

    weights: Rows
    """float32 (time, param)."""
    phase: Int[np.ndarray, " time"]
    """Part of its iteration that ends at each snapshot; -1: unset."""
    tensor: Int[np.ndarray, " param"]
    """Which tensor of the layout a parameter belongs to, from 0."""
    matrix: Bool[np.ndarray, " param"]
    """Whether that tensor is a weight matrix: neither bias nor deviation."""
    importance: Float64[np.ndarray, " param"]
    """Number of parameters of the run that each one stands for; 1: itself."""

    @classmethod
    def of(cls, run: Run) -> Trajectory:
        """Return all parameters of a run; rows are read when they are sliced."""
        sizes = [param.size for param in run.layout.params]
        is_matrix = [param.role == "weight" for param in run.layout.params]
        return cls(
            weights=weights_of(run),
            phase=run.phase,
            tensor=np.repeat(np.arange(len(sizes)), sizes),
            matrix=np.repeat(is_matrix, sizes),
            importance=np.ones(run.layout.size),
        )

    def __len__(self) -> int:
        """Number of snapshots."""
        return self.weights.shape[0]

    def sample(self, limit: int, rng: np.random.Generator) -> Trajectory:
        """Return a sample in memory of about ``limit`` parameters, some of each tensor."""
        columns, counts = stratified(self.tensor, limit, rng)
        return Trajectory(
            weights=columns_of(self.weights, columns),
            phase=self.phase,
            tensor=self.tensor[columns],
            matrix=self.matrix[columns],
            importance=self.importance[columns] * counts,
        )

    def windows(
        self, starts: Sequence[int], history: int
    ) -> Iterator[tuple[int, Float64[np.ndarray, "row param"]]]:
        """Yield the place of each start, in the order of time, and the snapshots up to it.

        These are up to ``history`` snapshots before the start and, as the last row, the start.
        """
        for place in np.argsort(np.asarray(starts), kind="stable").tolist():
            t = starts[place]
            yield place, self.weights[max(0, t - history) : t + 1].astype(np.float64)


def samples(
    runs: Sequence[Run], seed: int, *, limit: int = SAMPLE
) -> Iterator[tuple[Run, Trajectory]]:
    """Yield each run with some of its parameters, others of each run.

    A run whose weights are not finite, huge or constant is left out, with a warning.
    """
    for number, run in enumerate(runs):
        if without_faults([run], lambda run: fault_of(weights_of(run)))[0]:
            yield run, Trajectory.of(run).sample(limit, np.random.default_rng([seed, number]))


def thinned(
    n: int, limit: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " start"], Float[np.ndarray, " start"]]:
    """Return at most ``limit`` of the starts 0, ..., n - 1, and how many each stands for.

    The first ``limit // 2`` are all taken, as the steps are largest there. The others are drawn at
    random: every k-th one could always be of the same phase.
    """
    if n <= limit:
        return np.arange(n), np.ones(n)
    head = limit // 2
    tail = np.sort(head + rng.permutation(n - head)[: limit - head])
    counts = np.full(limit, (n - head) / (limit - head))
    counts[:head] = 1
    return np.concatenate([np.arange(head), tail]), counts


def renewal(t: int) -> int:
    """Return the last snapshot up to t at which costly features of the past are computed again.

    These are the snapshots 1, 2, ..., 20, and then each that makes the past a tenth longer.

    >>> [renewal(t) for t in (0, 7, 21, 22, 25, 1000)]
    [0, 7, 20, 22, 24, 972]
    """
    now = 0
    while (following := max(now + 1, now * 11 // 10)) <= t:
        now = following
    return now
