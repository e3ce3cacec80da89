"""One arm on one task with some seeds, trained in lockstep: what a worker of a study does."""

from __future__ import annotations

import hashlib
import time
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from tipl.errors import EvaluateError
from tipl.live.path import forecaster_of
from tipl.live.plan import Evaluation, Trial
from tipl.live.population import PopulationJumps
from tipl.live.results import Cpu, Curve
from tipl.saved import fingerprint
from tipl.threads import threads
from weighttraj import RunInfo
from weighttraj.atomic import acquired, lock_of, replace_file
from weighttraj.collect.agents import find_agent
from weighttraj.collect.describe import describe_run
from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.population import Boundary, Origin, Population, origins_of
from weighttraj.collect.ppo import PPOConfig
from weighttraj.collect.settings import Store
from weighttraj.engine import Tell
from weighttraj.format import EnvInfo
from weighttraj.policies import Evaluator, PolicyBatch


class Block(msgspec.Struct, frozen=True, kw_only=True):
    """Trainings to be made; the file says when they are done."""

    file: Path
    task: str
    trial: Trial
    config: PPOConfig
    """PPO's settings on the task, without the trial's factor of the learning rate."""
    every: int
    """Gradient steps between the recipe's snapshots."""
    evaluation: Evaluation
    seeds: list[int]
    fingerprint: str = ""
    """What ``Made.fingerprint`` must be, if the file has one; empty: anything."""

    @property
    def lock(self) -> Path:
        """File that the process holds which trains the block."""
        return self.file.with_name(f".{self.file.name}.lock")

    @property
    def source(self) -> dict[str, Any]:
        """Everything that the trainings depend on."""
        return {
            "task": self.task,
            "trial": msgspec.to_builtins(self.trial) | {"name": "", "arm": ""},
            "config": asdict(self.config),
            "every": self.every,
            "evaluation": msgspec.to_builtins(self.evaluation) | {"smooth": 0, "last": 0},
            "seeds": self.seeds,
        }


class Made(msgspec.Struct, frozen=True, kw_only=True):
    """What a block's file holds."""

    source: dict[str, Any]
    num_timesteps: list[int]
    curves: list[Curve]
    cpu: Cpu
    fingerprint: str = ""
    """SHA-256 of the forecaster's files; empty: there is none, or it was not recorded."""
    checksum: str = ""
    """SHA-256 of the same document with an empty checksum; empty: written by an earlier version."""

    def digest(self) -> str:
        """Return what ``checksum`` must be."""
        document = msgspec.structs.replace(self, checksum="")
        return hashlib.sha256(msgspec.json.encode(document)).hexdigest()


def read_block(block: Block) -> Made | None:
    """Return what a block's file holds; None: not there, or of other settings or forecaster.

    Raises:
        EvaluateError: the file is damaged.
    """
    try:
        made = msgspec.json.decode(block.file.read_bytes(), type=Made)
        if made.checksum and made.checksum != made.digest():
            raise ValueError("other bytes than were written")
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError) as error:
        raise EvaluateError(
            "the file of some trainings is damaged",
            expected="what `tipl live` wrote",
            got=error,
            where=block.file,
            do="restore it from a copy; or delete it, and run this arm of this stage again",
        ) from error
    wanted = msgspec.json.decode(msgspec.json.encode(block.source))
    if made.fingerprint and block.fingerprint not in ("", made.fingerprint):
        return None
    return made if made.source == wanted else None


def make_block(block: Block, tell: Tell) -> None:
    """Train a block and write its file, unless it is there.

    Args:
        block: what is to be done.
        tell: progress callback, called with 1 after each iteration.

    Raises:
        StoreLockedError: another process is training it.
    """
    block.file.parent.mkdir(parents=True, exist_ok=True)
    lock = acquired(
        lock_of(block.lock),
        "another process is training this population",
        where=block.file,
        do="wait until it ends",
    )
    try:
        if read_block(block) is None:
            with threads():
                made = _Training(block, tell).run()
            made = msgspec.structs.replace(made, checksum=made.digest())
            replace_file(block.file, msgspec.json.encode(made) + b"\n")
        block.lock.unlink(missing_ok=True)  # whoever waits for it finds the file
    finally:
        lock.release()


def wait_for(block: Block) -> None:
    """Wait until no other process trains a block."""
    with lock_of(block.lock):
        pass


class _Training:
    """The trainings of a block."""

    def __init__(self, block: Block, tell: Tell) -> None:
        trial, config = block.trial, block.config
        self._block, self._tell = block, tell
        self._config = replace(config, learning_rate=config.learning_rate * trial.learning_rate)
        self._steps: list[int] = []
        self._returns: list[np.ndarray] = []
        self._evaluating = 0.0
        self._fingerprint = ""

    def run(self) -> Made:
        """Train to the end."""
        block, trial = self._block, self._block.trial
        begun = time.process_time()
        origins = origins_of(self._config, block.seeds)
        info = _info_of(origins[0], block.every)
        with ExitStack() as stack:
            population = Population(self._config, origins)
            stack.callback(population.close)
            del origins
            evaluator = self._evaluator(info)
            stack.callback(evaluator.close)
            jumps = None
            if trial.forecaster:
                forecaster = forecaster_of(trial.forecaster)
                self._fingerprint = fingerprint(forecaster)
                clip, count = self._config.clip_range, len(block.seeds)
                jumps = PopulationJumps(
                    population, forecaster, trial.jump, info, clip_range=clip, learners=count
                )

            def hook(boundary: Boundary) -> None:
                if jumps is not None:
                    jumps(boundary)
                is_last = boundary.progress_remaining <= 0
                if boundary.iteration % block.evaluation.every == 0 or is_last:
                    self._evaluate(population, info, evaluator)
                self._tell(1)

            self._evaluate(population, info, evaluator)
            population.train(jumps.watchers if jumps else [], hook=hook)
        spent = time.process_time() - begun
        return self._made(jumps, spent)

    def _evaluator(self, info: RunInfo) -> Evaluator:
        settings = self._block.evaluation
        return Evaluator(cast(EnvInfo, info.env), episodes=settings.episodes, seed=settings.seed)

    def _evaluate(self, population: Population, info: RunInfo, evaluator: Evaluator) -> None:
        """Measure J of all policies as they act now."""
        begun = time.process_time()
        rows = [population.read(learner) for learner in range(len(self._block.seeds))]
        mean, var = (
            None if info.obs_norm is None else np.stack([row["obs_norm"][i] for row in rows])
            for i in (0, 1)
        )
        weights = np.stack([row["weights"] for row in rows])
        policies = PolicyBatch(info.policy, info.layout, weights, info.obs_norm, mean, var)
        deterministic = self._block.evaluation.deterministic
        played = evaluator(policies, deterministic=deterministic)
        self._steps.append(population.num_timesteps)
        self._returns.append(played.returns.mean(1))
        self._evaluating += time.process_time() - begun

    def _made(self, jumps: PopulationJumps | None, spent: float) -> Made:
        returns = np.stack(self._returns, axis=1)  # (seed, evaluation)
        outcomes = [[] for _ in self._block.seeds] if jumps is None else jumps.jumps
        curves = []
        for seed, row, made in zip(self._block.seeds, returns, outcomes, strict=True):
            found = [jump.outcome for jump in made]
            counts = {name: found.count(name) for name in ("accepted", "refused", "undone")}
            values = [float(f"{value:.6g}") if np.isfinite(value) else None for value in row]
            curves.append(Curve(seed=seed, returns=values, **counts))
        return Made(
            source=self._block.source,
            num_timesteps=self._steps,
            curves=curves,
            cpu=Cpu(
                training=spent - self._evaluating,
                forecasts=jumps.seconds if jumps else 0.0,
                evaluation=self._evaluating,
            ),
            fingerprint=self._fingerprint,
        )


def _info_of(origin: Origin, every: int) -> RunInfo:
    """Return the metadata that a run of this training would have."""
    model = origin.model
    norm = find_normalizers(cast(VecEnv, model.get_env()))
    return describe_run(find_agent(model), norm, "live", Store(every=every))
