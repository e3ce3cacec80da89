"""Ratios of sums over runs, with intervals that resample the runs.

Runs are independent, snapshots of one run are not. So each interval is a percentile bootstrap over
runs (Efron, 1979), like the aggregates of Agarwal et al., "Deep Reinforcement Learning at the Edge
of the Statistical Precipice" (NeurIPS 2021), whose interquartile mean is here too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

Cell = dict[str, float | None]
"""``value``, and the ends ``low`` and ``high`` of its 95 % interval; None with a single run."""


@dataclass(frozen=True, kw_only=True)
class Bootstrap:
    """Draws runs with replacement."""

    resamples: int
    """Number of resamples."""
    seed: int
    """Seed of the draws."""

    def interval(
        self,
        statistic: Callable[..., Float[np.ndarray, "*cell"]],
        *samples: Float[np.ndarray, "run *shape"],
    ) -> list[Cell]:
        """Return a statistic of all runs with its interval, for each of its cells in order.

        Args:
            statistic: reduces the first axis, the run; a second axis, of the resamples, may follow.
            samples: arrays whose first axis is the run.
        """
        values, runs = np.ravel(statistic(*samples)), len(samples[0])
        low = high = np.full(len(values), np.nan)
        if runs > 1:
            picks = np.random.default_rng(self.seed).integers(runs, size=(self.resamples, runs))
            drawn = statistic(*(sample[picks.T] for sample in samples))
            low, high = np.quantile(drawn.reshape(self.resamples, -1), (0.025, 0.975), axis=0)
        return [
            {"value": _plain(v), "low": _plain(a), "high": _plain(b)}
            for v, a, b in zip(values, low, high, strict=True)
        ]


def ratio_of_sums(
    numerator: Float[np.ndarray, "run *cell"], denominator: Float[np.ndarray, "run *cell"]
) -> Float[np.ndarray, "*cell"]:
    """Return the ratio of two sums over runs; NaN where the denominator is 0."""
    return quotient(numerator.sum(0), denominator.sum(0))


def quotient(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Return the ratio; NaN where the denominator is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.asarray(numerator / denominator)
    return np.where(denominator == 0, np.nan, ratio)


def mean(values: Float[np.ndarray, "run *cell"]) -> Float[np.ndarray, "*cell"]:
    """Return the mean over runs, without NaN."""
    counted = np.isfinite(values)
    return quotient(np.where(counted, values, 0.0).sum(0), counted.sum(0))


def interquartile_mean(values: Float[np.ndarray, "run *cell"]) -> Float[np.ndarray, "*cell"]:
    """Return the mean of the middle half over the first axis; runs at its edges count in part.

    >>> float(interquartile_mean(np.array([0.0, 1.0, 2.0, 100.0])))
    1.5
    """
    n = len(values)
    ranks = np.arange(n)
    share = np.clip(np.minimum(ranks + 1, 0.75 * n) - np.maximum(ranks, 0.25 * n), 0, None)
    return np.tensordot(share / share.sum(), np.sort(values, axis=0), axes=1)


def _plain(value: np.floating[Any]) -> float | None:
    return float(value) if np.isfinite(value) else None
