"""Describes a training's environment, and says what keeps it from being made again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from weighttraj import environments
from weighttraj.collect.normalizers import Normalizers
from weighttraj.collect.remade import compare
from weighttraj.errors import CollectError, FormatError
from weighttraj.format import EnvInfo
from weighttraj.format.exact import encode_exactly

_RENDERING = (
    "camera_id",
    "camera_name",
    "default_camera_config",
    "height",
    "max_geom",
    "visual_options",
    "width",
)
"""Keywords of MuJoCo environments that change nothing but pictures."""
_MOST_NESTED = 20
"""Lists and dicts in one another that a keyword may have: readers of metadata refuse 64 levels, and
a tuple takes two."""
_OF_THE_POLICY = ("VecTransposeImage", "VecNormalize of a Dict")
"""Wrappers that prepare observations for the policy; the environment's own are not changed."""


def describe_env(venv: VecEnv | None, norm: Normalizers) -> EnvInfo | None:
    """Describe the environment as Gymnasium's registry knows it; None: it is not registered.

    The environment is made again and compared with a copy of the training's own, which is not
    touched. Environments in other processes, and those that cannot be copied, are not compared.

    Args:
        venv: the training's environments.
        norm: their normalisers and wrappers.

    Raises:
        CollectError: the environments live in other processes and cannot say what they are.
    """
    if venv is None:
        return None
    base = venv.unwrapped
    specs = [spec for spec in _specs(base) if spec is not None]
    if len(specs) < venv.num_envs:
        return None
    envs = list(base.envs) if isinstance(base, DummyVecEnv) else []
    parts = [_parts(spec, envs[i] if envs else None) for i, spec in enumerate(specs)]
    info, reasons = parts[0]
    info = replace(info, wrappers=norm.wrappers)
    if any(other != parts[0] for other in parts):
        reasons = [*reasons, "the environments of the training differ from one another"]
    compared = envs and not reasons and info.id in gym.registry
    found, own = compare(info, envs) if compared else ([], [])
    wrappers = [n for n in (*norm.unknown, *norm.rewarding) if n not in (*own, *_OF_THE_POLICY)]
    strange = [f"environment wrapper {name}" for name in wrappers]
    return replace(info, cannot_remake=(*reasons, *strange, *found))


def _specs(base: VecEnv) -> list[EnvSpec | None]:
    """Return what Gymnasium's registry says of each environment."""
    try:
        specs: list[EnvSpec | None] = base.get_attr("spec")
    except (AttributeError, NotImplementedError):  # environments that are not Gymnasium's
        return [None]
    except (EOFError, ConnectionError) as error:
        raise CollectError(
            "the environment's process ended when it was asked what the environment is made of",
            expected="keyword arguments that can be sent to another process",
            got=f"{type(error).__name__}, after the error that the process printed",
            where=type(base).__name__,
            do="use DummyVecEnv, or register the environment with these keywords",
        ) from error
    return specs


def _parts(spec: EnvSpec, env: gym.Env[Any, Any] | None) -> tuple[EnvInfo, list[str]]:
    """Return what one environment is made of, and why that is not all."""
    kwargs, reasons = _keywords(spec, env)
    info = EnvInfo(
        id=spec.id,
        kwargs=kwargs,
        max_episode_steps=_limit(spec, env),
        spec={"entry_point": str(spec.entry_point), "reward_threshold": spec.reward_threshold},
    )
    return info, reasons


def _keywords(spec: EnvSpec, env: gym.Env[Any, Any] | None) -> tuple[dict[str, Any], list[str]]:
    """Return the keywords that metadata can hold exactly, and a reason for each other one."""
    registered = gym.registry.get(spec.id)
    defaults = {} if registered is None else registered.kwargs
    harmless = _RENDERING if env is not None and isinstance(env.unwrapped, MujocoEnv) else ()
    exact, reasons = {}, []
    for name, value in spec.kwargs.items():
        if name == "render_mode":  # it would open a window
            continue
        if _is_exact(name, value):
            exact[name] = value
        # What the registration brings, it brings again.
        elif name not in harmless and not _is_same(value, defaults.get(name)):
            reasons.append(f"keyword `{name}` ({type(value).__name__})")
    return exact, reasons


def _is_exact(name: str, value: Any) -> bool:
    """Return whether metadata can hold a keyword, and whether it reads back as the same one."""
    try:
        encode_exactly({name: value}, "")
        return _depth(value) <= _MOST_NESTED
    except (FormatError, RecursionError):
        return False


def _depth(value: Any) -> int:
    """Return how many lists and dicts lie in one another."""
    parts = value.values() if isinstance(value, dict) else value
    if not isinstance(value, dict | list | tuple):
        return 0
    return 1 + max(map(_depth, parts), default=0)


def _is_same(value: Any, other: Any) -> bool:
    """Whether two values are the same object, or equal arrays."""
    if isinstance(value, np.ndarray) and isinstance(other, np.ndarray):
        return value.dtype == other.dtype and np.array_equal(value, other)
    return value is other


def _limit(spec: EnvSpec, env: gym.Env[Any, Any] | None) -> int | None:
    """Return the time limit; -1 if the registered one was switched off."""
    limit: int | None = environments.time_limit(env) or spec.max_episode_steps
    registered = gym.registry.get(spec.id)
    if limit is None and registered is not None and registered.max_episode_steps is not None:
        return -1
    return limit
