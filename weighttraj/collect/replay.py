"""Does a stored run come from the training it names? Trains its first snapshots again."""

from __future__ import annotations

import contextlib
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from weighttraj.collect.callback import WeightTrajectoryCallback
from weighttraj.collect.describe import describe_provenance
from weighttraj.collect.population import Population, check_config, origins_of
from weighttraj.collect.ppo import make_ppo
from weighttraj.collect.recipe import Recipe
from weighttraj.collect.settings import Store, parse_seeds
from weighttraj.collect.tasks import open_recorder
from weighttraj.errors import CollectError, WeightTrajError
from weighttraj.opening import open_dataset, open_run
from weighttraj.run import Run
from weighttraj.writer import explain_difference

_MOST_THREADS = 1024


def replay(path: str | Path, n: int, *, seed: int | None = None) -> list[str]:
    """Train the first n snapshots of a run again and compare them with the stored ones.

    Args:
        path: data set that was collected from a recipe.
        n: snapshots to be compared; all of the run's if it has fewer.
        seed: which run; None: the first.

    Returns:
        What differs, in words; an empty list means that every snapshot came out bit by bit.

    Raises:
        CollectError: the data set has no recipe, or no run of this seed.
        RecipeError: there can be no runs of its recipe.
    """
    if n < 1:
        raise CollectError(
            "there is nothing to train again",
            expected="a number of snapshots of at least 1",
            got=n,
            do="choose how many",
        )
    dataset = open_dataset(path)
    runs = [run for run in dataset if seed is None or run.info.seed == seed]
    if not runs or not dataset.info.recipe:
        raise CollectError(
            "there is nothing to train again",
            expected="a data set with its recipe, and a run of the seed",
            got=f"seeds {[run.info.seed for run in dataset]}, "
            f"{'a' if dataset.info.recipe else 'no'} recipe",
            where=path,
            do="choose one of the seeds",
        )
    try:
        recipe = msgspec.convert(dataset.info.recipe, Recipe)
    except msgspec.ValidationError as error:
        raise CollectError(
            "the data set was not collected from a recipe",
            expected="a recipe in dataset.json",
            got=dataset.info.recipe,
            where=path,
            do="verify the data sets that it was made of",
        ) from error
    recipe.check(where=path)
    if runs[0].info.moved_by:
        raise CollectError(
            "the training cannot be done again: more than gradient steps changed its weights",
            expected="a run that was trained by its recipe alone",
            got=f"weights changed by {', '.join(runs[0].info.moved_by)}",
            where=runs[0].path,
            do="choose another run",
        )
    if recipe.collect.collector == "population":
        check_config(recipe.ppo)
    try:
        return _compare(runs[0], recipe, min(n, len(runs[0])))
    except WeightTrajError:
        raise
    except Exception as error:  # the environment's, Gymnasium's, SB3's: the recipe is a stranger's
        raise CollectError(
            "the training that the data set names cannot be done here",
            expected="its recipe, environment and versions",
            got=repr(error),
            where=f"{path}, run {runs[0].id}",
            do="compare run.info.provenance.packages with what is installed",
        ) from error


def _compare(run: Run, recipe: Recipe, n: int) -> list[str]:
    stored = run["digest"][:n]
    with tempfile.TemporaryDirectory() as folder:
        again = _train(run, recipe, n, Path(folder) / f"{run.id}.zarr")["digest"][:n]
    differing = np.flatnonzero((stored[: len(again)] != again).any(axis=1))
    if len(again) == n and not differing.size:
        return []
    first = int(differing[0]) if differing.size else len(again)
    now = replace(describe_provenance(), threads=_threads(run))
    reason = explain_difference(run.info.provenance, now)
    return [
        f"{run.path}: trained again, snapshot {first} of {n} is the first that differs; "
        f"stored {reason}"
    ]


def _threads(run: Run) -> int:
    """Return the number of torch's threads in the training.

    Raises:
        CollectError: no machine has so many; the run's metadata may be a stranger's.
    """
    threads = run.info.provenance.threads or 1
    if not 1 <= threads <= _MOST_THREADS:
        raise CollectError(
            "the training cannot have had so many threads",
            expected=f"from 1 to {_MOST_THREADS}",
            got=threads,
            where=f"{run.path}, provenance.threads",
            do="do not use data from a source that you do not trust",
        )
    return threads


def _train(run: Run, recipe: Recipe, n: int, path: Path) -> Run:
    (seed,) = parse_seeds([run.info.seed or 0])
    threads = torch.get_num_threads()
    torch.set_num_threads(_threads(run))
    steps = recipe.ppo.gradient_steps_per_iteration
    iterations = math.ceil((n - 1) * recipe.store.every / steps)
    train = _by_population if recipe.collect.collector == "population" else _by_sb3
    try:
        # The schedules need the whole length, so the training is cut short, not shortened.
        train(recipe, seed, iterations * recipe.ppo.n_steps, path)
    finally:
        torch.set_num_threads(threads)
    return open_run(path)


def _by_sb3(recipe: Recipe, seed: int, num_timesteps: int, path: Path) -> None:
    config = recipe.ppo
    with WeightTrajectoryCallback(path, every=recipe.store.every, probe_observations=0) as recorder:
        model = make_ppo(config, seed=seed)
        stop = _StopAfter(num_timesteps)
        model.learn(config.n_iterations * config.n_steps, callback=[recorder, stop])


def _by_population(recipe: Recipe, seed: int, num_timesteps: int, path: Path) -> None:
    origins = origins_of(recipe.ppo, [seed])
    store = Store(every=recipe.store.every, probe_observations=0)
    with contextlib.closing(Population(recipe.ppo, origins)) as population:
        recorder = open_recorder(population, 0, origins[0], path, store)
        with contextlib.closing(recorder):
            population.train([recorder], lambda: population.num_timesteps >= num_timesteps)


class _StopAfter(BaseCallback):
    """Ends training in the first rollout after so many environment steps."""

    def __init__(self, num_timesteps: int) -> None:
        super().__init__()
        self._limit = num_timesteps

    def _on_step(self) -> bool:
        return self.num_timesteps <= self._limit
