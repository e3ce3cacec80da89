"""Checks that an environment wrapper passes observations and actions through unchanged.

A copy of the wrapper is put around a stand-in for the environment, which returns known observations
and keeps the actions that reach it. The training's own environment is never stepped.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from weighttraj.collect.undisturbed import undisturbed

_STEPS = 64
"""Steps of the trial; the stand-in is reset every so many steps."""
_RESET_EVERY = 16


def is_transparent(wrapper: gym.Wrapper[Any, Any, Any, Any]) -> bool:
    """Whether a wrapper leaves observations and actions as they are. False if it cannot be tried.

    Args:
        wrapper: around one environment. It may change rewards and the ends of episodes.
    """
    kind = type(wrapper)
    if isinstance(wrapper, gym.RewardWrapper) and kind.step is gym.RewardWrapper.step:
        # Its own code sees nothing but the reward.
        return kind.reset is gym.Wrapper.reset and _same_spaces(wrapper, wrapper.env)

    def attempt() -> bool:
        inside = _Inside(wrapper.env)
        around = _around(wrapper, "env", inside)
        return _passes(lambda: around.reset()[0], lambda action: around.step(action)[0], [inside])

    return _same_spaces(wrapper, wrapper.env) and _tried(attempt)


def is_transparent_vec(wrapper: VecEnvWrapper) -> bool:
    """Return the same as ``is_transparent``, for a wrapper around a vectorised environment."""

    def attempt() -> bool:
        venv = DummyVecEnv([partial(_Inside, wrapper.venv, 2 * i) for i in range(wrapper.num_envs)])
        insides = cast(list[_Inside], venv.envs)
        around = _around(wrapper, "venv", venv)
        return _passes(around.reset, lambda actions: around.step(actions)[0], insides, stack=True)

    return _same_spaces(wrapper, wrapper.venv) and _tried(attempt)


def _tried(attempt: Callable[[], bool]) -> bool:
    """Return whether a trial succeeds, and raises nothing."""
    with undisturbed():
        try:
            return attempt()
        except Exception:  # the code of a stranger may raise anything
            return False


class _Inside(gym.Env[Any, Any]):
    """Stands in for an environment: returns known observations, keeps the actions.

    Args:
        env: whose spaces it has; vectorised ones have those of a single environment.
        seed: of its observations and of the actions that it is given.
    """

    def __init__(self, env: gym.Env[Any, Any] | VecEnv, seed: int = 0) -> None:
        self.observation_space = copy.deepcopy(env.observation_space)
        self.action_space = copy.deepcopy(env.action_space)
        self.observation_space.seed(seed)
        self.action_space.seed(seed + 1)
        if isinstance(env, gym.Env):
            self.spec, self.metadata, self.render_mode = env.spec, env.metadata, env.render_mode
        self.observation = np.asarray(self.observation_space.sample())
        self.actions: list[Any] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.observation = np.asarray(self.observation_space.sample())
        return self.observation.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.actions.append(np.array(action))
        observation, _ = self.reset()
        return observation, float(len(self.actions) % 7), False, False, {}


def _around(wrapper: Any, attribute: str, inside: Any) -> Any:
    """Return a copy of a wrapper around something else. Its constructor is not called."""
    around = object.__new__(type(wrapper))
    members = getattr(wrapper, "class_attributes", None)  # SB3's list of them cannot be copied
    memo = {id(getattr(wrapper, attribute)): inside, id(members): members}
    around.__dict__.update(copy.deepcopy(vars(wrapper), memo))
    return around


def _passes(
    reset: Callable[[], Any],
    step: Callable[[Any], Any],
    insides: Sequence[_Inside],
    *,
    stack: bool = False,
) -> bool:
    """Return whether all observations and actions pass through.

    Args:
        reset: begins episodes; returns observations.
        step: takes actions; returns observations.
        insides: what is wrapped.
        stack: observations and actions are stacks of those of all insides; else of the only one.
    """

    def of_all(parts: Sequence[Any]) -> np.ndarray:
        return np.stack(parts) if stack else np.asarray(parts[0])

    for i in range(_STEPS):
        if i % _RESET_EVERY == 0 and not _equal(reset(), of_all([x.observation for x in insides])):
            return False
        actions = of_all([np.asarray(inside.action_space.sample()) for inside in insides])
        observations = step(actions.copy())
        if any(len(inside.actions) != i + 1 for inside in insides):
            return False
        if not _equal(of_all([inside.actions[-1] for inside in insides]), actions):
            return False
        if not _equal(observations, of_all([inside.observation for inside in insides])):
            return False
    return True


def _same_spaces(outer: Any, inner: Any) -> bool:
    """Return whether both have the same spaces, of single arrays or numbers."""
    pairs: Sequence[tuple[Any, Any]] = (
        (outer.observation_space, inner.observation_space),
        (outer.action_space, inner.action_space),
    )
    return all(a == b and not isinstance(a, spaces.Dict | spaces.Tuple) for a, b in pairs)


def _equal(got: Any, given: np.ndarray) -> bool:
    got = np.asarray(got)
    return got.dtype == given.dtype and np.array_equal(got, given)
