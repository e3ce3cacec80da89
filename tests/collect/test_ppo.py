from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

from tests.small import SMALL
from weighttraj.collect import PPOConfig, make_ppo
from weighttraj.collect.ppo import make_env
from weighttraj.collect.wrappers import ClipObservation, TruncationAsTermination
from weighttraj.errors import CollectError


@pytest.mark.parametrize(("timesteps", "iterations"), [(800_000, 390), (2_000_000, 976)])
def test_the_papers_lengths(timesteps: int, iterations: int) -> None:
    config = PPOConfig(total_timesteps=timesteps)
    assert config.n_iterations == iterations
    assert config.gradient_steps_per_iteration == 320
    rates = [config.learning_rate_at(1 - i / iterations) for i in range(1, iterations + 1)]
    cleanrl = [3e-4 * (1 - (i - 1) / iterations) for i in range(1, iterations + 1)]
    np.testing.assert_allclose(rates, cleanrl, rtol=1e-9)
    assert rates[0] == pytest.approx(3e-4)
    assert rates[-1] == pytest.approx(3e-4 / iterations)


@pytest.mark.parametrize("timesteps", [800_000, 2_000_000])
def test_sb3_uses_the_last_learning_rate_in_the_last_iteration(timesteps: int) -> None:
    config = PPOConfig(total_timesteps=timesteps, critic_arch=(8, 8), n_epochs=1)
    model = make_ppo(config, seed=0)
    before_last = (config.n_iterations - 1) * config.n_steps
    model.num_timesteps = before_last
    model.learn(config.n_steps, reset_num_timesteps=False)
    assert model.num_timesteps == config.n_iterations * config.n_steps
    rate = model.policy.optimizer.param_groups[0]["lr"]
    assert rate == pytest.approx(3e-4 / config.n_iterations, rel=1e-6)


def test_the_network_is_cleanrls() -> None:
    policy = make_ppo(PPOConfig(net_arch=(256, 256), env_id="HalfCheetah-v4"), seed=0).policy
    shapes = {name: tuple(p.shape) for name, p in policy.named_parameters()}
    actor = [n for n in shapes if "policy_net" in n or n.startswith(("action_net", "log_std"))]
    assert sum(np.prod(shapes[name]) for name in actor) == 71_948
    assert shapes["mlp_extractor.value_net.0.weight"] == (256, 17)
    hidden = dict(policy.named_parameters())["mlp_extractor.policy_net.2.weight"]
    assert torch.allclose(hidden @ hidden.T, 2 * torch.eye(256), atol=1e-4)
    assert policy.action_net.weight.detach().norm(dim=1).max() == pytest.approx(0.01, rel=1e-4)
    assert policy.log_std.tolist() == [0] * 6
    assert policy.optimizer.defaults["eps"] == 1e-5


def test_wrappers_stand_in_cleanrls_order() -> None:
    env, names = make_env(SMALL), []
    while isinstance(env, gym.Wrapper):
        names.append(type(env).__name__)
        env = env.env
    assert names[:6] == [
        "TruncationAsTermination",
        "ClipReward",
        "NormalizeReward",
        "ClipObservation",
        "NormalizeObservation",
        "RecordEpisodeStatistics",
    ]


def test_a_time_limit_ends_the_episode_without_bootstrap() -> None:
    env = TruncationAsTermination(gym.make("Pendulum-v1", max_episode_steps=2))
    env.reset(seed=0)
    assert env.step(np.zeros(1))[2:4] == (False, False)
    assert env.step(np.zeros(1))[2:4] == (True, False)


def test_observations_are_clipped() -> None:
    env = ClipObservation(gym.make("Pendulum-v1"), -0.5, 0.25)
    observation, _ = env.reset(seed=0)
    assert observation.max() <= 0.25
    assert observation.min() >= -0.5


@pytest.mark.parametrize("env_id", ["NoSuchEnv-v0", "os:path", "tests.small:Env"])
def test_an_unknown_environment_is_one_clear_error(env_id: str) -> None:
    with pytest.raises(CollectError, match=r"gymnasium\.pprint_registry"):
        make_ppo(replace(SMALL, env_id=env_id), seed=0)


def test_a_training_without_an_iteration_is_refused() -> None:
    with pytest.raises(CollectError, match="shorter than one rollout"):
        make_ppo(replace(SMALL, total_timesteps=63), seed=0)
