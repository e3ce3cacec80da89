"""Trains and records runs in one process: one by SB3, or a block of them as a population."""

from __future__ import annotations

import contextlib
import itertools
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from weighttraj.atomic import refuse_link
from weighttraj.collect.agents import find_agent
from weighttraj.collect.callback import WeightTrajectoryCallback
from weighttraj.collect.describe import describe_algorithm, describe_run
from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.population import Origin, Population, origins_of
from weighttraj.collect.ppo import make_ppo
from weighttraj.collect.recipe import Recipe
from weighttraj.collect.recorder import Recorder
from weighttraj.collect.settings import Store
from weighttraj.errors import CollectError
from weighttraj.store.zarr_run import read_info
from weighttraj.threads import one_torch_thread
from weighttraj.tools.pack import pack

Report = Callable[[int, int], None]
"""Called with a seed and its environment steps so far."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One run to be made: idempotent, so that it may be done again after a failure."""

    recipe: Recipe
    seed: int
    path: Path


Failure = tuple[Task, BaseException]
"""A run that failed, and why."""


def blocks_of(tasks: Sequence[Task], workers: int) -> list[list[Task]]:
    """Tasks that are done together in one process: one for SB3, a population's worth otherwise.

    Blocks are of equal size, and as many as keep every worker busy. How runs are grouped does not
    move their bits.
    """
    if not tasks:
        return []
    together = tasks[0].recipe.collect.block
    rounds = -(-len(tasks) // (together * workers))
    count = min(len(tasks), rounds * workers)
    bounds = [len(tasks) * i // count for i in range(count + 1)]
    return [list(tasks[start:stop]) for start, stop in itertools.pairwise(bounds)]


def collect_block(tasks: Sequence[Task], report: Report) -> list[Failure]:
    """Collect some runs in this process; return those that failed, the others are packed.

    One thread: the thread count moves the bits.

    Raises:
        CollectError: the data set is not here.
        KeyboardInterrupt: it was stopped; what was recorded is committed.
    """
    failures: list[Failure] = []
    unfinished = []
    _check_folder(tasks[0].path.parents[1])
    for task in tasks:
        with _noted(task, failures):
            refuse_link(task.path, task.path.parents[1])
            unfinished += [] if _is_complete(task.path) else [task]
    with one_torch_thread():
        if tasks[0].recipe.collect.collector == "population":
            failures += _train_together(unfinished, report)
        else:
            for task in unfinished:
                with _noted(task, failures):
                    _train(task, report)
    failed = {task.seed for task, _ in failures}
    for task in tasks:
        if task.seed not in failed:
            with _noted(task, failures):
                pack(task.path, profile=task.recipe.store.profile)
    return failures


def open_recorder(
    population: Population,
    learner: int,
    origin: Origin,
    path: Path,
    store: Store,
    *,
    resume: bool = False,
) -> Recorder:
    """Begin to record a learner; it has not been trained yet.

    Args:
        population: that it belongs to.
        learner: which.
        origin: where it begins.
        path: folder of the run.
        store: what is stored.
        resume: continue an interrupted run.

    Raises:
        StoreExistsError: the path exists, and ``resume`` is False.
        StoreLockedError: another process is writing this run.
        FormatError: the run at the path was started with other settings.
        ReplayError: it begins otherwise.
    """
    model, agent = origin.model, find_agent(origin.model)
    norm = find_normalizers(cast(VecEnv, model.get_env()))
    info = describe_run(agent, norm, path.name.removesuffix(".zarr"), store)
    return Recorder(
        path,
        replace(info, algorithm=describe_algorithm(agent, "weighttraj's population")),
        lambda: population.read(learner, critic=store.critic, moments=store.optimizer_moments),
        every=store.every,
        steps_per_epoch=model.n_steps // model.batch_size,
        resume=resume,
    )


def _train(task: Task, report: Report) -> None:
    """Train and record one run by SB3."""
    config, settings = task.recipe.ppo, asdict(task.recipe.store)
    del settings["profile"]  # of the packed run
    with WeightTrajectoryCallback(task.path, **settings, resume=True) as callback:
        model = make_ppo(config, seed=task.seed)
        progress = _ProgressCallback(task.seed, report)
        model.learn(config.n_iterations * config.n_steps, callback=[callback, progress])


def _train_together(tasks: Sequence[Task], report: Report) -> list[Failure]:
    """Train and record some runs as a population."""
    if not tasks:
        return []
    followers: list[_Follower] = []
    try:
        with contextlib.ExitStack() as stack:
            config = tasks[0].recipe.ppo
            origins = origins_of(config, [task.seed for task in tasks])
            population = Population(config, origins)
            stack.callback(population.close)
            for i, (task, origin) in enumerate(zip(tasks, origins, strict=False)):
                followers.append(_Follower(task, population, i, origin, report))
                stack.callback(followers[-1].close)
            del origins, origin  # their models are not needed any more
            population.train(followers, lambda: all(f.error for f in followers))
    except Exception as error:  # the error affects every run of the block
        return [(task, error) for task in tasks]
    return [(f.task, f.error) for f in followers if f.error is not None]


class _Follower:
    """Records one learner of a population. If that fails, the others go on."""

    def __init__(
        self, task: Task, population: Population, learner: int, origin: Origin, report: Report
    ) -> None:
        self.task = task
        self.error: Exception | None = None
        self._population = population
        self._report = report
        self._recorder: Recorder | None = None
        try:
            self._recorder = open_recorder(
                population, learner, origin, task.path, task.recipe.store, resume=True
            )
        except Exception as error:
            self.error = error

    def end_rollout(self, returns: Sequence[Any], inputs: np.ndarray) -> None:
        """See ``Recorder``."""
        self._do(lambda recorder: recorder.end_rollout(returns, inputs))
        if self.error is None:
            self._report(self.task.seed, self._population.num_timesteps)

    def end_gradient_step(self) -> None:
        """See ``Recorder``."""
        self._do(lambda recorder: recorder.end_gradient_step())

    def end_update(self, diagnostics: Mapping[str, float]) -> None:
        """See ``Recorder``."""
        self._do(lambda recorder: recorder.end_update(diagnostics))

    def end_training(self, diagnostics: Mapping[str, float]) -> None:
        """See ``Recorder``."""
        self._do(lambda recorder: recorder.end_training(diagnostics))

    def close(self) -> None:
        """Commit what is left."""
        if self._recorder is not None:
            self._recorder.close()

    def _do(self, action: Callable[[Recorder], None]) -> None:
        if self.error is None and self._recorder is not None:
            try:
                action(self._recorder)
            except Exception as error:
                self.error = error
                with contextlib.suppress(Exception):
                    self.close()


class _ProgressCallback(BaseCallback):
    def __init__(self, seed: int, report: Report) -> None:
        super().__init__()
        self._seed, self._report = seed, report

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._report(self._seed, self.num_timesteps)


def _check_folder(path: Path) -> None:
    if not (path / "dataset.json").is_file():
        raise CollectError(
            "this machine does not see the data set",
            expected="dataset.json, as whoever gave the task has written it",
            where=f"{path} on {platform.node()}",
            do="collect into a folder that all machines share, at the same path",
        )


def _is_complete(path: Path) -> bool:
    return path.exists() and read_info(path).status == "complete"


@contextlib.contextmanager
def _noted(task: Task, failures: list[Failure]) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        failures.append((task, error))
