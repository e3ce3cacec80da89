"""J(pi): the undiscounted return of a policy over fixed episodes."""

from __future__ import annotations

from types import TracebackType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from jaxtyping import Float64, Int64

from weighttraj import environments
from weighttraj.errors import PolicyError
from weighttraj.format import EnvInfo, Run
from weighttraj.policies.policy import Policy


class EpisodeReturns(NamedTuple):
    """Outcome of some episodes."""

    returns: Float64[np.ndarray, " episode"]
    """Undiscounted sum of raw rewards."""
    lengths: Int64[np.ndarray, " episode"]
    """Environment steps."""


class Evaluator:
    """Plays the same episodes with one policy after another.

    Episode i starts from ``reset(seed=seed + i)`` and samples its actions with a generator of its
    own, so two policies meet the same starts and the same noise, however many episodes there are.
    (Actions are computed for all episodes at once: the last bit of an action may depend on how many
    still run.) Raw observations and rewards: the policy brings its normaliser.

    Args:
        env: the environment, as a run describes it.
        episodes: number of episodes.
        seed: of the first episode.

    Raises:
        CollectError: the environment is not registered here.
        PolicyError: fewer than one episode.
    """

    def __init__(self, env: EnvInfo, *, episodes: int = 20, seed: int = 0) -> None:
        if episodes < 1:
            raise PolicyError("no episodes to play", expected="at least 1", got=episodes)
        self.seed = seed
        limit = (
            {} if env.max_episode_steps is None else {"max_episode_steps": env.max_episode_steps}
        )
        self._envs = [environments.make(env.id, **limit, **env.kwargs) for _ in range(episodes)]

    def __call__(self, policy: Policy, *, deterministic: bool = True) -> EpisodeReturns:
        """Play every episode to its end.

        Raises:
            PolicyError: the policy's observations or actions are not the environment's.
        """
        envs = self._envs
        _check_spaces(policy, envs[0])
        observations = [env.reset(seed=self.seed + i)[0] for i, env in enumerate(envs)]
        noise = [np.random.default_rng([self.seed + i, 1]) for i in range(len(envs))]
        returns, lengths = np.zeros(len(envs)), np.zeros(len(envs), np.int64)
        active = list(range(len(envs)))
        while active:
            raw = np.stack([observations[i] for i in active])
            generators = None if deterministic else [noise[i] for i in active]
            actions = _act(policy, raw, generators)
            still = []
            for i, action in zip(active, actions, strict=True):
                observations[i], reward, terminated, truncated, _ = envs[i].step(action)
                returns[i] += float(reward)
                lengths[i] += 1
                if not (terminated or truncated):
                    still.append(i)
            active = still
        return EpisodeReturns(returns, lengths)

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()

    def __enter__(self) -> Evaluator:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def evaluate(
    policy: Policy,
    env: EnvInfo | Run | str,
    *,
    episodes: int = 20,
    seed: int = 0,
    deterministic: bool = True,
) -> EpisodeReturns:
    """Returns of a policy over fixed episode seeds.

    Args:
        policy: from ``run.load_policy(t)``.
        env: the environment, its id, or a run that was trained in it.
        episodes: number of episodes.
        seed: of the first episode; episode i starts from ``seed + i``.
        deterministic: act by the distribution's mode, else by samples.

    Raises:
        PolicyError: the run does not say which environment it was trained in.
    """
    if isinstance(env, Run):
        env = env_of(env)
    elif isinstance(env, str):
        env = EnvInfo(id=env)
    with Evaluator(env, episodes=episodes, seed=seed) as evaluator:
        return evaluator(policy, deterministic=deterministic)


def env_of(run: Run) -> EnvInfo:
    """The environment of a run.

    Raises:
        PolicyError: the run does not say, or names files: those of a data set are not to be opened.
    """
    if run.info.env is None:
        raise PolicyError(
            "the run does not say which environment it was trained in",
            where=run.path,
            do="pass weighttraj.format.EnvInfo(id=...) instead of the run",
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


def _check_spaces(policy: Policy, env: gym.Env[Any, Any]) -> None:
    observed, acted = env.observation_space, env.action_space
    spec = policy.spec
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


def _act(policy: Policy, raw: np.ndarray, noise: list[np.random.Generator] | None) -> np.ndarray:
    """Actions (batch, *action) for raw observations; noise None: the mode."""
    if noise is None:
        return policy.predict(raw, deterministic=True)[0]
    distribution = policy.distribution(torch.from_numpy(policy.normalize(raw)))
    if isinstance(distribution, torch.distributions.Categorical):
        uniform = torch.tensor([g.random() for g in noise])[:, None]
        cumulative = distribution.probs.double().cumsum(1)
        choice = (uniform > cumulative).sum(1).clamp(max=cumulative.shape[1] - 1)
        return policy.to_actions(choice)
    size = distribution.mean.shape[1]
    normal = np.stack([g.standard_normal(size, np.float32) for g in noise])
    return policy.to_actions(distribution.mean + distribution.stddev * torch.from_numpy(normal))
