"""Networks of other trainings, described."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from torch import nn

import weighttraj as wt
from weighttraj.collect import describe_mlp
from weighttraj.collect.agents import actor_parameters
from weighttraj.collect.describe import describe_layout, describe_policy
from weighttraj.errors import CollectError, PolicyError
from weighttraj.policies.policy import Policy

BOX = spaces.Box(-1, 1, (3,))


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
def test_it_says_of_a_network_what_the_collector_says_of_the_model(env_id: str) -> None:
    env = gym.make(env_id)
    model = PPO("MlpPolicy", env, seed=0, device="cpu")
    actor = nn.Sequential(*model.policy.mlp_extractor.policy_net, model.policy.action_net)
    layout, spec = describe_mlp(actor, env.observation_space, env.action_space)
    wanted = describe_policy(model.policy, ())
    assert {**vars(spec), "layers": ()} == {**vars(wanted), "layers": ()}
    theirs = describe_layout(actor_parameters(model.policy), wanted)
    assert {(p.shape, p.role, p.axes) for p in layout.params} == {
        (p.shape, p.role, p.axes) for p in theirs.params
    }
    tensors = actor.state_dict()
    if env_id == "Pendulum-v1":
        tensors |= {"log_std": model.policy.log_std.detach()}
    policy = Policy(spec, layout, layout.flatten(tensors))
    obs = np.linspace(-1, 1, env.observation_space.shape[0], dtype=np.float32)  # type: ignore[index]
    ours, _ = policy.predict(obs, deterministic=True)
    assert np.array_equal(ours, model.predict(obs, deterministic=True)[0])


@pytest.mark.parametrize(
    ("actor", "observations", "actions", "said"),
    [
        (nn.Sequential(nn.Linear(3, 2), nn.Tanh()), BOX, BOX, "layers that are not"),
        (nn.Sequential(nn.Linear(3, 2), nn.Linear(2, 3)), BOX, BOX, "layers that are not"),
        (nn.Sequential(nn.Linear(3, 3, bias=False)), BOX, BOX, "with biases"),
        (
            nn.Sequential(nn.Linear(3, 2), nn.Tanh(), nn.Linear(2, 2), nn.ReLU(), nn.Linear(2, 3)),
            BOX,
            BOX,
            "layers that are not",
        ),
        (
            nn.Sequential(nn.Linear(3, 2), nn.LeakyReLU(0.3), nn.Linear(2, 3)),
            BOX,
            BOX,
            "layers that are not",
        ),
        (nn.Sequential(nn.Linear(3, 2)), BOX, spaces.Discrete(2, start=1), "start at 0"),
        (nn.Sequential(nn.Linear(3, 2)), BOX, spaces.MultiBinary(2), "actions in MultiBinary"),
        (nn.Sequential(nn.Linear(3, 2)), spaces.Discrete(3), BOX, "observations in a Discrete"),
    ],
)
def test_what_is_no_perceptron_is_refused(
    actor: nn.Sequential, observations: spaces.Space, actions: spaces.Space, said: str
) -> None:
    with pytest.raises(CollectError, match=said):
        describe_mlp(actor, observations, actions)


def test_one_layer_is_a_perceptron() -> None:
    layout, spec = describe_mlp(nn.Sequential(nn.Linear(3, 2)), BOX, spaces.Discrete(2))
    assert (layout.size, spec.activation, spec.layers) == (8, "", (("0.weight", "0.bias"),))


CARTPOLE = (spaces.Box(-1, 1, (4,)), spaces.Discrete(2))


class Halves(nn.Linear):
    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return super().forward(inputs) / 2


def hooked() -> nn.Sequential:
    actor = nn.Sequential(nn.Linear(4, 2))
    actor[0].register_forward_hook(lambda _, __, outputs: outputs + 1)
    return actor


@pytest.mark.parametrize(
    ("actor", "said"),
    [
        (nn.Sequential(nn.Linear(5, 3)), r"\(4,\) has 4 numbers, and 0.weight takes 5"),
        (nn.Sequential(nn.Linear(4, 3)), "2 actions, and 0.bias has 3 numbers"),
        (
            nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(7, 2)),
            "0.weight gives 8 numbers, and 2.weight takes 7",
        ),
        (nn.Sequential(nn.Linear(4, 8), nn.Tanh(), Halves(8, 2)), "differ from those of its"),
        (hooked(), "differ from those of its layers"),
        (nn.Sequential(nn.Linear(4, 2)).double(), "compared with its description"),
    ],
)
def test_a_network_that_does_not_fit_its_description_is_refused(
    actor: nn.Sequential, said: str
) -> None:
    with pytest.raises(CollectError, match=said):
        describe_mlp(actor, *CARTPOLE)


def test_means_for_another_number_of_actions_are_refused() -> None:
    with pytest.raises(CollectError, match=r"gives 2 numbers, and an action \(3,\) has 3"):
        describe_mlp(nn.Sequential(nn.Linear(3, 2)), BOX, BOX)


def test_a_stored_policy_that_does_not_fit_is_named_and_refused(tmp_path: Path) -> None:
    layout, policy = describe_mlp(nn.Sequential(nn.Linear(4, 2)), *CARTPOLE)
    wrong = replace(policy, observation_shape=(5,))
    info = wt.RunInfo(run_id="wrong", layout=layout, policy=wrong)
    with wt.RunWriter(tmp_path / "wrong.zarr", info) as writer:
        writer.append(np.zeros(layout.size, np.float32), num_timesteps=0)
    said = r"observation \(5,\) has 5 numbers, and 0.weight takes 4"
    with pytest.raises(PolicyError, match=said):
        wt.open_run(tmp_path / "wrong.zarr").load_policy(0)
    (problem,) = wt.verify(tmp_path / "wrong.zarr")
    assert "the policy does not fit its parameters" in problem
