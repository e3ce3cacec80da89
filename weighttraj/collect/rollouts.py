"""Rollouts of many learners at once: each in its own environment, all in one batch of physics."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from weighttraj import environments
from weighttraj.collect.ppo import PPOConfig
from weighttraj.collect.statistics import NORMALIZERS
from weighttraj.errors import CollectError
from weighttraj.policies.kernels import Kernel, kernel_for
from weighttraj.policies.simulators import Physics, start_of

_EPISODES = 100
"""Episodes whose mean return is reported, as SB3's ``stats_window_size``."""


class Environments:
    """One environment a learner, with the numbers of ``ppo.make_env`` in SB3's ``DummyVecEnv``.

    Resets go through an environment of the learner's own, so that its random numbers are
    Gymnasium's; steps are batched physics, bit by bit Gymnasium's too.

    Args:
        config: which environment, how it is normalised, and the discount.
        seeds: of the first reset, one a learner.

    Raises:
        CollectError: the environment is unknown, or has no batched physics.
    """

    def __init__(self, config: PPOConfig, seeds: Sequence[int]) -> None:
        self._envs = [environments.make(config.env_id) for _ in seeds]
        self._kernels = [check_kernel(env, config.env_id) for env in self._envs]
        self._physics = Physics(self._kernels[0], len(seeds))
        self._limit = _time_limit(self._envs[0])
        self._everyone = np.arange(len(seeds))
        self.action_space = cast(spaces.Box, self._envs[0].action_space)
        first = self._reset(self._everyone, seeds)
        self.normalizer = NORMALIZERS[config.normalization](first, config.gamma)
        """Statistics, and what the agents see now."""
        self.starting = np.ones(len(seeds), bool)
        """Whether that is the first observation of an episode, (learner,)."""
        self.truncated = np.zeros(len(seeds), bool)
        """Whether the episode before was cut off at the time limit, and not terminated."""
        self.returns: list[deque[Any]] = [deque(maxlen=_EPISODES) for _ in seeds]
        """Returns of each learner's last episodes."""
        self.ended: list[list[float]] = [[] for _ in seeds]
        """Returns of the episodes that ended since a reader last cleared the list."""
        self._return = np.zeros(len(seeds), self.normalizer.returns_dtype)
        self._length = np.zeros(len(seeds), np.int64)

    @property
    def inputs(self) -> np.ndarray:
        """What the agents see now, float32 (learner, obs)."""
        return self.normalizer.inputs

    def step(self, actions: np.ndarray) -> np.ndarray:
        """Step every environment; those that end begin again.

        Args:
            actions: float32 (learner, action); clipped here, as SB3 clips them.

        Returns:
            Scaled rewards, (learner,).
        """
        actions = np.clip(actions, self.action_space.low, self.action_space.high)
        # As under Gymnasium, a simulation that breaks down goes on from MuJoCo's own reset.
        step = self._physics.step(self._everyone, actions)
        self._return += step.rewards.astype(self._return.dtype, copy=False)
        self._length += 1
        self.starting = step.terminated | (self._length >= self._limit)
        self.truncated = self.starting & ~step.terminated
        ended = np.flatnonzero(self.starting)
        first = self._restart(ended) if len(ended) else step.observations[:0]
        self.normalizer.observe(step.observations, ended, first)
        return self.normalizer.scale(step.rewards, step.terminated, self.starting)

    def last_inputs(self) -> np.ndarray:
        """Return what the agents would see now if no episode had ended, float32 (learner, obs)."""
        inputs = self.normalizer.inputs.copy()
        inputs[self.starting] = self.normalizer.last_inputs
        return inputs

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()

    def _restart(self, learners: np.ndarray) -> np.ndarray:
        """Begin the next episode of some learners; observations, float64 (learner, obs)."""
        for learner in learners:
            self.returns[learner].append(self._return[learner])
            self.ended[learner].append(float(self._return[learner]))
        self._return[learners], self._length[learners] = 0, 0
        return self._reset(learners, [None] * len(learners))

    def _reset(self, learners: np.ndarray, seeds: Sequence[int | None]) -> np.ndarray:
        """Reset the environments of some learners; observations, float64 (learner, obs)."""
        starts = [
            start_of(self._kernels[learner], self._envs[learner].reset(seed=seed)[0])
            for learner, seed in zip(learners, seeds, strict=True)
        ]
        self._physics.load(learners, starts)
        return np.stack([start.observation for start in starts])


def check_kernel(env: gym.Env[Any, Any], env_id: str) -> Kernel:
    """Return the batched physics of an environment.

    Raises:
        CollectError: it has none.
    """
    kernel = kernel_for(env)
    if kernel is None:
        raise CollectError(
            "a population needs batched physics, and this environment has none",
            expected="one of Gymnasium's planar MuJoCo environments, without further wrappers",
            got=f"{env_id}: {env}",
            do='set collector = "sb3" in [collect]: it takes any environment',
        )
    return kernel


def _time_limit(env: gym.Env[Any, Any]) -> float:
    limit = env.spec.max_episode_steps if env.spec is not None else None
    return limit or float("inf")
