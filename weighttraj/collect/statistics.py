"""Gymnasium's and SB3's running normalisers, for many learners at once and with the same numbers.

Every number equals, bit by bit, that of ``gymnasium.wrappers.NormalizeObservation`` and
``NormalizeReward`` (gymnasium 1.x), or of SB3's ``VecNormalize`` (2.x), around each learner's
environment: the updates are Gymnasium's own function, on arrays with one row a learner. SB3
computes the same expressions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from gymnasium.wrappers.utils import update_mean_var_count_from_moments

from weighttraj.writer import Moments

_BOUND = 10.0
"""Normalised observations and scaled rewards are clipped to ``[-_BOUND, _BOUND]``."""
_combine: Callable[..., Any] = update_mean_var_count_from_moments
_COUNT = 1e-4
_EPSILON = 1e-8


class ObservationStatistics:
    """Mean and variance of each learner's observations, and observations made with them.

    Args:
        observations: the first of each learner, float64 (learner, *obs).
        dtype: of the statistics before they have seen an observation; float64 ever after.
    """

    def __init__(self, observations: np.ndarray, dtype: type[np.floating[Any]]) -> None:
        shape = observations.shape
        mean, var = np.zeros(shape, dtype), np.ones(shape, dtype)
        self.mean, self.var, count = _combine(mean, var, _COUNT, observations, 0.0, 1)
        self.count = np.full((shape[0], *(1 for _ in shape[1:])), count)

    def update(self, observations: np.ndarray, learners: np.ndarray | slice) -> None:
        """Take in one observation of each of some learners."""
        before = (x[learners] for x in (self.mean, self.var, self.count))
        mean, var, count = _combine(*before, observations, 0.0, 1)
        self.mean[learners], self.var[learners], self.count[learners] = mean, var, count

    def normalize(self, observations: np.ndarray, learners: np.ndarray | slice) -> np.ndarray:
        """Return network inputs of some learners, float32 in the shape of the observations."""
        mean, var = self.mean[learners], self.var[learners]
        inputs = ((observations - mean) / np.sqrt(var + _EPSILON)).astype(np.float32)
        return np.asarray(np.clip(inputs, -_BOUND, _BOUND, out=inputs))

    def of(self, learner: int) -> Moments:
        """Return a copy of one learner's statistics."""
        mean, var = self.mean[learner].copy(), self.var[learner].copy()
        return mean, var, float(self.count[learner].item())

    def restore(self, learner: int, statistics: Moments) -> None:
        """Put one learner's statistics back to what ``of`` returned."""
        self.mean[learner], self.var[learner], self.count[learner] = statistics


class RewardStatistics:
    """Variance of each learner's discounted rewards, and rewards scaled with it.

    Args:
        learners: number of learners.
        gamma: discount.
    """

    def __init__(self, learners: int, gamma: float) -> None:
        self.mean, self.var = np.zeros(learners), np.ones(learners)
        self.count = np.full(learners, _COUNT)
        self.discounted = np.zeros(learners)
        self._gamma = gamma

    def scale(self, rewards: np.ndarray) -> np.ndarray:
        """Take in a step's rewards and scale them, float64 (learner,).

        Args:
            rewards: float32 or float64 (learner,).
        """
        self.discounted = self.discounted * self._gamma + rewards
        self.mean, self.var, self.count = _combine(
            self.mean, self.var, self.count, self.discounted, 0.0, 1
        )
        scaled = rewards / np.sqrt(self.var + _EPSILON)
        return np.asarray(np.clip(scaled, -_BOUND, _BOUND, out=scaled))

    def of(self, learner: int) -> Moments:
        """Return a copy of one learner's statistics."""
        mean, var = (np.array(x[learner]) for x in (self.mean, self.var))
        return mean, var, float(self.count[learner])

    def restore(self, learner: int, statistics: Moments) -> None:
        """Put one learner's statistics back to what ``of`` returned."""
        self.mean[learner], self.var[learner], self.count[learner] = statistics


class Normalizer(Protocol):
    """Makes network inputs and scaled rewards of what the environments of all learners give.

    Made from the first observation of each learner, float64 (learner, obs), and the discount.
    """

    returns_dtype: type[np.floating[Any]]
    """Type in which the rewards of an episode are summed for its return."""
    inputs: np.ndarray
    """What the agents see now, float32 (learner, obs)."""
    last_inputs: np.ndarray
    """What they would have seen of the observations that ended an episode in the last step, float32
    (ended learner, obs)."""

    def observe(self, observations: np.ndarray, ended: np.ndarray, first: np.ndarray) -> None:
        """Take in a step's observations.

        Args:
            observations: float64 (learner, obs); may be overwritten.
            ended: learners whose episode has ended, ascending.
            first: the first observations of their next episodes, float64 (ended learner, obs).
        """

    def scale(self, rewards: np.ndarray, terminated: np.ndarray, done: np.ndarray) -> np.ndarray:
        """Take in a step's rewards and scale them.

        Args:
            rewards: float64 (learner,).
            terminated: bool (learner,): the episode ended in a terminal state.
            done: bool (learner,): it ended there or at the time limit.
        """

    def obs_norm(self, learner: int) -> Moments | None:
        """Return a copy of the statistics of a learner's observations, if there are any."""

    def ret_norm(self, learner: int) -> Moments | None:
        """Return a copy of the statistics of a learner's discounted rewards, if there are any."""

    def restore(self, learner: int, obs_norm: Moments | None, ret_norm: Moments | None) -> None:
        """Put a learner's statistics back to what ``obs_norm`` and ``ret_norm`` returned."""


class NoNormalizer:
    """Observations and rewards as the environment gives them. See ``Normalizer``."""

    returns_dtype: type[np.floating[Any]] = np.float32  # as SB3's VecMonitor

    def __init__(self, first: np.ndarray, gamma: float) -> None:
        self.inputs = first.astype(np.float32)
        self.last_inputs = self.inputs[:0]

    def observe(self, observations: np.ndarray, ended: np.ndarray, first: np.ndarray) -> None:
        """See ``Normalizer``."""
        self.last_inputs = observations[ended].astype(np.float32)
        observations[ended] = first
        self.inputs = observations.astype(np.float32)

    def scale(self, rewards: np.ndarray, terminated: np.ndarray, done: np.ndarray) -> np.ndarray:
        """See ``Normalizer``."""
        return rewards

    def obs_norm(self, learner: int) -> Moments | None:
        """See ``Normalizer``."""
        return None

    def ret_norm(self, learner: int) -> Moments | None:
        """See ``Normalizer``."""
        return None

    def restore(self, learner: int, obs_norm: Moments | None, ret_norm: Moments | None) -> None:
        """See ``Normalizer``."""


class _RunningNormalizer:
    """What Gymnasium's and SB3's normalisers have in common."""

    dtype: type[np.floating[Any]]
    """Of the statistics before the first observation."""

    def __init__(self, first: np.ndarray, gamma: float) -> None:
        self._observations = ObservationStatistics(first, self.dtype)
        self._rewards = RewardStatistics(len(first), gamma)
        self.inputs = self._observations.normalize(first, slice(None))
        self.last_inputs = self.inputs[:0]

    def obs_norm(self, learner: int) -> Moments | None:
        """See ``Normalizer``."""
        return self._observations.of(learner)

    def ret_norm(self, learner: int) -> Moments | None:
        """See ``Normalizer``."""
        return self._rewards.of(learner)

    def restore(self, learner: int, obs_norm: Moments | None, ret_norm: Moments | None) -> None:
        """See ``Normalizer``."""
        if obs_norm is not None and ret_norm is not None:
            self._observations.restore(learner, obs_norm)
            self._rewards.restore(learner, ret_norm)


class GymnasiumNormalizer(_RunningNormalizer):
    """Gymnasium's wrappers in CleanRL's order, see ``ppo.make_env`` and ``Normalizer``."""

    returns_dtype: type[np.floating[Any]] = np.float64
    dtype = np.float32

    def observe(self, observations: np.ndarray, ended: np.ndarray, first: np.ndarray) -> None:
        """See ``Normalizer``. The observation that ends an episode is counted, too."""
        statistics, everyone = self._observations, slice(None)
        statistics.update(observations, everyone)
        self.inputs = statistics.normalize(observations, everyone)
        if len(ended):
            self.last_inputs = self.inputs[ended]
            statistics.update(first, ended)
            self.inputs[ended] = statistics.normalize(first, ended)

    def scale(self, rewards: np.ndarray, terminated: np.ndarray, done: np.ndarray) -> np.ndarray:
        """See ``Normalizer``. Gymnasium drops the sum before it adds the last reward."""
        self._rewards.discounted *= 1 - terminated
        return self._rewards.scale(rewards)


class VecNormalizer(_RunningNormalizer):
    """SB3's ``VecNormalize``, see ``Normalizer``."""

    returns_dtype: type[np.floating[Any]] = np.float32  # as SB3's VecMonitor
    dtype = np.float64

    def observe(self, observations: np.ndarray, ended: np.ndarray, first: np.ndarray) -> None:
        """See ``Normalizer``. The next episode's first observation is counted instead."""
        last = observations[ended]
        observations[ended] = first
        self._observations.update(observations, slice(None))
        self.inputs = self._observations.normalize(observations, slice(None))
        if len(ended):
            self.last_inputs = self._observations.normalize(last, ended)

    def scale(self, rewards: np.ndarray, terminated: np.ndarray, done: np.ndarray) -> np.ndarray:
        """See ``Normalizer``. SB3 drops the sum after the last reward, at a time limit too."""
        scaled = self._rewards.scale(rewards.astype(np.float32))  # as SB3's DummyVecEnv
        self._rewards.discounted[done] = 0
        return scaled


NORMALIZERS: dict[str, Callable[[np.ndarray, float], Normalizer]] = {
    "gymnasium": GymnasiumNormalizer,
    "vecnormalize": VecNormalizer,
    "none": NoNormalizer,
}
"""Normalizers by their name in a recipe."""
