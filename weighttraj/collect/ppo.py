"""CleanRL's PPO for continuous actions, set up on Stable-Baselines3's own PPO.

Equal to CleanRL's ``ppo_continuous_action.py``: network (separate tanh actor and critic, orthogonal
initialisation, ``log_std`` from 0), Adam with eps 1e-5, annealed learning rate, rollout length,
minibatches, epochs, clipping, advantage normalisation by minibatch, entropy and value coefficients,
gradient clipping, observation and reward normalisation by Gymnasium's wrappers, clipped to +-10,
no bootstrap at the time limit (``TruncationAsTermination``).

Different, and known:

- The value loss is SB3's: the clipped one, where CleanRL takes the larger of clipped and unclipped.
  Changing that would take a copy of SB3's ``train``.
- Actions are clipped by SB3 before ``step`` and not by ``ClipAction``; the same numbers reach the
  simulator.
- The critic's width is ours: CleanRL's actor and critic share one width, the paper names only the
  policy's. Default: 64 beside an 8-unit policy, else the policy's own.
- The order in which random numbers are drawn, so equal seeds give other runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

from weighttraj import environments
from weighttraj.collect.wrappers import ClipObservation, TruncationAsTermination
from weighttraj.errors import CollectError

ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}
"""Modules of the activation functions that a recipe can name."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """One PPO training. The defaults are CleanRL's for continuous actions."""

    env_id: str = "InvertedPendulum-v4"
    """Id for ``gymnasium.make``."""
    total_timesteps: int = 800_000
    """Environment steps; rounded down to whole rollouts."""
    net_arch: tuple[int, ...] = (8, 8)
    """Units of the policy's hidden layers."""
    critic_arch: tuple[int, ...] | None = None
    """Units of the critic's hidden layers; None: the policy's, at least 64 each."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Function between the layers of both networks."""
    ortho_init: bool = True
    """Begin with orthogonal weights; False: with torch's default for linear layers."""
    log_std_init: float = 0.0
    """Logarithm of the actions' standard deviation before training."""
    learning_rate: float = 3e-4
    """Of the first iteration."""
    anneal_learning_rate: bool = True
    """Lower the learning rate linearly, to learning_rate / iterations in the last iteration."""
    n_steps: int = 2048
    """Environment steps in a rollout."""
    batch_size: int = 64
    """Samples in a minibatch."""
    n_epochs: int = 10
    """Passes over each rollout."""
    gamma: float = 0.99
    """Discount."""
    gae_lambda: float = 0.95
    """Lambda of the generalised advantage estimate."""
    clip_range: float = 0.2
    """Clip of the probability ratio."""
    clip_range_vf: float | None = 0.2
    """Clip of the value's change; None (in a recipe ``false``): not clipped."""
    normalize_advantage: bool = True
    """Standardise advantages in each minibatch."""
    ent_coef: float = 0.0
    """Weight of the entropy bonus."""
    vf_coef: float = 0.25
    """Weight of the value loss; CleanRL's 0.5 times the 0.5 inside its loss."""
    max_grad_norm: float = 0.5
    """Gradients are clipped to this norm."""
    adam_eps: float = 1e-5
    """Epsilon of Adam."""
    normalization: Literal["gymnasium", "vecnormalize", "none"] = "gymnasium"
    """Who normalises observations and rewards; ``gymnasium`` matches CleanRL."""
    truncation_as_termination: bool = True
    """Do not bootstrap at the time limit, as CleanRL does not."""

    @property
    def n_iterations(self) -> int:
        """Rollouts and updates in the whole training."""
        return self.total_timesteps // self.n_steps

    @property
    def gradient_steps_per_iteration(self) -> int:
        """Optimizer steps in one update."""
        return self.n_epochs * -(-self.n_steps // self.batch_size)

    def learning_rate_at(self, progress_remaining: float) -> float:
        """Learning rate, given the share of environment steps still to do *after* the rollout.

        SB3 lowers ``progress_remaining`` before the update, CleanRL after it; the added 1 / N
        makes the two schedules equal.
        """
        if not self.anneal_learning_rate:
            return self.learning_rate
        return self.learning_rate * (progress_remaining + 1 / self.n_iterations)


def make_env(config: PPOConfig) -> gym.Env[Any, Any]:
    """Make one environment with CleanRL's wrappers."""
    env = environments.make(config.env_id)
    if config.normalization == "gymnasium":
        env = gym.wrappers.RecordEpisodeStatistics(env)
        env = gym.wrappers.NormalizeObservation(env)
        env = ClipObservation(env, -10.0, 10.0)
        env = gym.wrappers.NormalizeReward(env, gamma=config.gamma)
        env = gym.wrappers.ClipReward(env, -10.0, 10.0)
    return TruncationAsTermination(env) if config.truncation_as_termination else env


def make_vec_env(config: PPOConfig) -> VecEnv:
    """Make the same environment as SB3 takes it: one environment, vectorised."""
    env: VecEnv = DummyVecEnv([lambda: make_env(config)])
    if config.normalization == "gymnasium":
        return env
    env = VecMonitor(env)
    return VecNormalize(env, gamma=config.gamma) if config.normalization == "vecnormalize" else env


def make_ppo(config: PPOConfig, *, seed: int) -> PPO:
    """Make SB3's PPO for a configuration. Train it with ``learn(n_iterations * n_steps)``.

    Raises:
        CollectError: the environment is unknown, or the settings leave no iteration.
    """
    if config.n_iterations < 1:
        raise CollectError(
            "the training is shorter than one rollout",
            expected=f"total_timesteps at least n_steps = {config.n_steps}",
            got=config.total_timesteps,
            do="raise total_timesteps",
        )
    schedule: Callable[[float], float] = config.learning_rate_at
    critic = config.critic_arch or tuple(max(64, units) for units in config.net_arch)
    return PPO(
        "MlpPolicy",
        make_vec_env(config),
        learning_rate=schedule,
        n_steps=config.n_steps,
        batch_size=config.batch_size,
        n_epochs=config.n_epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        clip_range_vf=config.clip_range_vf,
        normalize_advantage=config.normalize_advantage,
        ent_coef=config.ent_coef,
        vf_coef=config.vf_coef,
        max_grad_norm=config.max_grad_norm,
        target_kl=None,
        device="cpu",
        seed=seed,
        policy_kwargs={
            "net_arch": {"pi": list(config.net_arch), "vf": list(critic)},
            "activation_fn": ACTIVATIONS[config.activation],
            "ortho_init": config.ortho_init,
            "log_std_init": config.log_std_init,
            "optimizer_kwargs": {"eps": config.adam_eps},
        },
    )
