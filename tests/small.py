"""Settings of the short trainings that the tests share."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from weighttraj.collect import PPOConfig, Recipe, make_ppo
from weighttraj.collect.settings import Seeds, Store

# 4 rollouts of 64 steps, 8 gradient steps each: a second of training, same code as a long one.
SMALL = PPOConfig(total_timesteps=256, n_steps=64, batch_size=16, n_epochs=2, critic_arch=(8, 8))
SMALL_RECIPE = Recipe(
    id="small",
    ppo=replace(SMALL, total_timesteps=768),
    seeds=Seeds(train=[0, 1], test=[2, 3]),
    store=Store(every=2, block=8, probe_observations=4),
)
CONFIGS = {
    "gymnasium": SMALL,
    "vecnormalize": replace(SMALL, normalization="vecnormalize"),
    "none": replace(SMALL, normalization="none"),
    # float32 observations, whose statistics Gymnasium keeps in float32, and discrete actions
    "categorical": replace(SMALL, env_id="CartPole-v1"),
}


def learn(config: PPOConfig, callback: BaseCallback | list[BaseCallback] | None) -> PPO:
    model = make_ppo(config, seed=3)
    return model.learn(config.n_iterations * config.n_steps, callback=callback)


def random_states(model: PPO) -> list[Any]:
    """Every generator that a training draws from."""
    env = model.get_env().envs[0]  # type: ignore[union-attr]
    return [
        torch.get_rng_state().tolist(),
        np.random.get_state()[1].tolist(),
        random.getstate(),
        env.unwrapped.np_random.bit_generator.state,
        env.action_space.np_random.bit_generator.state,
    ]
