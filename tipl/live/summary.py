"""Figures of a study: environment steps to thresholds, final returns, areas, worst runs.

Everything is paired by seed, and every interval is a bootstrap over seeds. A training that never
reaches a threshold is censored: it counts as if it had reached it at its last step, and the number
of such trainings stands beside the ratio.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from tipl.evaluation.statistics import Bootstrap, interquartile_mean, quotient
from tipl.live.plan import Evaluation, Plan
from tipl.live.results import Figure, Series

Thresholds = dict[str, float]
"""Return of each threshold, by its share in per cent."""


def returns_of(series: Series) -> Float[np.ndarray, "seed evaluation"]:
    """Return J of all trainings; the least of all where a simulation became unstable."""
    returns = np.array([curve.returns for curve in series.curves], np.float64)
    return np.nan_to_num(returns, nan=float(np.nanmin(returns)))


def final_returns(series: Series, evaluation: Evaluation) -> Float[np.ndarray, " seed"]:
    """Return the mean return of the last evaluations of each training."""
    returns = returns_of(series)
    last = max(1, round(evaluation.last * returns.shape[1]))
    return np.asarray(returns[:, -last:].mean(1), np.float64)


def final(series: Series, evaluation: Evaluation) -> float:
    """Return the interquartile mean over seeds of the final return."""
    return float(interquartile_mean(final_returns(series, evaluation)))


def thresholds_of(plan: Plan, baseline: Series) -> Thresholds:
    """Return the thresholds: shares of the baseline's final return.

    Where that is not positive, shares of the way to it from the return before training.
    """
    top = final(baseline, plan.evaluation_of(baseline.task))
    start = 0.0 if top > 0 else float(interquartile_mean(returns_of(baseline)[:, 0]))
    return {f"{100 * share:g}": start + share * (top - start) for share in plan.thresholds}


def steps_to(
    series: Series, threshold: float, evaluation: Evaluation
) -> tuple[Float[np.ndarray, " seed"], int]:
    """Return the environment steps of each training to a return, and how many are censored.

    The running mean of the last evaluations has to reach the return; between two evaluations the
    steps are interpolated.
    """
    steps = np.array(series.num_timesteps, np.float64)
    returns = returns_of(series)
    found, censored = np.full(len(returns), steps[-1]), 0
    for place, row in enumerate(returns):
        sums = np.cumsum(np.concatenate([[0.0], row]))
        first = np.maximum(np.arange(len(row)) - evaluation.smooth + 1, 0)
        mean = (sums[1:] - sums[first]) / (np.arange(len(row)) - first + 1)
        reached = np.flatnonzero(mean >= threshold)
        if not len(reached):
            censored += 1
        elif (i := int(reached[0])) == 0:
            found[place] = max(steps[0], 1.0)
        else:
            share = (threshold - mean[i - 1]) / (mean[i] - mean[i - 1])
            found[place] = steps[i - 1] + share * (steps[i] - steps[i - 1])
    return np.maximum(found, 1.0), censored


def compare(plan: Plan, arm: Series, against: Series, thresholds: Thresholds) -> Iterator[Figure]:
    """Yield the figures of one arm against another one."""
    evaluation = plan.evaluation_of(arm.task)
    bootstrap = Bootstrap(resamples=plan.bootstrap, seed=0)
    about: dict[str, Any] = {"task": arm.task, "arm": arm.arm, "against": against.arm}
    for share, threshold in thresholds.items():
        mine, censored = steps_to(arm, threshold, evaluation)
        others, censored_against = steps_to(against, threshold, evaluation)
        (cell,) = bootstrap.interval(_geometric_mean, np.log(mine / others))
        counts = {"censored": censored, "censored_against": censored_against}
        yield Figure(**about | {"name": f"steps to {share} %"} | cell | counts)
    pair = final_returns(arm, evaluation), final_returns(against, evaluation)
    (cell,) = bootstrap.interval(_difference, *pair)
    yield Figure(**about | {"name": "final"} | cell)
    means = returns_of(arm).mean(1), returns_of(against).mean(1)
    (cell,) = bootstrap.interval(_difference, *means)
    yield Figure(**about | {"name": "area"} | cell)
    (cell,) = bootstrap.interval(_worst, *pair)
    yield Figure(**about | {"name": "worst decile"} | cell)


def mean_log_ratio(plan: Plan, arm: Series, against: Series, thresholds: Thresholds) -> float:
    """Return what tuning minimises: the mean over thresholds and seeds of the log ratio of steps.

    A censored training, of either arm, counts as one that needs twice its steps: no setting is
    chosen because it never arrives.
    """
    evaluation = plan.evaluation_of(arm.task)
    total = arm.num_timesteps[-1]
    logs = []
    for threshold in thresholds.values():
        pair = (steps_to(one, threshold, evaluation)[0] for one in (arm, against))
        mine, others = (np.where(steps >= total, 2 * total, steps) for steps in pair)
        logs.append(np.log(mine / others).mean())
    return float(np.mean(logs))


def _geometric_mean(logs: Float[np.ndarray, "seed *draw"]) -> Float[np.ndarray, "*draw"]:
    return np.asarray(np.exp(logs.mean(0)))


def _difference(
    mine: Float[np.ndarray, "seed *draw"], others: Float[np.ndarray, "seed *draw"]
) -> Float[np.ndarray, "*draw"]:
    """Return the difference of interquartile means over the size of the other's."""
    other = interquartile_mean(others)
    return _over(interquartile_mean(mine) - other, other)


def _worst(
    mine: Float[np.ndarray, "seed *draw"], others: Float[np.ndarray, "seed *draw"]
) -> Float[np.ndarray, "*draw"]:
    """Return the difference of the worst tenth's means, over the other's interquartile mean."""
    count = max(1, round(0.1 * len(mine)))
    low, other = (np.sort(x, axis=0)[:count].mean(0) for x in (mine, others))
    return _over(low - other, interquartile_mean(others))


def _over(difference: ArrayLike, size: ArrayLike) -> np.ndarray:
    """Return a difference over the size of a return; NaN where that is 0."""
    return quotient(np.asarray(difference), np.asarray(np.abs(size)))
