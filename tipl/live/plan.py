"""The plan of a study: arms, seeds, tasks and thresholds, in one TOML file.

It is written before anything runs. An arm with a grid is tuned: every point of the grid is a trial
on the tuning seeds, and the best one runs on the test seeds.
"""

from __future__ import annotations

import itertools
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, Literal

import msgspec

from tipl.errors import EvaluateError
from tipl.live.config import JumpConfig
from weighttraj.collect.population import check_config
from weighttraj.collect.ppo import PPOConfig
from weighttraj.collect.recipe import read_recipe
from weighttraj.collect.settings import parse_seeds
from weighttraj.errors import CollectError, WeightTrajError

Stage = Literal["tuning", "test"]


class Seeds(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Seeds of each stage, as recipes name them: a list or ranges such as ``"0:30"``."""

    tuning: list[int] | str
    """Seeds that settings are chosen on."""
    test: list[int] | str
    """Seeds that only results are computed on."""


class Evaluation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the return J of a policy is measured; these episodes are no environment steps."""

    every: int = 2
    """Number of iterations from one evaluation to the next."""
    episodes: int = 5
    """Number of episodes of each evaluation."""
    deterministic: bool = False
    """Whether actions are the distribution's mode, else samples."""
    seed: int = 1_000_000
    """Seed of the first episode."""
    smooth: int = 3
    """Number of evaluations in the running mean that must reach a threshold."""
    last: float = 0.1
    """Share of the evaluations, at the end of training, whose mean is the final return."""


class Task(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One task."""

    recipe: str
    """Recipe with the environment, the network and PPO's settings; relative to the plan."""
    total_timesteps: int | None = None
    """Environment steps of a training; unset: the recipe's."""
    names: dict[str, str] = {}
    """What ``{key}`` in the name of a forecaster stands for on this task."""
    evaluation: dict[str, Any] = {}
    """Settings of the evaluation that differ on this task."""


class Arm(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One way to train."""

    about: str = ""
    """What the arm is, in one line."""
    learning_rate: float = 1.0
    """Factor of the learning rate."""
    forecaster: str = ""
    """Forecaster that the training jumps by, as ``tipl.load`` takes it; empty: no jumps."""
    jump: dict[str, Any] = {}
    """Settings of ``JumpConfig``."""
    grid: dict[str, list[Any]] = {}
    """Values to be tried of ``learning_rate``, or of settings of ``JumpConfig``."""
    tasks: list[str] = []
    """Tasks of the arm; empty: all."""


class Trial(msgspec.Struct, frozen=True, kw_only=True):
    """An arm with all its settings."""

    arm: str
    name: str
    """Name of the arm, and the values of the grid."""
    learning_rate: float
    forecaster: str
    jump: JumpConfig

    @property
    def folder(self) -> Path:
        """Folder of its trainings; no name in it has a colon, which Windows does not allow."""
        return Path(*self.name.split(":"))


class Plan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A study."""

    id: str
    """Name of the study."""
    seeds: Seeds
    tasks: dict[str, Task]
    arms: dict[str, Arm]
    baseline: str = "ppo"
    """Arm whose final return gives the thresholds, and that all are compared with."""
    rival: str = ""
    """Another arm that all are compared with; empty: none."""
    thresholds: tuple[float, ...] = (0.5, 0.75, 0.9, 0.95)
    """Shares of the baseline's final return."""
    population: int = 8
    """Number of seeds that are trained together in one process."""
    bootstrap: int = 2000
    """Number of resamples for intervals."""
    evaluation: Evaluation = Evaluation()

    def trials(self, task: str) -> dict[str, list[Trial]]:
        """Return the trials of each arm on a task."""
        names = self.tasks[task].names
        return {
            name: list(_trials(name, arm, names))
            for name, arm in self.arms.items()
            if not arm.tasks or task in arm.tasks
        }

    def evaluation_of(self, task: str) -> Evaluation:
        """Return how policies of a task are evaluated."""
        settings = msgspec.to_builtins(self.evaluation) | self.tasks[task].evaluation
        return msgspec.convert(settings, Evaluation)

    def seeds_of(self, stage: Stage) -> list[int]:
        """Return the seeds of a stage."""
        return parse_seeds(getattr(self.seeds, stage))


def read_plan(file: Path) -> Plan:
    """Read a plan.

    Raises:
        FileNotFoundError: there is no such file.
        EvaluateError: it is no plan; the message says why.
    """
    try:
        plan = msgspec.convert(tomllib.loads(file.read_text(encoding="utf-8")), Plan)
        _check(plan)
        return plan
    except (ValueError, WeightTrajError, RecursionError) as error:
        raise EvaluateError(
            "the plan of the study is invalid",
            expected="seeds, tasks and arms, as docs/jump-ahead.md describes them",
            got=error,
            where=file,
            do="correct the file",
        ) from error


def ppo_of(plan: Plan, task: str, folder: Path) -> tuple[PPOConfig, int]:
    """Return PPO's settings on a task, and the gradient steps between its recipe's snapshots."""
    recipe = read_recipe(folder / plan.tasks[task].recipe)
    steps = plan.tasks[task].total_timesteps or recipe.ppo.total_timesteps
    return replace(recipe.ppo, total_timesteps=steps), recipe.store.every


def check_task(plan: Plan, task: str, folder: Path) -> None:
    """Check that the trainings of a task can be done by populations, as those of a study are.

    Raises:
        EvaluateError: they cannot.
    """
    config, _ = ppo_of(plan, task, folder)
    try:
        check_config(config)
    except CollectError as error:
        raise EvaluateError(
            "a study trains populations, which cannot do what the recipe asks for",
            expected="a planar MuJoCo task and settings that the population collector takes",
            got=str(error),
            where=folder / plan.tasks[task].recipe,
            do="change the recipe, or compare trainings with ForecastCallback in a script",
        ) from error


def _check(plan: Plan) -> None:
    """Raise ValueError if something in a plan does not fit together."""
    for name in filter(None, (plan.baseline, plan.rival)):
        if name not in plan.arms:
            raise ValueError(f"no arm {name!r}; there are {', '.join(plan.arms)}")
    if not plan.thresholds or min(plan.thresholds) <= 0 or plan.bootstrap < 1:
        raise ValueError("thresholds are shares above 0, and bootstrap is at least 1")
    _check_seeds(plan.seeds_of("tuning"), plan.seeds_of("test"))
    for name, arm in plan.arms.items():
        _check_arm(plan, name, arm)
        if missing := {*arm.tasks} - {*plan.tasks}:
            raise ValueError(f"arm {name!r}: no tasks {sorted(missing)}")
    for task in plan.tasks:
        _check_name("task", task)
        evaluation = plan.evaluation_of(task)
        if min(evaluation.every, evaluation.episodes, evaluation.smooth, plan.population) < 1:
            raise ValueError("every, episodes, smooth and population are at least 1")
        plan.trials(task)


def _check_arm(plan: Plan, name: str, arm: Arm) -> None:
    _check_name("arm", name)
    for key, values in arm.grid.items():
        told = [str(value) for value in values]
        if not values or len({*told}) < len(told):
            raise ValueError(f"arm {name!r}: the grid's {key} has no value, or one twice")
    rates = [arm.learning_rate, *arm.grid.get("learning_rate", [])]
    if not all(isinstance(rate, int | float) and rate > 0 for rate in rates):
        raise ValueError(f"arm {name!r}: a factor of the learning rate is not above 0")
    if name == plan.baseline and (arm.grid or {*plan.tasks} - {*(arm.tasks or plan.tasks)}):
        raise ValueError(f"arm {name!r} is the baseline: it runs on all tasks, without a grid")


def _check_name(what: str, name: str) -> None:
    # It names a folder beside the files of results.
    if re.fullmatch(r"\w[\w.-]*", name) is None or name.endswith((".json", ".csv", ".svg")):
        raise ValueError(
            f"{what} {name!r}: a name has letters, digits, '_', '-' and '.' only, and does not end "
            "like a file"
        )


def _check_seeds(tuning: Sequence[int], test: Sequence[int]) -> None:
    if both := {*tuning} & {*test}:
        raise ValueError(f"seeds {sorted(both)} are for tuning and for the test")
    for stage, seeds in (("tuning", tuning), ("test", test)):
        if twice := sorted({seed for seed in seeds if seeds.count(seed) > 1}):
            raise ValueError(f"seeds {twice} stand twice in those for {stage}")


def _trials(name: str, arm: Arm, names: Mapping[str, str]) -> Iterator[Trial]:
    known = {"learning_rate", *(field.name for field in fields(JumpConfig))}
    if unknown := ({*arm.grid} | {*arm.jump}) - known:
        raise ValueError(f"arm {name!r}: no settings {sorted(unknown)}; there are {sorted(known)}")
    forecaster = arm.forecaster
    for key, value in names.items():
        forecaster = forecaster.replace(f"{{{key}}}", value)
    for values in itertools.product(*arm.grid.values()):
        chosen = dict(zip(arm.grid, values, strict=True))
        label = ",".join(f"{key}={_word(value)}" for key, value in chosen.items())
        rate = chosen.pop("learning_rate", arm.learning_rate)
        yield Trial(
            arm=name,
            name=f"{name}:{label}" if label else name,
            learning_rate=float(rate),
            forecaster=forecaster,
            jump=msgspec.convert(arm.jump | chosen, JumpConfig),
        )


def settings_of(trial: Trial) -> dict[str, Any]:
    """Return what distinguishes a trial from plain PPO, for tables and result files."""
    found: dict[str, Any] = {"learning_rate": trial.learning_rate}
    if trial.forecaster:
        default = asdict(JumpConfig())
        changed = {k: v for k, v in asdict(trial.jump).items() if v != default[k] or k == "horizon"}
        found |= {"forecaster": trial.forecaster, **changed}
    return found


def _word(value: Any) -> str:
    return "-".join(map(_word, value)) if isinstance(value, list) else str(value)
