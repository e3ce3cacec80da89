"""Returns of any policy in any environment."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv

from weighttraj import environments
from weighttraj.errors import PolicyError
from weighttraj.format import EnvInfo
from weighttraj.policies.batch import PolicyBatch
from weighttraj.policies.ending import End, check_numbers, end_of
from weighttraj.policies.policy import Policy
from weighttraj.policies.rollout import EpisodeReturns, Evaluator, env_of
from weighttraj.run import Run

Env = gym.Env[Any, Any]
Act = Callable[[Any, Any, bool], tuple[Any, Any]]
"""From an observation, the policy's state and whether an episode begins: an action, the state."""


def evaluate(
    policy: Any,
    env: Any,
    *,
    episodes: int = 20,
    seed: int = 0,
    deterministic: bool = True,
    threads: int = 1,
    max_steps: int | None = None,
) -> EpisodeReturns:
    """Return what a policy, or many, get in episodes from fixed seeds.

    Args:
        policy: from ``run.load_policy(t)`` or ``load_policies(run, rows)``; or a model or policy of
            Stable-Baselines3, or any object with its ``predict``; or a function from an observation
            to an action. A model with a ``VecNormalize`` gets observations that it normalised.
        env: the environment: its id, a run that was trained in it, an ``EnvInfo``, a
            ``gymnasium.Env``, or a function that makes one. Rewards are counted as it gives them.
            An environment is played in as it is, wrappers included, and is not closed.
        episodes: number of episodes.
        seed: of the first episode; episode i starts from ``reset(seed=seed + i)``.
        deterministic: act by the distribution's mode, else by samples. Functions act as they do.
        threads: for batched physics and loaded policies.
        max_steps: cut episodes off after so many steps. None: the environment's own time limit;
            without one, an episode of 100,000 steps is an error.

    Returns:
        Returns and lengths, (policy, episode); of a single policy (episode,).

    Raises:
        CollectError: the environment is not registered here.
        PolicyError: the environment cannot be made again, the policy does not fit it, an episode
            has no end, or one of the two fails.
        KeyboardInterrupt: it was stopped; no further step is taken.
    """
    check_numbers(episodes=episodes, threads=threads, max_steps=max_steps)
    source = _source_of(env)
    if not isinstance(policy, Policy | PolicyBatch):
        return _play_any(policy, source, range(seed, seed + episodes), deterministic, max_steps)
    if not isinstance(source, gym.Env):
        with Evaluator(
            source, episodes=episodes, seed=seed, threads=threads, max_steps=max_steps
        ) as evaluator:
            return evaluator(policy, deterministic=deterministic)
    one: Env = source  # there is only one, so its episodes are played one after another
    played = [
        Evaluator(lambda: one, episodes=1, seed=seed + i, max_steps=max_steps)(
            policy, deterministic=deterministic
        )
        for i in range(episodes)
    ]
    returns, lengths = (np.concatenate(parts, axis=-1) for parts in zip(*played, strict=True))
    return EpisodeReturns(returns, lengths)


def _source_of(env: Any) -> EnvInfo | Env | Callable[[], Env]:
    """Return what the environment is made from, or the environment itself."""
    if isinstance(env, Run):
        return env_of(env)
    if isinstance(env, str):
        return EnvInfo(id=env)
    if isinstance(env, EnvInfo | gym.Env):
        return env
    if callable(env) and not isinstance(env, VecEnv):
        function: Callable[[], Env] = env
        return function
    raise PolicyError(
        "this is no environment that policies can be evaluated in",
        expected="an id, a run, a gymnasium.Env, or a function that makes one",
        got=f"a {type(env).__name__}",
        do="pass a function that makes one environment, such as lambda: gymnasium.make(...)",
    )


def _play_any(
    policy: Any,
    source: EnvInfo | Env | Callable[[], Env],
    seeds: range,
    deterministic: bool,
    max_steps: int | None,
) -> EpisodeReturns:
    """Play episodes one after another, in this thread."""
    if isinstance(source, gym.Env):
        env = source
    else:
        make = environments.remake if isinstance(source, EnvInfo) else environments.made_by
        env = make(source)  # type: ignore[arg-type]
    try:
        act, end = _act_of(policy, env, deterministic), end_of(env, max_steps)
        with torch.random.fork_rng(devices=[]), environments.quiet_mujoco():
            played = [_episode(act, env, seed, end) for seed in seeds]
    finally:
        if env is not source:
            env.close()
    returns, lengths = zip(*played, strict=True)
    return EpisodeReturns(np.array(returns, np.float64), np.array(lengths, np.int64))


def _episode(act: Act, env: Env, seed: int, end: End) -> tuple[float, int]:
    """Play one episode; return its return and its length."""
    about = EnvInfo(id=str(env))
    torch.manual_seed(seed)
    with environments.explained(about):
        observation, _ = env.reset(seed=seed)
    total, step, over, state = 0.0, 0, False, None
    while not over and not end.cuts(step):
        action, state = act(observation, state, step == 0)
        with environments.explained(about):
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + float(reward), bool(terminated or truncated)
        step += 1
    return total, step


def _act_of(policy: Any, env: Env, deterministic: bool) -> Act:
    """Return how a policy acts, whatever it is.

    Raises:
        PolicyError: it does not act.
    """
    predict = getattr(policy, "predict", None)
    if not callable(predict if predict is not None else policy):
        raise PolicyError(
            "this is no policy that can be evaluated",
            expected="a loaded policy, an object with predict(), or a function of an observation",
            got=f"a {type(policy).__name__}",
            do="pass a function from an observation to an action",
        )
    if predict is None:
        return lambda observation, state, _: (_guarded(policy, observation), state)
    normalize, understood = _normalize_of(policy, env), inspect.signature(predict).parameters

    def act(observation: Any, state: Any, starts: bool) -> tuple[Any, Any]:
        said = {
            "state": state,
            "episode_start": np.array([starts]),
            "deterministic": deterministic,
        }
        said = {name: value for name, value in said.items() if name in understood}
        answer = _guarded(predict, normalize(observation), **said)
        action, state = answer if isinstance(answer, tuple) else (answer, None)
        return _fitting(action, env), state

    return act


def _guarded(act: Callable[..., Any], observation: Any, **said: Any) -> Any:
    try:
        return act(observation, **said)
    except Exception as error:  # somebody else's code
        raise PolicyError(
            "the policy fails on an observation of the environment",
            expected="a policy that was trained in this environment, without frame stacking",
            got=f"{type(error).__name__}: {str(error)[:1000]}",
            where=f"observation of shape {np.shape(observation)}"
            if not isinstance(observation, dict)
            else f"observation with {sorted(observation)}",
            do="pass a function that makes the environment as the training had it",
        ) from error


def _fitting(action: Any, env: Env) -> Any:
    """Return an action as a step of one environment takes it: a number, or within the bounds."""
    if isinstance(env.action_space, gym.spaces.Box):  # as ClipAction, which trainings have
        return np.clip(action, env.action_space.low, env.action_space.high)
    return action[()] if isinstance(action, np.ndarray) and action.ndim == 0 else action


def _normalize_of(policy: Any, env: Env) -> Callable[[Any], Any]:
    """Return what a model's training environment makes of observations.

    Raises:
        PolicyError: the statistics of another normaliser belong to the model.
    """
    venv = policy.get_env() if hasattr(policy, "get_env") else None
    if not isinstance(venv, VecEnv):
        return lambda observation: observation
    if any(venv.env_is_wrapped(gym.wrappers.NormalizeObservation)) and not _normalises(env):
        raise PolicyError(
            "the model was trained on observations that Gymnasium's NormalizeObservation made",
            expected="an environment that normalises with the statistics of the training",
            got=env,
            do="evaluate a snapshot of its run (run.load_policy(t)), which has the statistics, or "
            "pass a function from a raw observation to an action",
        )
    normalizer = policy.get_vec_normalize_env()
    return (lambda observation: observation) if normalizer is None else normalizer.normalize_obs


def _normalises(env: Env) -> bool:
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.NormalizeObservation):
            return True
        env = env.env
    return False
