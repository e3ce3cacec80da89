"""Gymnasium's running normalisers, for many learners at once and with the same numbers.

Every number equals, bit by bit, that of ``gymnasium.wrappers.NormalizeObservation`` and
``NormalizeReward`` (gymnasium 1.x) around each learner's environment: the updates are Gymnasium's
own function, on arrays with one row a learner.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.wrappers.utils import update_mean_var_count_from_moments

from weighttraj.format.writer import Moments

_combine: Callable[..., Any] = update_mean_var_count_from_moments
_COUNT = 1e-4
_EPSILON = 1e-8


class ObservationStatistics:
    """Mean and variance of each learner's observations, and observations made with them.

    Args:
        observations: the first of each learner, float64 (learner, *obs).
        bound: normalised observations are clipped to ``[-bound, bound]``.
    """

    def __init__(self, observations: np.ndarray, bound: float) -> None:
        # Gymnasium begins in float32; the first float64 observation makes it float64.
        shape = observations.shape
        mean, var = np.zeros(shape, np.float32), np.ones(shape, np.float32)
        self.mean, self.var, count = _combine(mean, var, _COUNT, observations, 0.0, 1)
        self.count = np.full((shape[0], *(1 for _ in shape[1:])), count)
        self._bound = bound

    def update(self, observations: np.ndarray, learners: np.ndarray | slice) -> None:
        """Take in one observation of each of some learners."""
        before = (x[learners] for x in (self.mean, self.var, self.count))
        mean, var, count = _combine(*before, observations, 0.0, 1)
        self.mean[learners], self.var[learners], self.count[learners] = mean, var, count

    def normalize(self, observations: np.ndarray, learners: np.ndarray | slice) -> np.ndarray:
        """Network inputs of some learners, float32 in the shape of the observations."""
        mean, var = self.mean[learners], self.var[learners]
        inputs = ((observations - mean) / np.sqrt(var + _EPSILON)).astype(np.float32)
        return np.asarray(np.clip(inputs, -self._bound, self._bound, out=inputs))

    def of(self, learner: int) -> Moments:
        """A copy of one learner's statistics."""
        mean, var = self.mean[learner].copy(), self.var[learner].copy()
        return mean, var, float(self.count[learner].item())


class RewardStatistics:
    """Variance of each learner's discounted rewards, and rewards scaled with it.

    Args:
        learners: number of learners.
        gamma: discount.
        bound: scaled rewards are clipped to ``[-bound, bound]``.
    """

    def __init__(self, learners: int, gamma: float, bound: float) -> None:
        self.mean, self.var = np.zeros(learners), np.ones(learners)
        self.count = _COUNT  # one for all: they step together
        self._discounted = np.zeros(learners)
        self._gamma = gamma
        self._bound = bound

    def scale(self, rewards: np.ndarray, terminated: np.ndarray) -> np.ndarray:
        """Take in a step's rewards and scale them, float64 (learner,).

        Args:
            rewards: float64 (learner,).
            terminated: bool (learner,): the episode ended in a terminal state.
        """
        self._discounted = self._discounted * self._gamma * (1 - terminated) + rewards
        self.mean, self.var, self.count = _combine(
            self.mean, self.var, self.count, self._discounted, 0.0, 1
        )
        scaled = rewards / np.sqrt(self.var + _EPSILON)
        return np.asarray(np.clip(scaled, -self._bound, self._bound, out=scaled))

    def of(self, learner: int) -> Moments:
        """A copy of one learner's statistics."""
        mean, var = (np.array(x[learner]) for x in (self.mean, self.var))
        return mean, var, float(self.count)
