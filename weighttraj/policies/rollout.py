"""J(pi): the undiscounted returns of policies over fixed episodes."""

from __future__ import annotations

import queue
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from types import TracebackType
from typing import Any, NamedTuple, overload

import gymnasium as gym
import numpy as np

from weighttraj import environments
from weighttraj.errors import PolicyError
from weighttraj.format import EnvInfo, PolicySpec, Run
from weighttraj.policies.batch import PolicyBatch
from weighttraj.policies.policy import Policy
from weighttraj.policies.simulators import Simulator, make_simulator
from weighttraj.threads import one_torch_thread

_BLOCK = 256
"""Policies that play at once: enough for the physics to outweigh Python."""

_NOISE_STEPS = 256
"""Steps for which the noise of actions is drawn at a time."""


class EpisodeReturns(NamedTuple):
    """Outcome of some episodes, (policy, episode), or (episode,) of a single policy."""

    returns: np.ndarray
    """float64: undiscounted sum of raw rewards; NaN: the simulation became unstable."""
    lengths: np.ndarray
    """int64: environment steps."""


class Evaluator:
    """Plays the same episodes with every policy.

    Episode i starts from ``reset(seed=seed + i)`` and samples its actions with a generator of its
    own, so all policies meet the same starts and the same noise. A policy's returns do not depend
    on the policies beside it, nor on the number of threads. (The number of episodes may move the
    last bit of an action: matrix products are ordered by their size.) Raw observations and rewards:
    policies bring their normalisers.

    Gymnasium's planar MuJoCo environments run as batched physics (``mujoco.batch``), bit by bit as
    Gymnasium steps them. Any other environment runs in Gymnasium's own loop, 5 to 20 times slower;
    ``simulator`` says which it is.

    Args:
        env: the environment, as a run describes it.
        episodes: number of episodes.
        seed: of the first episode.
        threads: that play; each has policies of its own.
        block: policies that play at once; memory grows with it.

    Raises:
        CollectError: the environment is not registered here.
        PolicyError: fewer than one episode.
    """

    def __init__(
        self,
        env: EnvInfo,
        *,
        episodes: int = 20,
        seed: int = 0,
        threads: int = 1,
        block: int = _BLOCK,
    ) -> None:
        if min(episodes, threads, block) < 1:
            raise PolicyError(
                "no episodes to play, or nothing to play them with",
                expected="episodes, threads and block at least 1",
                got=f"episodes {episodes}, threads {threads}, block {block}",
            )
        self.seeds = list(range(seed, seed + episodes))
        self._info, self._threads, self._block = env, threads, block
        self._env = self._make()
        self._noise: dict[tuple[str, int], list[np.ndarray]] = {}
        self._drawing = threading.Lock()

    @property
    def simulator(self) -> str:
        """What steps the environment: ``mujoco.batch`` or ``gymnasium``."""
        return self._simulators[0].name

    @overload
    def __call__(self, policy: Policy, *, deterministic: bool = True) -> EpisodeReturns: ...
    @overload
    def __call__(self, policy: PolicyBatch, *, deterministic: bool = True) -> EpisodeReturns: ...
    def __call__(
        self, policy: Policy | PolicyBatch, *, deterministic: bool = True
    ) -> EpisodeReturns:
        """Play every episode to its end.

        Args:
            policy: one policy, or many.
            deterministic: act by the distribution's mode, else by samples.

        Returns:
            Returns and lengths, (policy, episode); of a single policy (episode,).

        Raises:
            PolicyError: the policy's observations or actions are not the environment's.
        """
        _check_spaces(policy.spec, self._env)
        if isinstance(policy, Policy):
            returns, lengths = self(_batch_of(policy), deterministic=deterministic)
            return EpisodeReturns(returns[0], lengths[0])
        size = self._size(len(policy))
        blocks = [policy[start : start + size] for start in range(0, len(policy), size)]
        free: queue.SimpleQueue[Simulator] = queue.SimpleQueue()  # simulators that no thread uses
        for simulator in self._simulators:
            free.put(simulator)

        def play(block: PolicyBatch) -> EpisodeReturns:
            simulator = free.get()
            try:
                return self._play(simulator, block, deterministic)
            finally:
                free.put(simulator)

        # Torch's own threads would wait for their next piece in a loop, and take the time of the
        # physics: each thread of ours plays a block with one.
        with (
            one_torch_thread(),
            environments.quiet_mujoco(),
            ThreadPoolExecutor(len(self._simulators)) as pool,
        ):
            played = list(pool.map(play, blocks))
        returns, lengths = (np.concatenate(x) for x in zip(*played, strict=True))
        return EpisodeReturns(returns, lengths)

    def close(self) -> None:
        """Close the environments."""
        for simulator in self._simulators:
            simulator.close()
        self._env.close()

    def __enter__(self) -> Evaluator:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @cached_property
    def _simulators(self) -> list[Simulator]:
        """One a thread; Gymnasium's loop is Python, which has one thread."""
        first = make_simulator(self._make, self.seeds)
        others = self._threads - 1 if first.most is None else 0
        return [first, *(make_simulator(self._make, self.seeds) for _ in range(others))]

    def _size(self, policies: int) -> int:
        """Policies that a thread plays at once."""
        most = min(self._block, self._simulators[0].most or self._block)
        return max(1, -(-min(most, policies) // len(self._simulators)))

    def _make(self) -> gym.Env[Any, Any]:
        limit = self._info.max_episode_steps
        limits = {} if limit is None else {"max_episode_steps": limit}
        return environments.make(self._info.id, **limits, **self._info.kwargs)

    def _play(
        self, simulator: Simulator, policies: PolicyBatch, deterministic: bool
    ) -> EpisodeReturns:
        """Returns and lengths (policy, episode) of a block of policies."""
        shape = (len(policies), len(self.seeds))
        returns, lengths = np.zeros(shape), np.zeros(shape, np.int64)
        first = simulator.reset(len(policies))
        observations = first.reshape(*shape, *first.shape[1:])
        sims = np.arange(returns.size).reshape(shape)
        running = np.ones(shape, bool)
        limit = getattr(self._env.spec, "max_episode_steps", None)
        step = 0
        while running.any() and step != limit:
            if 2 * running.any(1).sum() <= len(policies):  # policies whose episodes are over leave
                keep = np.flatnonzero(running.any(1))
                policies = policies[keep]
                observations, sims, running = observations[keep], sims[keep], running[keep]
            noise = None if deterministic else self._noise_at(step, policies.spec)
            actions = policies.act(observations, noise)
            playing = sims[running]
            result = simulator.step(playing, actions[running])
            step += 1
            observations[running] = result.observations
            returns.flat[playing] += np.where(result.unstable, np.nan, result.rewards)
            lengths.flat[playing] = step
            running[running] = ~(result.terminated | result.truncated | result.unstable)
        return EpisodeReturns(returns, lengths)

    def _noise_at(self, step: int, spec: PolicySpec) -> np.ndarray:
        """What chance adds to the actions of a step, (episode, ...): the same for all policies."""
        size = max(1, len(spec.action_low))
        with self._drawing:
            drawn = self._noise.setdefault((spec.head, size), [])
            while step >= len(drawn) * _NOISE_STEPS:
                part = [self._draw(seed, len(drawn), spec) for seed in self.seeds]
                drawn.append(np.stack(part, 1))
        return np.asarray(drawn[step // _NOISE_STEPS][step % _NOISE_STEPS])

    @staticmethod
    def _draw(seed: int, part: int, spec: PolicySpec) -> np.ndarray:
        """One part of an episode's noise, (step, ...)."""
        generator = np.random.default_rng([seed, 1])
        size = len(spec.action_low)
        shape = (part + 1, _NOISE_STEPS, size) if size else (part + 1, _NOISE_STEPS)
        if spec.head == "gaussian":
            return np.asarray(generator.standard_normal(shape, np.float32)[part])
        return np.asarray(generator.random(shape)[part])


def evaluate(
    policy: Policy | PolicyBatch,
    env: EnvInfo | Run | str,
    *,
    episodes: int = 20,
    seed: int = 0,
    deterministic: bool = True,
    threads: int = 1,
) -> EpisodeReturns:
    """Returns of a policy, or of many, over fixed episode seeds.

    Args:
        policy: from ``run.load_policy(t)``, or ``load_policies(run, rows)``.
        env: the environment, its id, or a run that was trained in it.
        episodes: number of episodes.
        seed: of the first episode; episode i starts from ``seed + i``.
        deterministic: act by the distribution's mode, else by samples.
        threads: for physics and networks.

    Raises:
        CollectError: the environment is not registered here.
        PolicyError: the run does not say which environment it was trained in.
    """
    if isinstance(env, Run):
        env = env_of(env)
    elif isinstance(env, str):
        env = EnvInfo(id=env)
    with Evaluator(env, episodes=episodes, seed=seed, threads=threads) as evaluator:
        return evaluator(policy, deterministic=deterministic)


def env_of(run: Run) -> EnvInfo:
    """The environment of a run.

    Raises:
        PolicyError: the run does not say, the environment cannot be made again, or it is made from
            files: those that a data set names are not to be opened.
    """
    if run.info.env is None:
        raise PolicyError(
            "the run does not say which environment it was trained in",
            where=run.path,
            do="pass weighttraj.format.EnvInfo(id=...) instead of the run",
        )
    if run.info.env.cannot_remake:
        raise PolicyError(
            "the run's environment cannot be made again, so its policies cannot be evaluated in it",
            expected="an environment that gymnasium.make makes from its id and keywords",
            got="; ".join(run.info.env.cannot_remake),
            where=run.path,
            do="make the environment yourself and act in it with run.load_policy(t)",
        )
    paths = [v for v in run.info.env.kwargs.values() if isinstance(v, str) and set(v) & set("/\\")]
    if paths:
        raise PolicyError(
            "the run's environment is made from files of the machine it was trained on",
            got=paths,
            where=run.path,
            do="if you trust the data, pass run.info.env instead of the run",
        )
    return run.info.env


def _check_spaces(spec: PolicySpec, env: gym.Env[Any, Any]) -> None:
    observed, acted = env.observation_space, env.action_space
    kind = gym.spaces.Box if spec.head == "gaussian" else gym.spaces.Discrete
    fits = isinstance(acted, kind) and acted.shape == spec.action_shape
    if observed.shape != spec.observation_shape or not fits:
        raise PolicyError(
            "the policy does not fit the environment",
            expected=f"observations {spec.observation_shape}, {spec.head} actions "
            f"{spec.action_shape}",
            got=f"observations {observed}, actions {acted}",
            where=env,
            do="evaluate it in the environment it was trained in",
        )


def _batch_of(policy: Policy) -> PolicyBatch:
    stats = policy.stats
    mean, var = (None, None) if stats is None else (stats.mean[None], stats.var[None])
    return PolicyBatch(policy.spec, policy.layout, policy.weights[None], policy.obs_norm, mean, var)
