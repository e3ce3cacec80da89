"""Six checks that a causal forecaster should pass, as numbers.

- *null*: fitted to random walks and evaluated on others, its skill is 0 at every horizon.
- *causality*: what comes after t changes no bit of the forecast from t.
- *permutation*: a policy with its hidden units in another order is the same policy; the forecast
  is permuted in the same way.
- *sign*: a policy with the signs around tanh units flipped is the same policy; the forecast is
  flipped in the same way.
- *scale*: steps c times as long give a displacement c times as long.
- *drift*: a run on a straight line is forecast exactly. Only trends must pass this one: a fit to
  runs that do not move on lines shrinks every step.

The runs of the checks are real ones on disk (``copies``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from tipl.checks.copies import (
    WALK,
    Moments,
    adam_of,
    random_symmetry,
    random_walks,
    run_like,
)
from tipl.checks.results import Checks
from tipl.errors import ForecastError, RepresentationError
from tipl.forecaster import Forecaster
from tipl.runs import weights_of
from weighttraj import Run

Fit = Callable[[Sequence[Run]], Forecaster]
"""Fits a forecaster to runs."""

GRID = 2.0**-20
"""Weights of test runs are multiples of this, so that float32 holds sums and doubles exactly."""


def check(
    forecaster: Forecaster,
    run: Run,
    folder: Path,
    *,
    fit: Fit | None = None,
    horizons: Sequence[int] = (1, 2, 5, 10),
    count: int = 4,
    seed: int = 0,
) -> Checks:
    """Run all six checks.

    Args:
        forecaster: what is checked, fitted to real runs.
        run: a run of the kind that it was fitted to; the checks alter copies of it.
        folder: folder for the copies.
        fit: fits such a forecaster to runs, for the null; None: there is nothing to fit.
            ``tipl.checks.model.refit_of`` returns it for every kind.
        horizons: numbers of snapshots ahead.
        count: number of random walks for the null; two are forecast, the others are for the fit.
        seed: seed of walks and symmetries.

    Raises:
        ForecastError: it makes no forecast of such runs, or for such horizons.
    """
    if max(horizons) > WALK // 2:
        raise ForecastError(
            "the random walks are too short for such a horizon",
            expected=f"horizons of at most {WALK // 2}",
            got=max(horizons),
            do="choose smaller --horizons",
        )
    walks = random_walks(run, folder, count=count, seed=seed)
    walker = forecaster if fit is None else fit(walks[2:])
    last = len(run) - 1 - max(horizons)
    starts = sorted({last // 4, last // 2, last})
    where = (run, folder, starts, horizons)
    odd = run.info.policy.activation == "tanh"
    return Checks(
        null=dict(zip(horizons, skills(walker, walks[:2], horizons).tolist(), strict=True)),
        causality=causality(forecaster, run, folder, last // 2, horizons),
        permutation=equivariance(forecaster, *where, symmetry="permutation", seed=seed),
        sign=equivariance(forecaster, *where, symmetry="sign", seed=seed) if odd else None,
        scale=scale(forecaster, *where),
        drift=_drift_or_none(forecaster, *where, seed=seed),
    )


def skills(
    forecaster: Forecaster, runs: Sequence[Run], horizons: Sequence[int]
) -> Float64[np.ndarray, " horizon"]:
    """Return the skill at each horizon over all starts that have all horizons after them.

    1 - sum |phi_{t+h} - forecast|^2 / sum |phi_{t+h} - phi_t|^2.
    """
    error, copy = np.zeros(len(horizons)), np.zeros(len(horizons))
    for run in runs:
        starts = np.arange(len(run) - max(horizons))
        for part in np.array_split(starts, -(-len(starts) // 64)):
            forecast = forecaster.forecast(run, part.tolist(), list(horizons))
            rows = weights_of(run)[part[0] : part[-1] + max(horizons) + 1].astype(np.float64)
            now = part - part[0]
            for place, h in enumerate(horizons):
                error[place] += ((rows[now + h] - forecast[:, place]) ** 2).sum()
                copy[place] += ((rows[now + h] - rows[now]) ** 2).sum()
    return 1 - error / copy


def causality(
    forecaster: Forecaster, run: Run, folder: Path, start: int, horizons: Sequence[int]
) -> bool:
    """Return whether the forecast is the same bits with another future, and with none."""
    weights, moments = weights_of(run), adam_of(run)
    rng = np.random.default_rng(0)

    def later(values: np.ndarray) -> np.ndarray:
        other = values.copy()
        other[start + 1 :] += rng.normal(size=other[start + 1 :].shape).astype(np.float32)
        return other

    def cut(values: np.ndarray) -> np.ndarray:
        return values[: start + 1]

    forecasts = [
        forecaster.forecast(
            run_like(run, change(weights), folder, _each(change, moments)), [start], list(horizons)
        )
        for change in (np.copy, later, cut)
    ]
    return all(np.array_equal(forecasts[0], later) for later in forecasts[1:])


def equivariance(
    forecaster: Forecaster,
    run: Run,
    folder: Path,
    starts: Sequence[int],
    horizons: Sequence[int],
    *,
    symmetry: str,
    seed: int = 0,
) -> float:
    """Return the error for a run with its hidden units altered, relative to the displacement.

    The symmetry is a ``permutation`` of the units of each hidden layer, or ``sign``: a flip of the
    weights into and out of some units, and of their biases.
    """
    order, signs = random_symmetry(run.layout, symmetry, np.random.default_rng(seed))
    weights = weights_of(run)
    moments = adam_of(run)
    if moments is not None:
        moments = moments[0][:, order] * signs, moments[1][:, order]
    altered = run_like(run, weights[:, order] * signs, folder, moments)
    before = forecaster.forecast(run, list(starts), list(horizons))
    after = forecaster.forecast(altered, list(starts), list(horizons))
    expected = before[..., order] * signs
    return _relative(after - expected, before - weights[list(starts)][:, None])


def scale(
    forecaster: Forecaster,
    run: Run,
    folder: Path,
    starts: Sequence[int],
    horizons: Sequence[int],
    *,
    factor: float = 2.0,
) -> float:
    """Return the error of the displacement when all steps are longer, relative to it."""
    weights = _on_grid(weights_of(run))
    longer = weights[0] + factor * (weights - weights[0])
    moments = adam_of(run)
    moved = [
        forecaster.forecast(run_like(run, rows, folder, moments), list(starts), list(horizons))
        - rows[list(starts)][:, None]
        for rows in (weights, longer)
    ]
    return _relative(moved[1] - factor * moved[0], moved[1])


def drift(
    forecaster: Forecaster,
    run: Run,
    folder: Path,
    starts: Sequence[int],
    horizons: Sequence[int],
    *,
    seed: int = 0,
) -> float:
    """Return the error for a run on a straight line, relative to the true displacement."""
    first = _on_grid(weights_of(run)[0])
    step = _on_grid(np.random.default_rng(seed).normal(size=first.shape) * 1e-3)
    line = first + np.arange(max(starts) + 1)[:, None] * step
    forecast = forecaster.forecast(run_like(run, line, folder), list(starts), list(horizons))
    moved = np.asarray(horizons)[:, None] * step
    return _relative(forecast - (line[list(starts)][:, None] + moved), moved)


def _drift_or_none(*arguments: Any, seed: int) -> float | None:
    try:
        return drift(*arguments, seed=seed)
    except RepresentationError:
        return None


def _each(change: Callable[[np.ndarray], np.ndarray], moments: Moments | None) -> Any:
    """Return changed moments; squares stay positive."""
    return None if moments is None else (change(moments[0]), np.abs(change(moments[1])))


def _on_grid(weights: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    return np.round(np.asarray(weights, np.float64) / GRID) * GRID


def _relative(error: np.ndarray, moved: np.ndarray) -> float:
    """Return the norm of an error over that of a displacement; 0 where both are 0."""
    if not error.any():
        return 0.0
    size = np.linalg.norm(np.asarray(moved, np.float64) * np.ones_like(error))
    return float(np.linalg.norm(error) / max(size, np.finfo(float).tiny))
