"""Finds the normalisers of a training environment and reads their statistics."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import wrappers as gw
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
)

from weighttraj.collect.transparent import is_transparent, is_transparent_vec
from weighttraj.collect.wrappers import ClipObservation, TruncationAsTermination
from weighttraj.errors import CollectError
from weighttraj.format.schema import ObsNorm
from weighttraj.writer import Moments

# Wrappers that leave observations alone and do not change what an action means: SB3 clips
# actions to the space's bounds anyway. Their subclasses are tried like any other wrapper.
_HARMLESS: tuple[type, ...] = (
    gw.TimeLimit,
    gw.OrderEnforcing,
    gw.PassiveEnvChecker,
    gw.RecordEpisodeStatistics,
    gw.RecordVideo,
    gw.ClipAction,
    gw.NormalizeReward,
    gw.TransformReward,
    gw.ClipReward,
    Monitor,
    TruncationAsTermination,
)
_HARMLESS_VEC: tuple[type, ...] = (VecMonitor, VecCheckNan)


@dataclass(frozen=True, kw_only=True)
class Normalizers:
    """Where the statistics of a training environment are."""

    obs_norm: ObsNorm | None
    """What is fixed about the observation normaliser; None: there is none."""
    live_obs: Callable[[], Any] | None
    """Returns the trainer's own statistics, with ``mean``, ``var`` and ``count``."""
    read_obs: Callable[[], Moments] | None
    """Copies them."""
    read_ret: Callable[[], Moments] | None
    """Copies the reward normaliser's statistics; None: there is none."""
    wrappers: tuple[str, ...]
    """Class names of all wrappers, outermost first."""
    unknown: tuple[str, ...]
    """Wrappers that may change observations or actions in a way that cannot be recorded."""
    rewarding: tuple[str, ...]
    """Wrappers that leave observations and actions alone, and may change rewards and episodes."""


def find_normalizers(env: VecEnv) -> Normalizers:
    """Look through the wrappers of a vectorised environment.

    Raises:
        CollectError: several environments have a normaliser each, or normalisers are stacked.
    """
    vec_wrappers, base = _unwrap(env, VecEnvWrapper, "venv")
    vec_normalize = [w for w in vec_wrappers if type(w) is VecNormalize]
    chains = _chains(base)
    chain, obs_sources, ret_sources = _inner_wrappers(base, chains)
    strange = _strange(vec_wrappers, chains)
    unknown = [name for name, transparent in strange.items() if not transparent]
    unknown += _unknown_by_name(base)

    sources = [_gymnasium_obs(chain, w) for w in obs_sources]
    sources += [_vec_obs(w) for w in vec_normalize if w.norm_obs and _has_array_stats(w)]
    unknown += ["VecNormalize of a Dict" for w in vec_normalize if not _has_array_stats(w)]
    if len(sources) > 1:
        raise CollectError(
            "several observation normalisers, one on top of the other",
            expected="at most one",
            got=[spec.source for spec, _ in sources],
            do="use either gymnasium's NormalizeObservation or SB3's VecNormalize",
        )
    obs_norm, live_obs = sources[0] if sources else (None, None)
    ret_stats: list[Any] = [w.ret_rms for w in vec_normalize if w.norm_reward]
    ret_stats += [w.return_rms for w in ret_sources]
    return Normalizers(
        obs_norm=obs_norm,
        live_obs=live_obs,
        read_obs=None if live_obs is None else lambda: _copy(live_obs()),
        read_ret=(lambda: _copy(ret_stats[0])) if ret_stats else None,
        wrappers=tuple(type(w).__name__ for w in (*vec_wrappers, base, *chain)),
        unknown=tuple(unknown),
        rewarding=tuple(name for name, transparent in strange.items() if transparent),
    )


def _chains(base: VecEnv) -> list[list[Any]]:
    """Wrappers of each environment, outermost first; empty: they live in other processes."""
    if not isinstance(base, DummyVecEnv):
        return []
    return [_unwrap(env, gym.Wrapper, "env")[0] for env in base.envs]


def _inner_wrappers(
    base: VecEnv, chains: list[list[Any]]
) -> tuple[list[Any], list[Any], list[Any]]:
    """Wrappers of the first environment, and the normalisers among them."""
    if not chains:
        if any(base.env_is_wrapped(gw.NormalizeObservation)):
            raise CollectError(
                "the observation normalisers live in other processes",
                expected="DummyVecEnv, or VecNormalize around the vectorised environment",
                got=f"{type(base).__name__} around gymnasium's NormalizeObservation",
                do="normalise with VecNormalize instead",
            )
        return [], [], []
    obs = [w for w in chains[0] if type(w) is gw.NormalizeObservation]
    if obs and len(chains) > 1:
        raise CollectError(
            "each environment has an observation normaliser of its own, so no single policy "
            "acts in all of them",
            expected="one environment, or one normaliser for all",
            got=f"{len(chains)} environments",
            do="train with n_envs=1, or normalise with VecNormalize",
        )
    ret = [w for w in chains[0] if type(w) is gw.NormalizeReward] if len(chains) == 1 else []
    return chains[0], obs, ret


def _strange(vec_wrappers: list[Any], chains: list[list[Any]]) -> dict[str, bool]:
    """Names of the wrappers that are not known, and whether observations and actions pass them."""
    known = (*_HARMLESS_VEC, VecNormalize)
    tried = [
        (type(w).__name__, is_transparent_vec(w)) for w in vec_wrappers if type(w) not in known
    ]
    tried += [
        (type(wrapper).__name__, is_transparent(wrapper))
        for chain in chains
        for i, wrapper in enumerate(chain)
        if not _is_known(wrapper, chain[i + 1 :])
    ]
    return {name: all(ok for other, ok in tried if other == name) for name, _ in tried}


def _unknown_by_name(base: VecEnv) -> list[str]:
    """Names of the unknown wrappers of environments that live in other processes."""
    if isinstance(base, DummyVecEnv):
        return []
    # "<Wrapper<Env<Id-v0>>>", or "<Wrapper<Env instance>>" where there is no id
    texts = [re.sub(r"<\w+<[^<> ]*>>", "", text) for text in base.env_method("__str__")]
    names = {name for text in texts for name in re.findall(r"<(\w+)(?![\w ])", text)}
    known = {kind.__name__ for kind in (*_HARMLESS, gw.NormalizeObservation, ClipObservation)}
    return sorted(names - known)


def _unwrap(env: Any, kind: type, attribute: str) -> tuple[list[Any], Any]:
    chain = []
    while isinstance(env, kind):
        chain.append(env)
        env = getattr(env, attribute)
    return chain, env


def _is_known(wrapper: Any, inside: list[Any]) -> bool:
    if _clip_bounds(wrapper) is not None:
        # Recorded as the normaliser's clip, so there must be a normaliser inside.
        return any(isinstance(w, gw.NormalizeObservation) for w in inside)
    if type(wrapper) is gw.FlattenObservation:
        return len(wrapper.env.observation_space.shape or ()) == 1
    return type(wrapper) in (*_HARMLESS, gw.NormalizeObservation)


def _has_array_stats(wrapper: VecNormalize) -> bool:
    return not wrapper.norm_obs or not isinstance(wrapper.obs_rms, dict)


def _vec_obs(wrapper: VecNormalize) -> tuple[ObsNorm, Callable[[], Any]]:
    clip = _number(wrapper.clip_obs, "clip_obs", wrapper)
    clips = np.isfinite(clip)  # an infinite bound clips nothing
    spec = ObsNorm(
        source="stable_baselines3.VecNormalize",
        epsilon=_number(wrapper.epsilon, "epsilon", wrapper),
        shape=tuple(wrapper.observation_space.shape or ()),
        clip_low=-clip if clips else None,
        clip_high=clip if clips else None,
        cast_before_clip=False,
    )
    return spec, lambda: wrapper.obs_rms


def _gymnasium_obs(
    chain: list[Any], wrapper: gw.NormalizeObservation[Any, Any, Any]
) -> tuple[ObsNorm, Callable[[], Any]]:
    outside = chain[: chain.index(wrapper)]
    bounds = [b for w in outside if (b := _clip_bounds(w)) is not None]
    low = max((b[0] for b in bounds), default=-np.inf)
    high = min((b[1] for b in bounds), default=np.inf)
    spec = ObsNorm(
        source="gymnasium.NormalizeObservation",
        epsilon=_number(wrapper.epsilon, "epsilon", wrapper),
        shape=tuple(wrapper.obs_rms.mean.shape),
        clip_low=low if np.isfinite(low) else None,
        clip_high=high if np.isfinite(high) else None,
        dtype=str(wrapper.obs_rms.mean.dtype),
    )
    return spec, lambda: wrapper.obs_rms


def _number(value: Any, name: str, wrapper: Any) -> float:
    """Return a setting of a normaliser, which may be a number of NumPy's, as a number of Python's.

    Raises:
        CollectError: it is no real number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if math.isnan(number):
        raise CollectError(
            "a setting of the observation normaliser is no number",
            expected=f"a real number for {name}",
            got=f"{type(value).__name__} {str(value)[:80]}",
            where=type(wrapper).__name__,
            do="normalise with one number for all observations",
        )
    return number


def _clip_bounds(wrapper: Any) -> tuple[float, float] | None:
    """Bounds of a wrapper that clips observations; None: it does something else.

    CleanRL clips by a lambda. It cannot be read, but it can be asked.
    """
    if type(wrapper) is ClipObservation:
        return _number(wrapper.low, "low", wrapper), _number(wrapper.high, "high", wrapper)
    func = getattr(wrapper, "func", None)
    # Asked only if asking cannot change it: a function without a state of its own.
    if not isinstance(func, FunctionType) or func.__closure__ is not None:
        return None
    if type(wrapper) is not gw.TransformObservation:
        return None
    shape = wrapper.env.observation_space.shape or ()
    probes = np.random.default_rng(0).normal(size=(64, *shape)).astype(np.float32)
    probes *= np.logspace(-30, 30, 64, dtype=np.float32).reshape(-1, *(1 for _ in shape))
    try:
        answers = np.stack([np.asarray(func(p.copy())) for p in probes])
    except Exception:
        return None
    low, high = float(answers.min()), float(answers.max())
    clips = answers.shape == probes.shape and np.array_equal(answers, probes.clip(low, high))
    return (low, high) if clips and max(-low, high) < 1e20 else None


def _copy(stats: Any) -> Moments:
    mean, var = (np.array(x, np.float64) for x in (stats.mean, stats.var))
    return mean, var, float(stats.count)
