"""Many PPO trainings in lockstep in one process: the fast road to many seeds.

A population does what ``ppo.make_ppo`` and ``learn`` do, for many seeds at once: networks are
stacked, physics is batched. It draws the random numbers that SB3 draws, each learner from
generators of its own that go on where SB3's stand once the model is made. So a learner is the SB3
run of its seed up to the rounding of float32, which training magnifies in time as it does any
difference. A learner's bits depend on its seed alone, not on those beside it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from weighttraj import environments
from weighttraj.collect.agents import actor_parameters, critic_parameters
from weighttraj.collect.learners import Learners, Rollout
from weighttraj.collect.limits import population_problems
from weighttraj.collect.networks import MLP, Stack
from weighttraj.collect.ppo import PPOConfig, make_ppo
from weighttraj.collect.recorder import Reading
from weighttraj.collect.rollouts import Environments, check_kernel
from weighttraj.collect.undisturbed import undisturbed
from weighttraj.errors import CollectError
from weighttraj.writer import Moments

_SERIAL = 15
"""Torch draws up to so many normal numbers one by one, whatever their grouping; more of them by
another algorithm."""
_GROUP = 2**20
"""Parameters that are updated together: 16 MB with gradients and moments, which caches hold."""
_LOG_SQRT_2PI = np.float32(0.5 * np.log(2 * np.pi))


@runtime_checkable
class Watcher(Protocol):
    """What is told of one learner's training: see ``Recorder``."""

    def end_rollout(self, returns: Sequence[Any], inputs: np.ndarray) -> None:
        """A rollout is there."""

    def end_gradient_step(self) -> None:
        """The weights have changed."""

    def end_update(self, diagnostics: Mapping[str, float]) -> None:
        """An update has ended."""

    def end_training(self, diagnostics: Mapping[str, float]) -> None:
        """The last update has ended."""


@dataclass(frozen=True, kw_only=True)
class Boundary:
    """What a hook sees between an update and the next rollout."""

    iteration: int
    """Number of updates so far."""
    num_timesteps: int
    """Environment steps of each learner so far."""
    progress_remaining: float
    """Share of the environment steps that is still to come, from 1 to 0."""
    learning_rate: float
    """Learning rate of the update that just ended."""
    weights: np.ndarray
    """Policy weights, float32 (learner, param): a copy."""
    rollout: Rollout
    """The last rollout of all learners."""
    returns: list[list[float]]
    """Returns of the training episodes that ended in that rollout, for each learner."""


Hook = Callable[[Boundary], None]
"""A function that is called at each iteration boundary. It may move the weights with
``Population.write`` and ``Population.restore``."""


@dataclass(frozen=True, kw_only=True)
class LearnerState:
    """A copy of what one learner has learnt: see ``Population.save``."""

    parameters: Tensor
    """Row of the stack: actor and critic."""
    adam: dict[str, Tensor]
    """Adam's state of the same parameters: ``step``, ``exp_avg`` and ``exp_avg_sq``."""
    obs_norm: Moments | None
    """Statistics of the observations; None: there is no normaliser."""
    ret_norm: Moments | None
    """Statistics of the discounted rewards; None: there is no normaliser."""


class Origin:
    """What SB3 makes of a seed before training begins.

    Args:
        config: settings of the training.
        seed: of the run.
    """

    def __init__(self, config: PPOConfig, seed: int) -> None:
        self.seed = seed
        self.noise, self.shuffle = torch.Generator(), np.random.RandomState()
        with undisturbed():
            self.model = make_ppo(config, seed=seed)
            self.noise.set_state(torch.get_rng_state())
            self.shuffle.set_state(np.random.get_state())  # noqa: NPY002 (SB3 uses it)
            # As learn() begins: only an observation shows the type that statistics are kept in.
            cast(VecEnv, self.model.get_env()).reset()


class Population:
    """Learners of several seeds, trained together. Torch should be set to one thread.

    Args:
        config: settings, the same for all.
        origins: where each learner begins, at least two: torch computes for a single learner by
            other kernels than for several, and its bits would be others.

    Raises:
        CollectError: a population cannot do what the settings ask for.
    """

    def __init__(self, config: PPOConfig, origins: Sequence[Origin]) -> None:
        check_config(config)
        policy = origins[0].model.policy
        self._config = config
        self._noise = [origin.noise for origin in origins]
        self._shuffle = [origin.shuffle for origin in origins]
        self.stack = _stack(origins)
        """Parameters of all learners."""
        actor, critic = list(actor_parameters(policy)), list(critic_parameters(policy))
        self._actor, self._critic = self.stack.places(actor), self.stack.places(critic)
        layers = _layers(actor), _layers(critic)
        self._act, self._judge = (MLP(self.stack, names, 1, config.activation) for names in layers)
        groups = _groups(*self.stack.values.shape)
        self.groups = [(part, Learners(config, self.stack[part], *layers)) for part in groups]
        """Learners that are updated together."""
        self._environments = Environments(config, [origin.seed for origin in origins])
        self._learning_rate = config.learning_rate
        self.num_timesteps = 0
        """Environment steps of each learner so far."""

    def read(self, learner: int, *, critic: bool = False, moments: bool = False) -> Reading:
        """Return what a learner is now.

        Args:
            learner: which.
            critic: read the critic's parameters too.
            moments: read Adam's moments of the actor's parameters too.
        """
        row, actor = self.stack.values[learner].numpy(), self._actor
        return {
            "weights": row[actor],
            "num_timesteps": self.num_timesteps,
            "learning_rate": self._learning_rate,
            "obs_norm": self._environments.normalizer.obs_norm(learner),
            "ret_norm": self._environments.normalizer.ret_norm(learner),
            "critic": row[self._critic] if critic else None,
            "moments": self._moments(learner) if moments else None,
        }

    @property
    def learning_rate(self) -> float:
        """Learning rate of the update that goes on, or of the last one."""
        return self._learning_rate

    def weights(self, learner: int) -> np.ndarray:
        """Return a copy of a learner's policy weights, float32 (param,)."""
        return np.asarray(self.stack.values[learner].numpy()[self._actor])

    @torch.no_grad()
    def write(self, learner: int, weights: np.ndarray) -> None:
        """Replace a learner's policy weights, float32 (param,); all else stays as it is."""
        self.stack.values[learner].numpy()[self._actor] = weights

    def forget_direction(self, learner: int) -> None:
        """Set Adam's first moment of a learner's policy weights to 0."""
        self._adam(learner)["exp_avg"].numpy()[self._actor] = 0

    def save(self, learner: int) -> LearnerState:
        """Return a copy of a learner's policy, critic, Adam's state and normalisers."""
        normalizer = self._environments.normalizer
        return LearnerState(
            parameters=self.stack.values[learner].clone(),
            adam={name: value.clone() for name, value in self._adam(learner).items()},
            obs_norm=normalizer.obs_norm(learner),
            ret_norm=normalizer.ret_norm(learner),
        )

    @torch.no_grad()
    def restore(self, learner: int, state: LearnerState) -> None:
        """Put a learner back to what ``save`` returned. Its environment goes on where it is."""
        self.stack.values[learner] = state.parameters
        adam = self._adam(learner)
        for name, value in state.adam.items():
            adam[name].copy_(value)
        self._environments.normalizer.restore(learner, state.obs_norm, state.ret_norm)

    def train(
        self,
        watchers: Sequence[Watcher],
        stop: Callable[[], bool] = lambda: False,
        hook: Hook | None = None,
    ) -> None:
        """Train to the end.

        Args:
            watchers: who follows the first learners; the others are not followed.
            stop: asked before each rollout; True ends the training there.
            hook: called after each update; None: training is the same, bit by bit, as with a hook
                that changes nothing.
        """
        total = self._config.n_iterations * self._config.n_steps
        while self.num_timesteps < total and not stop():
            for ended in self._environments.ended:
                ended.clear()
            rollout = self._iterate(watchers, total)
            if hook is not None:
                hook(self._boundary(rollout, total))

    def close(self) -> None:
        """Close the environments."""
        self._environments.close()

    @torch.no_grad()
    def _iterate(self, watchers: Sequence[Watcher], total: int) -> Rollout:
        rollout = self._roll_out()
        self.num_timesteps += self._config.n_steps
        for watcher, returns, inputs in zip(
            watchers, self._environments.returns, rollout.observations, strict=False
        ):
            watcher.end_rollout(returns, inputs.numpy())
        self._learning_rate = self._config.learning_rate_at(1.0 - self.num_timesteps / total)
        order = self._permutations()
        for part, learners in self.groups:
            some = watchers[part]
            diagnostics = learners.update(
                rollout[part], order[:, part], self._learning_rate, _after_step(some)
            )
            for watcher, figures in zip(some, diagnostics, strict=False):
                last = self.num_timesteps >= total
                (watcher.end_training if last else watcher.end_update)(figures)
        return rollout

    def _boundary(self, rollout: Rollout, total: int) -> Boundary:
        return Boundary(
            iteration=self.num_timesteps // self._config.n_steps,
            num_timesteps=self.num_timesteps,
            progress_remaining=1.0 - self.num_timesteps / total,
            learning_rate=self._learning_rate,
            weights=self.stack.values.numpy()[:, self._actor],
            rollout=rollout,
            returns=[list(ended) for ended in self._environments.ended],
        )

    def _roll_out(self) -> Rollout:
        """Let every learner act for a rollout; then judge what it saw, in one go."""
        config, environments = self._config, self._environments
        n, size = environments.inputs.shape
        buffer = RolloutBuffer(
            config.n_steps,
            spaces.Box(-np.inf, np.inf, (size,)),
            environments.action_space,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            n_envs=n,
        )
        noise, means = self._draw_noise(), np.empty_like(buffer.actions)
        std = self.stack.value("log_std").exp().numpy()
        for t in range(config.n_steps):
            buffer.observations[t] = inputs = environments.inputs
            buffer.episode_starts[t] = environments.starting
            means[t] = self._act.forward(torch.from_numpy(inputs)[:, None])[:, 0].numpy()
            buffer.actions[t] = actions = means[t] + noise[t] * std
            buffer.rewards[t] = environments.step(actions)
            if not config.truncation_as_termination and environments.truncated.any():
                self._bootstrap(buffer.rewards[t])
        buffer.log_probs[:] = _log_probs(buffer.actions, means, std)
        observations = _by_learner(buffer.observations)
        for part, learners in self.groups:
            buffer.values[:, part] = learners.estimate(observations[part]).T.numpy()
        last = self._judge_each(environments.inputs)
        buffer.compute_returns_and_advantage(last, environments.starting)
        return Rollout(
            observations=observations,
            actions=_by_learner(buffer.actions),
            log_probs=_by_learner(buffer.log_probs),
            values=_by_learner(buffer.values),
            advantages=_by_learner(buffer.advantages),
            returns=_by_learner(buffer.returns),
        )

    def _bootstrap(self, rewards: np.ndarray) -> None:
        """Add the value of what would have come to rewards at the time limit, as SB3 does."""
        values = self._judge_each(self._environments.last_inputs())[:, 0, 0].numpy()
        cut = self._environments.truncated
        rewards[cut] += np.float32(self._config.gamma) * values[cut]

    def _judge_each(self, inputs: np.ndarray) -> Tensor:
        """Return the critic's values (learner, 1, 1) of one input each, (learner, obs)."""
        return self._judge.forward(torch.from_numpy(inputs)[:, None])

    def _draw_noise(self) -> np.ndarray:
        """Standard normal numbers as SB3's distribution draws them, (step, learner, action)."""
        steps, size = self._config.n_steps, self._environments.action_space.shape[0]
        noise = torch.stack([draw_normal(g, steps, size) for g in self._noise], dim=1)
        return noise.numpy()

    def _permutations(self) -> np.ndarray:
        """Return the order of the samples as SB3's buffer draws it, (epoch, learner, step)."""
        epochs, steps = range(self._config.n_epochs), self._config.n_steps
        orders = [[state.permutation(steps) for _ in epochs] for state in self._shuffle]
        return np.array(orders).swapaxes(0, 1)

    def _moments(self, learner: int) -> tuple[np.ndarray, np.ndarray]:
        adam = self._adam(learner)
        return adam["exp_avg"].numpy()[self._actor], adam["exp_avg_sq"].numpy()[self._actor]

    def _adam(self, learner: int) -> dict[str, Tensor]:
        """Return Adam's state of a learner, see ``Learners.adam``."""
        part, learners = next(pair for pair in self.groups if learner < pair[0].stop)
        return learners.adam(learner - part.start)


def origins_of(config: PPOConfig, seeds: Sequence[int]) -> list[Origin]:
    """Return where the learners of some seeds begin; a lone one comes twice, see ``Population``."""
    return [Origin(config, seed) for seed in (seeds if len(seeds) > 1 else [*seeds, *seeds])]


def draw_normal(generator: torch.Generator, steps: int, size: int) -> Tensor:
    """The numbers of ``steps`` draws of ``size`` standard normal ones, float32 (steps, size)."""
    numbers = torch.empty(steps * size)
    together = size if size > _SERIAL else _SERIAL
    for start in range(0, len(numbers), together):
        numbers[start : start + together].normal_(generator=generator)
    return numbers.view(steps, size)


def check_config(config: PPOConfig) -> None:
    """Check that a population can do what a training asks for.

    Raises:
        CollectError: it cannot, or the environment is unknown.
    """
    wrong = list(population_problems(config))
    if wrong:
        raise CollectError(
            "a population cannot train with these settings",
            expected="; ".join(f"{problem.key} {problem.expected}" for problem in wrong),
            got="; ".join(f"{problem.key} = {problem.got}" for problem in wrong),
            do='change these settings, or collect with collector = "sb3"',
        )
    env = environments.make(config.env_id)
    check_kernel(env, config.env_id)
    env.close()


def _after_step(watchers: Sequence[Watcher]) -> Callable[[], None]:
    def tell() -> None:
        for watcher in watchers:
            watcher.end_gradient_step()

    return tell


def _stack(origins: Sequence[Origin]) -> Stack:
    """Return the initial parameters of all learners."""
    parameters = [dict(origin.model.policy.named_parameters()) for origin in origins]
    stack = Stack({name: p.shape for name, p in parameters[0].items()}, len(origins))
    for i, named in enumerate(parameters):
        for name, parameter in named.items():
            stack.value(name)[i] = parameter.detach()
    return stack


def _layers(names: Sequence[str]) -> list[str]:
    """Return prefixes of the layers among some parameters, first layer first."""
    return [name.removesuffix(".weight") for name in names if name.endswith(".weight")]


def _groups(learners: int, width: int) -> list[slice]:
    """Learners that are updated together, at least two each."""
    count = min(learners // 2, -(-learners * width // _GROUP))
    bounds = [learners * i // count for i in range(count + 1)]
    return [slice(start, stop) for start, stop in itertools.pairwise(bounds)]


def _log_probs(actions: np.ndarray, means: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Return log-densities of actions, summed over their dimensions, float32 (step, learner)."""
    squares = np.square(actions - means) / (2 * np.square(std))
    return np.asarray((-squares - np.log(std) - _LOG_SQRT_2PI).sum(-1))


def _by_learner(values: np.ndarray) -> Tensor:
    """(step, learner, ...) as a tensor (learner, step, ...)."""
    return torch.from_numpy(np.ascontiguousarray(values.swapaxes(0, 1)))
