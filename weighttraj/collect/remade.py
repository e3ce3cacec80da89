"""Makes a training's environment again and compares the two.

A registered id and its keywords do not say everything: attributes may have been changed after the
environment was made, the id may have been registered again, wrappers may come with the
registration. So a copy of the training's environment and the one that was made again play the same
steps. The training's own environment is not touched, nor are the global random generators.
"""

from __future__ import annotations

import copy
import random
import sys
from collections import deque
from collections.abc import Sequence
from types import BuiltinFunctionType, FunctionType
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium import wrappers as gw
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import data_equivalence

from weighttraj import environments
from weighttraj.collect.undisturbed import undisturbed
from weighttraj.collect.wrappers import ClipObservation
from weighttraj.errors import WeightTrajError
from weighttraj.format import EnvInfo

_STEPS = 16
_SEED = 0
_MOST = 2**26
"""Bytes of an environment's arrays beyond which it is not copied."""
_SHARED = {"pybullet"}
"""Simulators whose environments all live in one state."""
_DATA = (
    *(bool, int, float, complex, str, bytes, type, FunctionType, BuiltinFunctionType),
    *(np.generic, np.random.Generator, np.random.RandomState, random.Random),
    *(gym.Space, EnvSpec, mujoco.MjModel, mujoco.MjData),
)
_NEUTRAL = (gw.TimeLimit, gw.OrderEnforcing, gw.PassiveEnvChecker)
_NORMALISING = (gw.NormalizeObservation, gw.TransformObservation, ClipObservation)

_Trace = list[tuple[str, Any]]
"""What an environment gave: a name, such as "the reward of step 3", and the value."""


def compare(info: EnvInfo, envs: Sequence[gym.Env[Any, Any]]) -> tuple[list[str], list[str]]:
    """Make an environment again and compare it with those of the training.

    Args:
        info: what it is made from.
        envs: the training's environments, with their wrappers.

    Returns:
        What differs, in words, and the names of the wrappers that the registration brings.
    """
    with undisturbed():
        twins = [_twin(env.unwrapped) for env in envs]
        if None in twins:  # what cannot be copied may hold what there can be only one of
            return [], []
        try:
            again = environments.remake(info)
        except WeightTrajError as error:
            return [f"making it again fails: {_first_lines(error)}"], []
        try:
            own = [type(w).__name__ for w in _wrappers(again) if type(w) not in _NEUTRAL]
            found = [
                f"its registration wraps it in {type(w).__name__}, as the policy does"
                for w in _wrappers(again)
                if isinstance(w, _NORMALISING)
            ]
            return found or _differences(twins, again.unwrapped), own
        finally:
            again.close()


def _differences(twins: Sequence[Any], again: gym.Env[Any, Any]) -> list[str]:
    """Return the first difference between any of the copies and the new environment."""
    kinds = [type(twin) for twin in twins if type(twin) is not type(again)]
    if kinds:
        return [f"made again, it is another class: {_name(type(again))}, not {_name(kinds[0])}"]
    expected = _play(again, again)
    if expected is None or not data_equivalence(expected, _play(again, again)):
        return []  # it does not repeat itself, so there is nothing to compare
    for twin in twins:
        got = _play(twin, again)
        if got is not None and (different := _first_difference(got, expected)):
            return [f"made again, it differs in {different}: was it changed after it was made?"]
    return []


def _first_difference(got: _Trace, expected: _Trace) -> str | None:
    for (name, one), (_, other) in zip(got, expected, strict=False):
        if not data_equivalence(one, other):
            return f"{name} ({_shown(other)}, where the training's has {_shown(one)})"
    return None if len(got) == len(expected) else "the length of an episode"


def _play(env: Any, spaces_of: gym.Env[Any, Any]) -> _Trace | None:
    """Play some steps from a seed; None: the environment raises an error."""
    space = copy.deepcopy(spaces_of.action_space)
    space.seed(_SEED)
    random.seed(_SEED)
    np.random.seed(_SEED)  # noqa: NPY002  some environments draw from it
    torch.manual_seed(_SEED)
    try:
        trace: _Trace = [
            ("its space of observations", str(env.observation_space)),
            ("its space of actions", str(env.action_space)),
            ("the first observation", copy.deepcopy(env.reset(seed=_SEED)[0])),
        ]
        for step in range(1, _STEPS + 1):
            observation, reward, terminated, truncated, _ = env.step(space.sample())
            trace.append((f"the observation of step {step}", copy.deepcopy(observation)))
            trace.append((f"the reward of step {step}", float(reward)))
            trace.append((f"the end of step {step}", (bool(terminated), bool(truncated))))
            if terminated or truncated:
                break
    except Exception:  # the code of a stranger may raise anything
        return None
    return trace


def _twin(env: Any) -> Any:
    """Return a copy of an environment as it is now; None: it cannot be copied, or is large.

    Not ``deepcopy``: many environments copy themselves by being made again.
    """
    values = vars(env)
    if values.get("render_mode") == "human" or _SHARED & sys.modules.keys():
        return None
    if hasattr(type(env), "__del__") or not _is_data(values, set(), [_MOST]):
        return None
    try:
        twin = object.__new__(type(env))
        twin.__dict__.update(copy.deepcopy(values, {id(env): twin}))
    except Exception:  # the code of a stranger may raise anything
        return None
    return twin


def _is_data(value: Any, seen: set[int], left: list[int]) -> bool:
    """Return whether a value is data throughout, of which a copy shares nothing with the original.

    Windows, sockets, and handles of simulators are not: what a copy does, they would feel.

    Args:
        value: anything.
        seen: ids of the objects that were looked at.
        left: how many bytes arrays may still have.
    """
    if id(value) in seen:
        return True
    seen.add(id(value))
    if isinstance(value, np.ndarray | torch.Tensor):
        left[0] -= value.nbytes
        return left[0] >= 0 and value.dtype != object
    if value is None or isinstance(value, _DATA):
        return True
    if isinstance(value, dict):
        return all(_is_data(item, seen, left) for pair in value.items() for item in pair)
    if isinstance(value, list | tuple | set | frozenset | deque):
        return all(_is_data(item, seen, left) for item in value)
    plain = type(value).__module__ != "builtins" and hasattr(value, "__dict__")
    return plain and not hasattr(type(value), "__del__") and _is_data(vars(value), seen, left)


def _wrappers(env: gym.Env[Any, Any]) -> list[gym.Wrapper[Any, Any, Any, Any]]:
    found = []
    while isinstance(env, gym.Wrapper):
        found.append(env)
        env = env.env
    return found


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _shown(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 40 else f"{text[:40]}..."


def _first_lines(error: WeightTrajError) -> str:
    return " ".join(error.message.split())[:200]
