"""J(pi): the undiscounted returns of policies over fixed episodes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property
from threading import Event
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from weighttraj import environments
from weighttraj.errors import PolicyError
from weighttraj.format import EnvInfo, PolicySpec
from weighttraj.policies.batch import PolicyBatch
from weighttraj.policies.ending import check_numbers, end_of
from weighttraj.policies.policy import Policy
from weighttraj.policies.simulators import Simulator, make_simulator
from weighttraj.run import Run
from weighttraj.threads import in_threads, one_torch_thread

_BLOCK = 256
"""Policies that play at once: enough for the physics to outweigh Python."""

_NOISE_STEPS = 256
"""Steps for which the noise of actions is drawn at a time."""


Tick = Callable[[], None]


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
    policies bring their normalisers. Actions are clipped to the environment's bounds, too.

    Gymnasium's planar MuJoCo environments run as batched physics (``mujoco.batch``), bit by bit as
    Gymnasium steps them. Any other environment runs in Gymnasium's own loop, 5 to 20 times slower;
    ``simulator`` says which it is.

    Args:
        env: the environment, as a run describes it; or a function that makes one.
        episodes: number of episodes.
        seed: of the first episode.
        threads: that play; each has policies of its own.
        block: policies that play at once; memory grows with it.
        max_steps: cut episodes off after so many steps. None: the environment's own time limit;
            without one, an episode of ``ENDLESS`` steps is an error.

    Raises:
        CollectError: the environment is not registered here.
        PolicyError: fewer than one episode, or the environment cannot be made again.
    """

    def __init__(
        self,
        env: EnvInfo | Callable[[], gym.Env[Any, Any]],
        *,
        episodes: int = 20,
        seed: int = 0,
        threads: int = 1,
        block: int = _BLOCK,
        max_steps: int | None = None,
    ) -> None:
        check_numbers(episodes=episodes, threads=threads, block=block, max_steps=max_steps)
        self.seeds = list(range(seed, seed + episodes))
        self._source, self._threads, self._block = env, threads, block
        self._info = env if isinstance(env, EnvInfo) else EnvInfo(id=getattr(env, "__name__", "-"))
        self._env = self._make()
        self._end = end_of(self._env, max_steps)
        self._noise: dict[tuple[str, int], list[np.ndarray]] = {}
        self._drawing = threading.Lock()

    @property
    def simulator(self) -> str:
        """What steps the environment: ``mujoco.batch`` or ``gymnasium``."""
        return self._simulators[0].name

    def __call__(
        self,
        policy: Policy | PolicyBatch,
        *,
        deterministic: bool = True,
        tick: Tick = lambda: None,
    ) -> EpisodeReturns:
        """Play every episode to its end.

        Args:
            policy: one policy, or many.
            deterministic: act by the distribution's mode, else by samples.
            tick: called in this thread every now and then; what it raises stops the episodes.

        Returns:
            Returns and lengths, (policy, episode); of a single policy (episode,).

        Raises:
            PolicyError: the policy's observations or actions are not the environment's, or an
                episode has no end.
            KeyboardInterrupt: it was stopped; no further step is taken.
        """
        _check_spaces(policy.spec, self._env)
        if isinstance(policy, Policy):
            returns, lengths = self(_batch_of(policy), deterministic=deterministic, tick=tick)
            return EpisodeReturns(returns[0], lengths[0])
        size = self._size(len(policy))
        blocks = [policy[start : start + size] for start in range(0, len(policy), size)]

        def play(simulator: Simulator, block: PolicyBatch, stop: Event) -> EpisodeReturns:
            return self._play(simulator, block, deterministic, stop)

        # Torch's own threads would wait for their next piece in a loop, and take the time of the
        # physics: each thread of ours plays a block with one.
        with one_torch_thread(), environments.quiet_mujoco():
            played = in_threads(play, self._simulators, blocks, tick)
        returns, lengths = (np.concatenate(x) for x in zip(*played, strict=True))
        return EpisodeReturns(returns, lengths)

    def close(self) -> None:
        """Close the environments; those that were never made are not made for it."""
        for simulator in self.__dict__.get("_simulators", ()):
            simulator.close()
        self._env.close()

    def __enter__(self) -> Evaluator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @cached_property
    def _simulators(self) -> list[Simulator]:
        """One a thread; Gymnasium's loop is Python, which has one thread."""
        with environments.explained(self._info):
            first = make_simulator(self._make, self.seeds)
            others = self._threads - 1 if first.most is None else 0
            return [first, *(make_simulator(self._make, self.seeds) for _ in range(others))]

    def _size(self, policies: int) -> int:
        """Policies that a thread plays at once."""
        most = min(self._block, self._simulators[0].most or self._block)
        return max(1, -(-min(most, policies) // len(self._simulators)))

    def _make(self) -> gym.Env[Any, Any]:
        if isinstance(self._source, EnvInfo):
            return environments.remake(self._source)
        return environments.made_by(self._source)

    def _play(
        self, simulator: Simulator, policies: PolicyBatch, deterministic: bool, stop: Event
    ) -> EpisodeReturns:
        """Returns and lengths (policy, episode) of a block of policies."""
        shape = (len(policies), len(self.seeds))
        returns, lengths = np.zeros(shape), np.zeros(shape, np.int64)
        with environments.explained(self._info):
            first = simulator.reset(len(policies))
        observations = first.reshape(*shape, *first.shape[1:])
        sims = np.arange(returns.size).reshape(shape)
        running = np.ones(shape, bool)
        step = 0
        while running.any() and not self._end.cuts(step):
            if stop.is_set():
                raise KeyboardInterrupt
            if 2 * running.any(1).sum() <= len(policies):  # policies whose episodes are over leave
                keep = np.flatnonzero(running.any(1))
                policies = policies[keep]
                observations, sims, running = observations[keep], sims[keep], running[keep]
            noise = None if deterministic else self._noise_at(step, policies.spec)
            actions = self._within_bounds(policies.act(observations, noise))
            playing = sims[running]
            with environments.explained(self._info):
                result = simulator.step(playing, actions[running])
            step += 1
            observations[running] = result.observations
            returns.flat[playing] += np.where(result.unstable, np.nan, result.rewards)
            lengths.flat[playing] = step
            running[running] = ~(result.terminated | result.truncated | result.unstable)
        return EpisodeReturns(returns, lengths)

    def _within_bounds(self, actions: np.ndarray) -> np.ndarray:
        """Clip actions as ``ClipAction`` does, which trainings have and evaluations have not."""
        space = self._env.action_space
        if not isinstance(space, gym.spaces.Box):
            return actions
        return actions.clip(space.low.astype(actions.dtype), space.high.astype(actions.dtype))

    def _noise_at(self, step: int, spec: PolicySpec) -> np.ndarray:
        """What chance adds to the actions of a step, (episode, ...): the same for all policies."""
        size = max(1, len(spec.action_low))
        with self._drawing:
            drawn = self._noise.setdefault((spec.mode, size), [])
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
        if spec.is_continuous:
            return np.asarray(generator.standard_normal(shape, np.float32)[part])
        return np.asarray(generator.random(shape)[part])


def env_of(run: Run) -> EnvInfo:
    """Return the environment of a run.

    Raises:
        PolicyError: the run does not say, or names files: those of a data set are not to be opened;
            or an earlier version wrote text in place of a keyword.
    """
    if run.info.env is None:
        raise PolicyError(
            "the run does not say which environment it was trained in",
            where=run.path,
            do="pass weighttraj.format.EnvInfo(id=...), or a function that makes the environment, "
            "instead of the run",
        )
    texts = {
        name: list(environments.texts_of(value)) for name, value in run.info.env.kwargs.items()
    }
    if paths := [text for found in texts.values() for text in found if set(text) & set("/\\")]:
        raise PolicyError(
            "the run's environment is made from files of the machine it was trained on",
            got=paths,
            where=run.path,
            do="if you trust the data, pass run.info.env instead of the run",
        )
    if lost := [
        name for name, found in texts.items() if any(map(environments.stands_for_another, found))
    ]:
        raise PolicyError(
            f"this environment cannot be made again: keyword `{lost[0]}`",
            expected="a number or a function, of which an earlier version stored the text only",
            got=run.info.env.kwargs[lost[0]],
            where=run.path,
            do=environments.OWN_ENVIRONMENT,
        )
    return run.info.env


def _check_spaces(spec: PolicySpec, env: gym.Env[Any, Any]) -> None:
    observed, acted = env.observation_space, env.action_space
    kind = gym.spaces.Box if spec.is_continuous else gym.spaces.Discrete
    fits = isinstance(acted, kind) and acted.shape == spec.action_shape
    if observed.shape != spec.observation_shape or not fits:
        raise PolicyError(
            "the policy does not fit the environment",
            expected=f"observations {spec.observation_shape}, {spec.mode} actions "
            f"{spec.action_shape}",
            got=f"observations {observed}, actions {acted}",
            where=env,
            do="evaluate it in the environment it was trained in",
        )


def _batch_of(policy: Policy) -> PolicyBatch:
    stats = policy.stats
    mean, var = (None, None) if stats is None else (stats.mean[None], stats.var[None])
    return PolicyBatch(policy.spec, policy.layout, policy.weights[None], policy.obs_norm, mean, var)
