"""Two environment wrappers that Gymnasium lacks."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np


class ClipObservation(
    gym.ObservationWrapper[np.ndarray, Any, np.ndarray], gym.utils.RecordConstructorArgs
):
    """Clips observations, with bounds that a collector can read (a lambda's cannot be).

    Args:
        env: environment with array observations.
        low: lower bound, inclusive.
        high: upper bound, inclusive.
    """

    def __init__(
        self, env: gym.Env[np.ndarray, Any], low: float = -10.0, high: float = 10.0
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, low=low, high=high)
        gym.ObservationWrapper.__init__(self, env)
        self.low, self.high = low, high

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Return the clipped observation, same shape and type."""
        return np.asarray(np.clip(observation, self.low, self.high))


class TruncationAsTermination(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Reports a time limit as the end of the episode.

    SB3 adds the critic's value of the last observation to the reward at a time limit; CleanRL does
    not. Outermost, around everything that treats the two ends differently, this makes them equal.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take one step; ``truncated`` is always False."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or truncated, False, info
