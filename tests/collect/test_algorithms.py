"""Every algorithm is recorded truthfully, or refused when training starts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch
from sb3_contrib.common.envs import InvalidActionEnvDiscrete
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

import weighttraj as wt
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.collect.agents import actor_parameters
from weighttraj.errors import CollectError

pytestmark = pytest.mark.filterwarnings("ignore:the weights of this training are recorded")

ON = {"n_steps": 32, "batch_size": 16, "n_epochs": 1, "seed": 0, "device": "cpu"}


def off(**settings: Any) -> dict[str, Any]:
    few = {"learning_starts": 10, "buffer_size": 100, "batch_size": 16, "seed": 0, "device": "cpu"}
    return few | {"policy_kwargs": {"net_arch": [8]}} | settings


MODELS: dict[str, Callable[[], BaseAlgorithm]] = {
    "SAC": lambda: SAC("MlpPolicy", "Pendulum-v1", **off()),
    "TD3": lambda: TD3("MlpPolicy", "Pendulum-v1", **off(policy_delay=2)),
    "DDPG": lambda: DDPG("MlpPolicy", "Pendulum-v1", **off(gradient_steps=2)),
    "DQN": lambda: DQN("MlpPolicy", "CartPole-v1", **off(train_freq=2)),
    "TQC": lambda: sb3_contrib.TQC("MlpPolicy", "Pendulum-v1", **off()),
    "CrossQ": lambda: sb3_contrib.CrossQ("MlpPolicy", "Pendulum-v1", **off()),
    "QRDQN": lambda: sb3_contrib.QRDQN("MlpPolicy", "CartPole-v1", **off()),
    "RecurrentPPO": lambda: sb3_contrib.RecurrentPPO(
        "MlpLstmPolicy", "Pendulum-v1", policy_kwargs={"lstm_hidden_size": 3}, **ON
    ),
    "MaskablePPO": lambda: sb3_contrib.MaskablePPO(
        "MlpPolicy", InvalidActionEnvDiscrete(dim=8, n_invalid_actions=2), **ON
    ),
}


class Witness(BaseCallback):
    """Copies the acting network's weights and the counters after each step of its optimizer."""

    def __init__(self, network: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        super().__init__()
        self.network, self.optimizer = network, optimizer
        self.weights = [self._weights()]
        self.timesteps = [0]

    def _on_training_start(self) -> None:
        self.optimizer.register_step_post_hook(self._look)

    def _look(self, *_: object) -> None:
        self.weights.append(self._weights())
        self.timesteps.append(self.model.num_timesteps)

    def _weights(self) -> np.ndarray:
        parameters = actor_parameters(self.network).values()
        return torch.cat([p.detach().reshape(-1) for p in parameters]).numpy().copy()

    def _on_step(self) -> bool:
        return True


def acting(model: Any) -> tuple[nn.Module, torch.optim.Optimizer]:
    """The acting network and its optimizer, as SB3's sources say."""
    if isinstance(model, SAC | TD3 | sb3_contrib.TQC | sb3_contrib.CrossQ):
        return model.actor, model.actor.optimizer
    if isinstance(model, DQN):
        return model.q_net, model.policy.optimizer
    if isinstance(model, sb3_contrib.QRDQN):
        return model.quantile_net, model.policy.optimizer
    return model.policy, model.policy.optimizer


@pytest.mark.parametrize("name", MODELS)
def test_each_snapshot_is_the_acting_network_after_its_optimizers_step(
    name: str, tmp_path: Path
) -> None:
    model = MODELS[name]()
    witness = Witness(*acting(model))
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=2)
    model.learn(64 if "PPO" in name else 30, callback=[callback, witness])
    run = wt.open_run(tmp_path / "run.zarr")
    steps = run["index/gradient_step"][:]
    last = len(witness.weights) - 1
    assert last >= 4
    assert steps.tolist() == [*range(0, last, 2), last]
    assert np.array_equal(run.weights[:], np.stack(witness.weights)[steps])
    assert run.num_timesteps.tolist() == np.array(witness.timesteps)[steps].tolist()
    assert (np.abs(np.diff(run.weights[:], axis=0)).max(axis=1) > 0).all()
    if "PPO" not in name:
        for counter in ("iteration", "epoch", "phase"):
            assert set(run[f"index/{counter}"][:].tolist()) == {-1}, counter
    assert wt.verify(run.path) == []
    assert np.isfinite([run[f"train/{n}"][-1] for n in run.info.diagnostics[:-1]]).all()
    assert np.isfinite(run.learning_rate[1:]).all()


def test_td3_counts_the_actors_steps_not_the_critics(tmp_path: Path) -> None:
    model = TD3("MlpPolicy", "Pendulum-v1", **off(policy_delay=3))
    model.learn(40, callback=WeightTrajectoryCallback(tmp_path / "run.zarr", every=5))
    run = wt.open_run(tmp_path / "run.zarr")
    assert run["index/gradient_step"][:].tolist() == [0, 5, 10]
    assert run.num_timesteps.tolist() == [0, 10 + 15, 10 + 30]


def test_critic_and_moments_of_an_off_policy_algorithm_are_stored(tmp_path: Path) -> None:
    model = SAC("MlpPolicy", "Pendulum-v1", **off())
    callback = WeightTrajectoryCallback(
        tmp_path / "run.zarr", every=5, critic=True, optimizer_moments=True
    )
    model.learn(20, callback=callback)
    run = wt.open_run(tmp_path / "run.zarr")
    critic = torch.cat([p.detach().reshape(-1) for p in model.critic.parameters()])
    assert np.array_equal(run["critic/weights"][-1], critic.numpy())
    state = model.actor.optimizer.state
    moments = [state[p]["exp_avg"].reshape(-1) for p in model.actor.parameters()]
    assert np.array_equal(run["optimizer/exp_avg"][-1], torch.cat(moments).numpy())


def test_a_critic_that_is_none_is_refused(tmp_path: Path) -> None:
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", critic=True)
    with pytest.raises(CollectError, match="no critic apart"):
        DQN("MlpPolicy", "CartPole-v1", **off()).learn(5, callback=callback)
    assert not (tmp_path / "run.zarr").exists()


@pytest.mark.parametrize("name", ["SAC", "TD3", "DQN"])
def test_off_policy_training_is_the_same_with_and_without_the_callback(
    name: str, tmp_path: Path
) -> None:
    ends = []
    for callback in (None, WeightTrajectoryCallback(tmp_path / "run.zarr", every=3)):
        model = MODELS[name]()
        model.learn(30, callback=callback)
        ends.append(nn.utils.parameters_to_vector(model.policy.parameters()))
    assert torch.equal(*ends)


# Policies that no optimizer moves


def trpo(env: str = "Pendulum-v1") -> Any:
    return sb3_contrib.TRPO("MlpPolicy", env, n_steps=32, batch_size=32, seed=0, device="cpu")


def ars() -> Any:
    return sb3_contrib.ARS("MlpPolicy", "CartPole-v1", n_delta=1, seed=0, device="cpu")


class MyTRPO(sb3_contrib.TRPO):
    pass


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (trpo, "TRPO: a line search"),
        (lambda: MyTRPO("MlpPolicy", "Pendulum-v1", n_steps=128, device="cpu"), "TRPO: a line"),
        (ars, "ARS: random search"),
    ],
)
def test_policies_that_no_optimizer_moves_are_refused_at_the_start(
    make: Callable[[], Any], why: str, tmp_path: Path
) -> None:
    model = make()
    with pytest.raises(CollectError, match=f"(?s)PPO, A2C, SAC.*{why}.*unit='update'"):
        model.learn(64, callback=WeightTrajectoryCallback(tmp_path / "runs/run.zarr"))
    assert model.num_timesteps == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("make", "timesteps"), [(trpo, 96), (ars, 60)])
def test_updates_of_any_algorithm_are_recorded(
    make: Callable[[], Any], timesteps: int, tmp_path: Path
) -> None:
    model = make()
    model.learn(timesteps, callback=WeightTrajectoryCallback(tmp_path / "run.zarr", unit="update"))
    run = wt.open_run(tmp_path / "run.zarr")
    assert len(run) >= 3
    assert run["index/gradient_step"][:].tolist() == list(range(len(run)))
    assert run.iteration.tolist() == list(range(len(run)))
    assert (np.abs(np.diff(run.weights[:], axis=0)).max(axis=1) > 0).all()
    last = torch.cat([p.detach().reshape(-1) for p in actor_parameters(model.policy).values()])
    assert np.array_equal(run.weights[-1], last.numpy())
    assert run.info.cadence == wt.format.Cadence(
        every=1, unit="update", gradient_steps_per_iteration=1
    )
    assert wt.lint(run.path) == []


# Unknown subclasses


class ByHand(PPO):
    """Moves the policy without an optimizer."""

    def train(self) -> None:
        with torch.no_grad():
            self.policy.action_net.weight.add_(0.1)


class Behind(PPO):
    """Moves the policy beside the optimizer, behind autograd's back."""

    def train(self) -> None:
        super().train()
        self.policy.action_net.bias.data = self.policy.action_net.bias.data + 0.1


class Between(PPO):
    """Moves the policy before some step of the optimizer."""

    def train(self) -> None:
        self.policy.log_std.data.add_(0.1)
        super().train()


class OtherOptimizer(PPO):
    """Begins each update with a new optimizer, whose steps nobody counts."""

    def train(self) -> None:
        self.policy.optimizer = torch.optim.SGD(self.policy.parameters(), lr=1e-3)
        super().train()


class OtherNetwork(PPO):
    """Replaces a layer."""

    def train(self) -> None:
        super().train()
        self.policy.action_net = nn.Linear(64, 1)


@pytest.mark.parametrize("kind", [ByHand, Behind, Between, OtherOptimizer, OtherNetwork])
def test_weights_that_change_outside_the_counted_steps_end_the_training(
    kind: type[PPO], tmp_path: Path
) -> None:
    model = kind("MlpPolicy", "Pendulum-v1", **ON)
    with pytest.raises(CollectError, match=f"{kind.__name__} changes the policy's weights"):
        model.learn(96, callback=WeightTrajectoryCallback(tmp_path / "run.zarr", every=1))
    assert model.num_timesteps <= 64
    assert not (tmp_path / "run.zarr").exists()


@pytest.mark.parametrize("kind", [ByHand, Behind, Between, OtherOptimizer])
def test_with_updates_as_unit_they_are_recorded(kind: type[PPO], tmp_path: Path) -> None:
    model = kind("MlpPolicy", "Pendulum-v1", **ON)
    model.learn(96, callback=WeightTrajectoryCallback(tmp_path / "run.zarr", unit="update"))
    run = wt.open_run(tmp_path / "run.zarr")
    assert run["index/gradient_step"][:].tolist() == [0, 1, 2, 3]
    last = torch.cat([p.detach().reshape(-1) for p in actor_parameters(model.policy).values()])
    assert np.array_equal(run.weights[-1], last.numpy())


def test_weights_that_change_later_end_the_training_and_keep_what_was_true(tmp_path: Path) -> None:
    class Meddler(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 80:
                self.model.policy.action_net.weight.data.mul_(1.1)
            return True

    model = PPO("MlpPolicy", "Pendulum-v1", **ON)
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1)
    with pytest.raises(CollectError, match="during a rollout"):
        model.learn(160, callback=[callback, Meddler()])
    run = wt.open_run(tmp_path / "run.zarr")
    assert run["index/gradient_step"][:].tolist() == [0, 1, 2, 3, 4]
    assert run.info.status == "crashed"


def test_an_optimizer_of_other_parameters_is_refused(tmp_path: Path) -> None:
    model = A2C("MlpPolicy", "Pendulum-v1", device="cpu")
    model.policy.optimizer = torch.optim.Adam(model.policy.value_net.parameters())
    with pytest.raises(CollectError, match="no single optimizer steps the policy of A2C"):
        model.learn(10, callback=WeightTrajectoryCallback(tmp_path / "run.zarr"))
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_unit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CollectError, match="'gradient_step' or 'update'"):
        WeightTrajectoryCallback(tmp_path / "run.zarr", unit="rollout")
