"""Policies of off-policy algorithms act as the agent did, alone, in batches, and for returns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib
import torch
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from torch import nn

import weighttraj as wt
from tests.collect.test_algorithms import MODELS, off
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.errors import PolicyError
from weighttraj.policies import evaluate, export_sb3, load_policies


def recorded(model: Any, path: Path) -> wt.Run:
    model.learn(30, callback=WeightTrajectoryCallback(path / "run.zarr", every=4))
    return wt.open_run(path / "run.zarr")


def moved(model: Any, network: nn.Module, seed: int) -> None:
    """Give the agent weights far from where it started, so that outputs are of all sizes."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.normal_(std=0.5, generator=generator)


NETWORKS = {"SAC": "actor", "TD3": "actor", "DDPG": "actor", "TQC": "actor", "DQN": "q_net"}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("net_arch", [[], [8, 4]])
def test_stored_policies_act_bit_by_bit_as_the_agent(
    name: str, net_arch: list[int], tmp_path: Path
) -> None:
    model: Any = MODELS[name]()
    kwargs = {"net_arch": net_arch, "activation_fn": nn.Tanh}
    model = type(model)("MlpPolicy", model.env, **off(policy_kwargs=kwargs))
    network = getattr(model, NETWORKS[name])
    moved(model, network, 1)
    run = recorded(model, tmp_path)
    raw = np.random.default_rng(0).normal(size=(32, *model.observation_space.shape)) * 3
    raw = raw.astype(np.float32)
    policy = run.load_policy(-1)
    for observations in (raw, raw[0]):
        for deterministic in (True, False):
            torch.manual_seed(5)
            expected = model.policy.predict(observations, deterministic=deterministic)[0]
            torch.manual_seed(5)
            got = policy.predict(observations, deterministic=deterministic)[0]
            assert np.array_equal(got, expected), (name, deterministic)
    batch = load_policies(run, [0, len(run) - 1])
    several = batch.act(np.stack([raw, raw]))[1]
    np.testing.assert_allclose(several, policy.predict(raw, deterministic=True)[0], atol=1e-5)
    assert run.info.policy.cannot_rebuild == ()
    assert wt.verify(run.path) == []


@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN"])
def test_returns_are_those_of_the_agent(name: str, tmp_path: Path) -> None:
    model: Any = MODELS[name]()
    run = recorded(model, tmp_path)
    env_id = "CartPole-v1" if name == "DQN" else "Pendulum-v1"
    env = Monitor(gym.make(env_id))
    env.reset(seed=7)
    expected, _ = evaluate_policy(model.policy, env, n_eval_episodes=1, return_episode_rewards=True)
    live = []
    for seed in (7, 8):
        total, done, (obs, _) = 0.0, False, env.reset(seed=seed)
        while not done:
            action = model.policy.predict(obs, deterministic=True)[0]
            obs, reward, terminated, truncated, _ = env.step(action)
            total, done = total + float(reward), terminated or truncated
        live.append(total)
    got = evaluate(run.load_policy(-1), run, episodes=2, seed=7).returns
    np.testing.assert_allclose(got, live, rtol=1e-3)
    sampled = evaluate(run.load_policy(-1), run, episodes=2, seed=7, deterministic=False).returns
    assert np.array_equal(sampled, got) == (name != "SAC")
    assert len(expected) == 1


def test_a_policy_that_acts_in_one_way_has_no_distribution(tmp_path: Path) -> None:
    run = recorded(TD3("MlpPolicy", "Pendulum-v1", **off()), tmp_path)
    with pytest.raises(PolicyError, match="no distribution"):
        run.load_policy(0).distribution(torch.zeros(1, 3))
    with pytest.raises(PolicyError, match="only policies of PPO and A2C"):
        export_sb3(run, 0, tmp_path / "export")
    assert not (tmp_path / "export").exists()


class Doubled(SAC):
    """Acts with twice the mean that its layers give."""

    def _setup_model(self) -> None:
        super()._setup_model()
        inner = self.actor.get_action_dist_params

        def doubled(obs: Any) -> Any:
            mean, log_std, rest = inner(obs)
            return 2 * mean, log_std, rest

        self.actor.get_action_dist_params = doubled  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: SAC("MlpPolicy", "Pendulum-v1", **off(use_sde=True)), "policy class Actor"),
        (lambda: sb3_contrib.CrossQ("MlpPolicy", "Pendulum-v1", **off()), "buffers"),
        (lambda: sb3_contrib.QRDQN("MlpPolicy", "CartPole-v1", **off()), "QuantileNetwork"),
        (lambda: Doubled("MlpPolicy", "Pendulum-v1", **off()), "acts otherwise|be copied"),
    ],
)
def test_other_actors_are_recorded_and_not_rebuilt(make: Any, reason: str, tmp_path: Path) -> None:
    model = make()
    with pytest.warns(UserWarning, match="cannot rebuild"):
        run = recorded(model, tmp_path)
    with pytest.raises(PolicyError, match=reason):
        run.load_policy()
    assert len(run) > 2


def test_an_off_policy_snapshot_is_loaded_into_another_model(tmp_path: Path) -> None:
    run = recorded(DQN("MlpPolicy", "CartPole-v1", **off()), tmp_path)
    other = DQN("MlpPolicy", "CartPole-v1", **off(seed=1))
    run.load_into(other, 0)
    first = torch.cat([p.detach().reshape(-1) for p in other.q_net.parameters()]).numpy()
    assert np.array_equal(first, run.weights[0])
