"""Returns of the snapshots, as they are stored: learning curves and their spread over runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from weighttraj.run import Run

MAX_POINTS = 200
"""Points of a curve that is drawn."""

Kind = Literal["deterministic", "sampled", "training"]
KINDS: tuple[Kind, ...] = ("deterministic", "sampled", "training")

NAMES: dict[Kind, str] = {
    "deterministic": "mean return of the stored episodes, deterministic actions",
    "sampled": "mean return of the stored episodes, sampled actions",
    "training": "mean return of the last training episodes",
}
"""What each kind is called in text."""

_TRAINING = "train/ep_rew_mean"


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Mean returns of one run."""

    run: str
    """Id of the run."""
    steps: Float64[np.ndarray, " point"]
    """Environment steps, increasing."""
    returns: Float64[np.ndarray, " point"]
    """Mean return."""


@dataclass(frozen=True, kw_only=True)
class Band:
    """Quartiles of the returns of several runs, at the same environment steps."""

    steps: Float64[np.ndarray, " point"]
    """Environment steps."""
    low: Float64[np.ndarray, " point"]
    """First quartile."""
    median: Float64[np.ndarray, " point"]
    """Median."""
    high: Float64[np.ndarray, " point"]
    """Third quartile."""


def mean_returns(run: Run, kind: Kind) -> Float64[np.ndarray, " time"] | None:
    """Return the mean return of each snapshot, NaN where there is none; None: the run stores none.

    Training returns are the mean over the last episodes before a snapshot, of several policies.
    """
    if kind == "training":
        return run[_TRAINING][:] if _TRAINING in run.keys() else None  # noqa: SIM118  no mapping
    mode = kind == "deterministic"
    if run.evaluation is None or mode not in run.evaluation.deterministic:
        return None
    return run.mean_return(deterministic=mode)


def best_returns(run: Run) -> tuple[Float64[np.ndarray, " time"], Kind] | None:
    """Return the first kind of returns that the run has, deterministic ones before others."""
    for kind in KINDS:
        values = mean_returns(run, kind)
        if values is not None and np.isfinite(values).any():
            return values, kind
    return None


def final_return(run: Run) -> tuple[float, Kind]:
    """Return the last return of the first kind that the run has; NaN: none."""
    found = best_returns(run)
    if found is None:
        return float("nan"), "training"
    values, kind = found
    return float(values[np.isfinite(values)][-1]), kind


def curves(runs: Sequence[Run], kind: Kind) -> list[Curve]:
    """Return a curve for each run that has returns of this kind."""
    found = []
    for run in runs:
        values = mean_returns(run, kind)
        if values is not None and np.isfinite(values).any():
            found.append(_curve(run, values))
    return found


def band(lines: Sequence[Curve]) -> Band:
    """Return median and quartiles over runs, at steps that at least one of them covers.

    Between two snapshots a run's return is interpolated.
    """
    grid = np.linspace(
        min(line.steps[0] for line in lines), max(line.steps[-1] for line in lines), MAX_POINTS
    )
    rows = [np.interp(grid, c.steps, c.returns, left=np.nan, right=np.nan) for c in lines]
    values = np.stack(rows)
    covered = np.isfinite(values).any(0)
    low, median, high = np.nanquantile(values[:, covered], [0.25, 0.5, 0.75], axis=0)
    return Band(steps=grid[covered], low=low, median=median, high=high)


def filled(values: Float64[np.ndarray, " time"]) -> Float64[np.ndarray, " time"]:
    """Values interpolated between those that are known; NaN before the first and after the last."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return values
    every: np.ndarray = np.interp(
        np.arange(len(values)), known, values[known], left=np.nan, right=np.nan
    )
    return every


def thin(count: int, most: int = MAX_POINTS) -> Int64[np.ndarray, " point"]:
    """Evenly spaced indices of at most so many of ``count`` points, the first and last included."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))


def _curve(run: Run, values: Float64[np.ndarray, " time"]) -> Curve:
    """Of snapshots at the same environment steps, the last."""
    known = np.flatnonzero(np.isfinite(values))
    steps = run.num_timesteps[known]
    last = np.flatnonzero(np.append(np.diff(steps) > 0, True))
    keep = last[thin(len(last))]
    return Curve(run=run.id, steps=steps[keep].astype(np.float64), returns=values[known[keep]])
