"""Where forecasts start: at all snapshots for weights, in the learning phase for returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tipl.errors import EvaluateError
from tipl.evaluation.config import EvaluateConfig
from weighttraj import Run, learning

DENSE = 64
"""Number of first snapshots that are always starts: the longest steps are there, and a few of them
dominate a sum over starts."""
_HISTORY = 10
"""Number of snapshots that a start for returns should have before it."""


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Where forecasts of one run start."""

    weights: Int[np.ndarray, " start"]
    """Starts for errors of weights; the run goes on for every horizon."""
    learning: Int[np.ndarray, " learning_start"]
    """Starts for returns within the learning phase."""
    plateau: Int[np.ndarray, " plateau_start"]
    """Starts for returns after it."""


def starts_of(run: Run, config: EvaluateConfig) -> Starts:
    """Return the starts of a run.

    Raises:
        EvaluateError: the run is too short, or it has no returns that tell when it has learned.
    """
    last = len(run) - 1 - max(config.horizons)
    if last < 1:
        raise EvaluateError(
            "a run is too short to be forecast",
            expected=f"more than {max(config.horizons) + 1} snapshots",
            got=len(run),
            where=run.path,
            do="choose smaller --horizons, or collect longer runs",
        )
    none = np.zeros(0, int)
    if not config.learning_starts:
        return Starts(weights=_sample(last, config.starts), learning=none, plateau=none)
    end = len(run) - 1 - max(config.return_horizons)
    learned = min(learning_phase(run), end - 1)
    first = min(_HISTORY, learned // 4)
    inside = np.linspace(first, learned, config.learning_starts + 2)[1:-1]
    return Starts(
        weights=_sample(last, config.starts),
        learning=np.unique(inside.round().astype(int)),
        plateau=_spread(learned, end, config.plateau_starts + 1)[1:],
    )


def learning_phase(run: Run) -> int:
    """Return the first snapshot whose return is 95 % of the way from the first to the final one.

    Returns of sampled actions are used if they are stored, because deterministic ones can jump.

    Raises:
        EvaluateError: the run has no returns.
    """
    if run.evaluation is None:
        raise EvaluateError(
            "the runs have no returns, so nothing tells when they have learned",
            expected="returns of the stored policies",
            where=run.path,
            do="weighttraj returns DATASET, or --learning-starts 0 to evaluate weights only",
        )
    sampled = False in run.evaluation.deterministic
    return learning.learning_phase(run.mean_return(deterministic=not sampled))


def at_boundary(run: Run, starts: Int[np.ndarray, " start"]) -> Bool[np.ndarray, " start"]:
    """Return whether the step after each start belongs to the next iteration, with new data."""
    iteration = run.iteration
    return np.asarray(iteration[starts + 1] != iteration[starts])


def shares(starts: Int[np.ndarray, " start"]) -> Float[np.ndarray, " start"]:
    """Return the number of snapshots that each start stands for: those nearest to it."""
    middles = (starts[1:] + starts[:-1]) / 2
    edges = np.concatenate([starts[:1] - 0.5, middles, starts[-1:] + 0.5])
    return np.asarray(np.diff(edges))


def _sample(last: int, count: int) -> Int[np.ndarray, " start"]:
    """Return all snapshots up to the last, or the first ones and then evenly spaced ones."""
    if count > last:
        return np.arange(last + 1)
    dense = min(DENSE, count // 4)
    return np.concatenate([np.arange(dense), _spread(dense, last, count - dense)])


def _spread(first: int, last: int, count: int) -> Int[np.ndarray, " start"]:
    """Return ``count`` integers, evenly spaced from the first to the last."""
    return np.unique(np.linspace(first, last, min(count, last - first + 1)).round().astype(int))
