"""Does a population learn as SB3 does? Training returns of 20 seeds each, compared as samples.

python -W ignore tests/benchmarks/bench_learning.py

Both are collected as `weighttraj collect` collects them, by the recipe of the published data set
but shorter, the learning rate annealed over that length. The two samples have different seeds:
with the same ones each run would have its twin in the other sample, and neither the intervals nor
the tests would hold. Beside that, SB3's seeds by the population: against SB3, run by run; and, as a
control, against the population's other seeds, from which only the seeds set them apart.

The collection goes on where it stopped; SB3's half takes most of an hour.

Of each run, from the mean return of its last 10 training episodes at the end of each rollout (the
policy changes only between rollouts): environment steps until it first reaches a threshold, the
whole length if it never does; its last value; its mean over the training.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import numpy as np
from results import save
from rich.console import Console

import weighttraj as wt
from weighttraj.collect import Recipe, collect, read_recipe
from weighttraj.collect.recorder import Recorder
from weighttraj.collect.settings import Collect, Seeds
from weighttraj.publish.curves import mean_returns

RECIPE = Path(__file__).parents[2] / "datasets/inverted-pendulum-v4-ppo-v1/recipe.toml"
EPISODES = 10
"""Whose mean return is a point of a learning curve."""
THRESHOLDS = (475, 900)
RESAMPLES = 10_000
"""Of each bootstrap and each permutation test."""


def recipe_of(
    collector: Literal["sb3", "population"], seeds: Sequence[int], timesteps: int
) -> Recipe:
    """The data set's recipe, with other seeds, shorter, and trained by this collector."""
    full = read_recipe(RECIPE)
    return replace(
        full,
        id="bench-learning",
        ppo=replace(full.ppo, total_timesteps=timesteps),
        seeds=Seeds(train=list(seeds)),
        collect=Collect(collector=collector, population=full.collect.population),
    )


def collected(recipe: Recipe, folder: Path) -> wt.Dataset:
    """The runs of a recipe; those that are there already are left alone.

    What they store as training return is here the mean of the last 10 episodes, not of the last
    100: so many episodes are most of such a short training.
    """
    end_rollout = Recorder.end_rollout

    def of_few(recorder: Recorder, returns: Sequence[Any], inputs: np.ndarray) -> None:
        end_rollout(recorder, list(returns)[-EPISODES:], inputs)

    with mock.patch.object(Recorder, "end_rollout", of_few):
        return collect(recipe, folder, console=Console())


def curves(dataset: wt.Dataset, seeds: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Environment steps at the end of each rollout, and training returns there, (seed, rollout)."""
    steps, returns = [], []
    for run in dataset.select(seed=seeds).runs:
        values, iteration = mean_returns(run, "training"), run.iteration
        assert values is not None
        last = np.flatnonzero(np.append(np.diff(iteration) > 0, True))[1:]  # [0]: before training
        steps.append(run.num_timesteps[last])
        returns.append(values[last])
    assert len(steps) == len(seeds)
    assert all(np.array_equal(row, steps[0]) for row in steps)
    return steps[0], np.stack(returns)


def measures(steps: np.ndarray, returns: np.ndarray) -> dict[str, np.ndarray]:
    """What is compared, a number for each run."""
    found = {}
    for threshold in THRESHOLDS:
        reached = returns >= threshold
        first = np.where(reached.any(1), steps[reached.argmax(1)], steps[-1])
        found[f"steps to a return of {threshold}"] = first.astype(np.float64)
    found["final return"] = returns[:, -1]
    found["mean return over the training"] = returns.mean(1)
    return found


def never(returns: np.ndarray) -> list[int]:
    """How many runs stay below each threshold."""
    return [int((returns < threshold).all(1).sum()) for threshold in THRESHOLDS]


def iqm(values: np.ndarray) -> np.ndarray:
    """Interquartile mean along the last axis: a quarter of the values is left out at each end."""
    cut = values.shape[-1] // 4
    return np.asarray(np.sort(values, -1)[..., cut : values.shape[-1] - cut].mean(-1))


def resampled(values: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Bootstrap samples of runs, (sample, run)."""
    return values[rng.integers(len(values), size=(RESAMPLES, len(values)))]


def interval(statistics: np.ndarray) -> list[float]:
    """The percentiles that hold 95 %."""
    return [float(q) for q in np.quantile(statistics, [0.025, 0.975])]


def p_values(one: np.ndarray, other: np.ndarray, rng: np.random.Generator) -> dict[str, float]:
    """Of the difference of means and of Kolmogorov-Smirnov's statistic, by permutation of runs."""
    pooled = np.concatenate([one, other])
    order = np.argsort(pooled)
    pooled, first = pooled[order], order < len(one)
    labels = np.vstack([first, rng.permuted(np.tile(first, (RESAMPLES, 1)), axis=1)])
    weights = np.where(labels, 1 / len(one), -1 / len(other))
    ends = np.append(np.diff(pooled) > 0, True)  # equal values count together
    statistics = {
        "means": np.abs(weights @ pooled),
        "distributions": np.abs(weights.cumsum(1)[:, ends]).max(1),
    }
    return {name: float(np.mean(at_least(values))) for name, values in statistics.items()}


def at_least(statistics: np.ndarray) -> np.ndarray:
    """Which reach the first, the one that was observed; rounding must not part what is equal."""
    return statistics >= statistics[0] - 1e-9 * max(1.0, statistics[0])


def compare(one: np.ndarray, other: np.ndarray) -> dict[str, Any]:
    """Two samples of runs with different seeds."""
    rng = np.random.default_rng(0)
    intervals = [interval(iqm(resampled(values, rng))) for values in (one, other)]
    low, high = interval(resampled(other, rng).mean(1) - resampled(one, rng).mean(1))
    return {
        "iqm": [float(iqm(one)), float(iqm(other))],
        "intervals": intervals,
        "intervals_overlap": max(a for a, _ in intervals) <= min(b for _, b in intervals),
        "p": p_values(one, other, rng),
        "difference_percent": 100 * float(other.mean() / one.mean() - 1),
        "half_width_percent": 50 * (high - low) / float(one.mean()),
    }


def compare_pairs(sb3: np.ndarray, population: np.ndarray) -> dict[str, float]:
    """Runs of the same seeds; the test flips the signs of their differences."""
    differences = population - sb3
    signs = np.random.default_rng(0).choice([-1, 1], (RESAMPLES, len(differences)))
    means = np.abs(np.vstack([np.ones_like(differences), signs]) @ differences)
    return {
        "difference_percent": 100 * float(differences.mean() / sb3.mean()),
        "p": float(np.mean(at_least(means))),
        "median": float(np.median(differences)),
        "median_absolute": float(np.median(np.abs(differences))),
        "max_absolute": float(np.abs(differences).max()),
        "equal": int((differences == 0).sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("data/bench/learning"))
    parser.add_argument("--runs", type=int, default=20, help="in each sample")
    parser.add_argument("--timesteps", type=int, default=61_440)
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    args = parser.parse_args()
    same, other = range(args.runs), range(1000, 1000 + args.runs)
    recipes = [
        recipe_of("population", [*same, *other], args.timesteps),
        recipe_of("sb3", same, args.timesteps),
    ]
    population, sb3 = (collected(r, args.out / r.collect.collector) for r in recipes)
    learning = [curves(sb3, same), curves(population, other), curves(population, same)]
    theirs, ours, twins = (measures(*curve) for curve in learning)
    result = {
        "env": recipes[0].ppo.env_id,
        "units": list(recipes[0].ppo.net_arch),
        "timesteps": args.timesteps,
        "seeds": {"SB3": [same[0], same[-1]], "population": [other[0], other[-1]]},
        "episodes": EPISODES,
        "resamples": RESAMPLES,
        "thresholds": list(THRESHOLDS),
        "never": {
            "SB3": never(learning[0][1]),
            "population": never(learning[1][1]),
            "population, same seeds": never(learning[2][1]),
        },
        "samples": {name: compare(theirs[name], ours[name]) for name in theirs},
        "control": {name: compare(twins[name], ours[name]) for name in theirs},
        "same_seeds": {name: compare_pairs(theirs[name], twins[name]) for name in theirs},
    }
    print(json.dumps(result, indent=1))
    if args.save:
        save("learning", result)


if __name__ == "__main__":
    main()
