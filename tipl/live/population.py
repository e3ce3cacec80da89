"""Jumps in the trainings of a population: each learner has a path and jumps of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from tipl.forecaster import Forecaster
from tipl.live.config import Jump, JumpConfig
from tipl.live.guards import ReturnWatch, passes_batch, surrogate
from tipl.live.path import EVERY, TrainingPath
from weighttraj import RunInfo
from weighttraj.collect.population import Boundary, LearnerState, Population
from weighttraj.policies import Policy


class PopulationJumps:
    """A hook for ``Population.train``, and its watchers.

    >>> jumps = PopulationJumps(population, forecaster, config, info)  # doctest: +SKIP
    >>> population.train(jumps.watchers, hook=jumps)  # doctest: +SKIP

    Args:
        population: not trained yet.
        forecaster: a causal forecaster.
        config: when, how far and under which guard each learner jumps.
        info: metadata of the runs: layout, policy and cadence.
        clip_range: clip of PPO's surrogate, for the guard ``batch``.
        learners: number of learners that jump, the first ones; None: all.
    """

    def __init__(
        self,
        population: Population,
        forecaster: Forecaster,
        config: JumpConfig,
        info: RunInfo,
        *,
        clip_range: float = 0.2,
        learners: int | None = None,
    ) -> None:
        count = len(population.stack) if learners is None else learners
        self.learners = [
            _Learner(population, i, forecaster, config, info, clip_range) for i in range(count)
        ]
        """Each learner's path and jumps."""

    @property
    def watchers(self) -> Sequence[_Learner]:
        """Watchers that keep the paths."""
        return self.learners

    @property
    def jumps(self) -> list[list[Jump]]:
        """What each learner did so far."""
        return [learner.path.jumps for learner in self.learners]

    @property
    def seconds(self) -> float:
        """CPU time of forecasts and of keeping the paths so far."""
        return sum(learner.path.seconds for learner in self.learners)

    def __call__(self, boundary: Boundary) -> None:
        """Let each learner jump, or take its last jump back."""
        for learner in self.learners:
            learner.at(boundary)


class _Learner:
    """One learner's path and jumps; a watcher of its training."""

    def __init__(
        self,
        population: Population,
        learner: int,
        forecaster: Forecaster,
        config: JumpConfig,
        info: RunInfo,
        clip_range: float,
    ) -> None:
        self._population, self._learner = population, learner
        self._config, self._info, self._clip = config, info, clip_range
        self._watch = ReturnWatch(config)
        self._before: tuple[Jump, LearnerState] | None = None
        self._iteration = 0
        every = info.cadence.every if info.cadence else EVERY
        weights = population.weights(learner)
        self.path = TrainingPath(forecaster, config, info.layout, weights, every=every)
        if info.cadence and (steps := info.cadence.gradient_steps_per_iteration):
            self.path.check_iteration(steps)

    def end_rollout(self, returns: Sequence[Any], inputs: np.ndarray) -> None:
        """See ``Recorder``."""
        self._iteration += 1

    def end_gradient_step(self) -> None:
        """See ``Recorder``."""
        if self.path.end_gradient_step():
            population = self._population
            self.path.append(
                population.weights(self._learner),
                self._iteration,
                population.num_timesteps,
                population.learning_rate,
            )

    def end_update(self, diagnostics: Mapping[str, float]) -> None:
        """See ``Recorder``."""

    def end_training(self, diagnostics: Mapping[str, float]) -> None:
        """See ``Recorder``."""

    def at(self, boundary: Boundary) -> None:
        """Jump, or take the last jump back."""
        now, returns = boundary.weights[self._learner], boundary.returns[self._learner]
        before, self._before = self._before, None
        if before is not None and self._watch.has_fallen(returns):
            jump, state = before
            jump.outcome = "undone"
            self._population.restore(self._learner, state)
            self.path.moved(now, self._population.weights(self._learner))
            return
        self._watch.add(returns)
        proposed = self.path.propose(
            now, boundary.iteration, boundary.num_timesteps, boundary.progress_remaining
        )
        if proposed is not None:
            self._jump(boundary, now, *proposed)

    def _jump(
        self,
        boundary: Boundary,
        now: Float32[np.ndarray, " param"],
        jump: Jump,
        after: Float32[np.ndarray, " param"],
    ) -> None:
        population, guard = self._population, self._config.guard
        self.path.jumps.append(jump)
        if guard == "batch" and not self._passes(boundary, now, after):
            jump.outcome = "refused"
            return
        if guard == "rollout":
            self._before = jump, population.save(self._learner)
        population.write(self._learner, after)
        self.path.moved(now, after)
        if self._config.moments == "reset":
            population.forget_direction(self._learner)

    def _passes(
        self,
        boundary: Boundary,
        now: Float32[np.ndarray, " param"],
        after: Float32[np.ndarray, " param"],
    ) -> bool:
        """Say whether the guard ``batch`` lets the jump happen."""
        rollout, i = boundary.rollout, self._learner
        judge = _judge(self._info, rollout.observations[i], rollout.actions[i])
        (old, log_before), (new, log_after) = judge(now), judge(after)
        kl = float(torch.distributions.kl_divergence(old, new).sum(-1).mean())
        before, later = (
            surrogate(log - rollout.log_probs[i], rollout.advantages[i], self._clip)
            for log in (log_before, log_after)
        )
        return passes_batch(kl, before, later, self._config)


def _judge(
    info: RunInfo, inputs: torch.Tensor, actions: torch.Tensor
) -> Callable[[np.ndarray], tuple[Any, torch.Tensor]]:
    """Return a function from weights to distributions and log-probabilities on a rollout."""

    def judge(weights: np.ndarray) -> tuple[Any, torch.Tensor]:
        distribution: Any = Policy(info.policy, info.layout, weights).distribution(inputs)
        return distribution, distribution.log_prob(actions).sum(-1)

    return judge
