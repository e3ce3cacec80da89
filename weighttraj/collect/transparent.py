"""Checks that an environment wrapper passes observations and actions through unchanged.

A copy of the wrapper is put around a stand-in for the environment, which returns known observations
and keeps the actions that reach it. The training's own environment is never stepped.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from weighttraj.collect.undisturbed import undisturbed

_STEPS = 64
"""Steps of the trial; the stand-in is reset every so many steps."""
_RESET_EVERY = 16


def is_transparent(wrapper: gym.Wrapper[Any, Any, Any, Any]) -> bool:
    """Whether a wrapper leaves observations and actions as they are. False if it cannot be tried.

    Args:
        wrapper: around one environment. It may change rewards and the ends of episodes.
    """
    if not _same_spaces(wrapper, wrapper.env):
        return False
    kind = type(wrapper)
    if isinstance(wrapper, gym.RewardWrapper) and kind.step is gym.RewardWrapper.step:
        return kind.reset is gym.Wrapper.reset  # its own code sees nothing but the reward
    with undisturbed():
        try:
            inside = _Inside(wrapper.env)
            return _try(_around(wrapper, "env", inside), inside)
        except Exception:  # the code of a stranger may raise anything
            return False


def is_transparent_vec(wrapper: VecEnvWrapper) -> bool:
    """The same for a wrapper around a vectorised environment."""
    if not _same_spaces(wrapper, wrapper.venv):
        return False
    with undisturbed():
        try:
            inside = _InsideVec(wrapper.venv)
            return _try_vec(_around(wrapper, "venv", inside), inside)
        except Exception:  # the code of a stranger may raise anything
            return False


class _Samples:
    """Observations and actions of some spaces, drawn by generators of their own."""

    def __init__(self, observation: spaces.Space[Any], action: spaces.Space[Any]) -> None:
        self._observation, self._action = copy.deepcopy(observation), copy.deepcopy(action)
        self._observation.seed(0)
        self._action.seed(1)

    def observation(self) -> np.ndarray:
        return np.asarray(self._observation.sample())

    def action(self) -> np.ndarray:
        return np.asarray(self._action.sample())


class _Inside(gym.Env[Any, Any]):
    """Stands in for an environment: returns known observations, keeps the actions."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.spec, self.metadata, self.render_mode = env.spec, env.metadata, env.render_mode
        self.samples = _Samples(self.observation_space, self.action_space)
        self.observation: np.ndarray = self.samples.observation()
        self.actions: list[Any] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.observation = self.samples.observation()
        return self.observation.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.actions.append(np.array(action))
        self.observation = self.samples.observation()
        return self.observation.copy(), float(len(self.actions) % 7), False, False, {}


class _InsideVec(VecEnv):
    """Stands in for a vectorised environment."""

    def __init__(self, venv: VecEnv) -> None:
        self.render_mode = None
        super().__init__(venv.num_envs, venv.observation_space, venv.action_space)
        self.samples = _Samples(self.observation_space, self.action_space)
        self.observation: np.ndarray = self._observe()
        self.actions: list[np.ndarray] = []

    def _observe(self) -> np.ndarray:
        return np.stack([self.samples.observation() for _ in range(self.num_envs)])

    def reset(self) -> Any:
        self.observation = self._observe()
        return self.observation.copy()

    def step_async(self, actions: np.ndarray) -> None:
        self.actions.append(np.array(actions))

    def step_wait(self) -> Any:
        self.observation = self._observe()
        rewards = np.arange(self.num_envs, dtype=np.float32) + len(self.actions) % 7
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        return self.observation.copy(), rewards, np.zeros(self.num_envs, bool), infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def _around(wrapper: Any, attribute: str, inside: Any) -> Any:
    """A copy of a wrapper around something else. Its constructor is not called."""
    around = object.__new__(type(wrapper))
    members = getattr(wrapper, "class_attributes", None)  # SB3's list of them cannot be copied
    memo = {id(getattr(wrapper, attribute)): inside, id(members): members}
    around.__dict__.update(copy.deepcopy(vars(wrapper), memo))
    return around


def _try(around: Any, inside: _Inside) -> bool:
    for step in range(_STEPS):
        if step % _RESET_EVERY == 0 and not _equal(around.reset()[0], inside.observation):
            return False
        action = inside.samples.action()
        observation = around.step(action.copy())[0]
        if len(inside.actions) != step + 1 or not _equal(inside.actions[-1], action):
            return False
        if not _equal(observation, inside.observation):
            return False
    return True


def _try_vec(around: Any, inside: _InsideVec) -> bool:
    for step in range(_STEPS):
        if step % _RESET_EVERY == 0 and not _equal(around.reset(), inside.observation):
            return False
        actions = np.stack([inside.samples.action() for _ in range(inside.num_envs)])
        around.step_async(actions.copy())
        observations = around.step_wait()[0]
        if len(inside.actions) != step + 1 or not _equal(inside.actions[-1], actions):
            return False
        if not _equal(observations, inside.observation):
            return False
    return True


def _same_spaces(outer: Any, inner: Any) -> bool:
    """Whether both have the same spaces, of single arrays or numbers."""
    pairs: Sequence[tuple[Any, Any]] = (
        (outer.observation_space, inner.observation_space),
        (outer.action_space, inner.action_space),
    )
    return all(a == b and not isinstance(a, spaces.Dict | spaces.Tuple) for a, b in pairs)


def _equal(got: Any, given: np.ndarray) -> bool:
    got = np.asarray(got)
    return got.dtype == given.dtype and np.array_equal(got, given)
