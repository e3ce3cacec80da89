"""A stored snapshot in a model of one's own acts as the agent did, whatever its network is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

import weighttraj as wt
from weighttraj.collect import WeightTrajectoryCallback, describe_mlp
from weighttraj.errors import PolicyError

SHORT = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "device": "cpu"}


class Seen(gym.Env[Any, Any]):
    """Observations of any space, and two continuous actions."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = space, spaces.Box(-1, 1, (2,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), float(action.sum()), False, False, {}


IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
PAIR = spaces.Dict({"a": spaces.Box(-1, 1, (3,)), "b": spaces.Discrete(4)})
SMALL = {"net_arch": [4]}

MODELS: dict[str, Callable[[int], Any]] = {
    "CNN": lambda seed: PPO(
        "CnnPolicy",
        DummyVecEnv([lambda: Seen(IMAGE)]),
        policy_kwargs={**SMALL, "features_extractor_kwargs": {"features_dim": 4}},
        seed=seed,
        **SHORT,
    ),
    "Dict": lambda seed: PPO(
        "MultiInputPolicy",
        DummyVecEnv([lambda: Seen(PAIR)]),
        policy_kwargs=SMALL,
        seed=seed,
        **SHORT,
    ),
    "gSDE": lambda seed: PPO(
        "MlpPolicy", "Pendulum-v1", use_sde=True, policy_kwargs=SMALL, seed=seed, **SHORT
    ),
    "recurrent": lambda seed: RecurrentPPO(
        "MlpLstmPolicy",
        VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")])),
        policy_kwargs={**SMALL, "lstm_hidden_size": 3},
        seed=seed,
        **SHORT,
    ),
}


def act(model: Any, raw: Any) -> np.ndarray:
    env = model.get_env()
    seen = env.normalize_obs(raw) if isinstance(env, VecNormalize) else raw
    return model.predict(seen, deterministic=True)[0]  # type: ignore[no-any-return]


@pytest.mark.parametrize("name", MODELS)
def test_a_policy_that_cannot_be_rebuilt_acts_in_the_users_own_model(
    name: str, tmp_path: Path
) -> None:
    trained = MODELS[name](0)
    with pytest.warns(UserWarning, match="run.load_into"):
        trained.learn(32, callback=WeightTrajectoryCallback(tmp_path / "run.zarr", every=1))
    mine = MODELS[name](7)
    critic = mine.policy.value_net.weight.detach().clone()
    wt.open_run(tmp_path / "run.zarr").load_into(mine, -1)
    space = trained.observation_space
    space.seed(3)
    for _ in range(3):
        raw = space.sample()
        one, other = (act(model, raw) for model in (trained, mine))
        assert np.array_equal(one, other)
    assert torch.equal(mine.policy.value_net.weight, critic)


@pytest.fixture(scope="module")
def normalised(tmp_path_factory: pytest.TempPathFactory) -> wt.Run:
    path = tmp_path_factory.mktemp("into") / "run.zarr"
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model = PPO("MlpPolicy", env, policy_kwargs=SMALL, seed=0, **SHORT)
    model.learn(32, callback=WeightTrajectoryCallback(path, every=1, critic=True))
    return wt.open_run(path)


def pendulum(**kwargs: Any) -> Any:
    env = DummyVecEnv([lambda: gym.make("Pendulum-v1")])
    vec = VecNormalize(env, **kwargs) if kwargs else env
    return PPO("MlpPolicy", vec, policy_kwargs=SMALL, seed=5, **SHORT)


def test_the_normaliser_and_the_critic_of_the_snapshot_are_loaded(normalised: wt.Run) -> None:
    model = pendulum(clip_obs=10.0)
    normalised.load_into(model, 1)
    raw = np.array([[0.3, -0.2, 5.0]], np.float32)
    expected = normalised.load_policy(1).predict(raw, deterministic=True)[0]
    seen = model.get_env().normalize_obs(raw)
    assert np.array_equal(model.predict(seen, deterministic=True)[0], expected)
    layout = normalised.info.critic_layout
    assert layout is not None
    stored = layout.unflatten(normalised["critic/weights"][1])
    assert np.array_equal(stored["value_net.bias"], model.policy.value_net.bias.detach().numpy())


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: pendulum(), "the target has no normaliser"),
        (lambda: pendulum(clip_obs=5.0), "clip_high"),
        (lambda: pendulum(clip_obs=10.0, epsilon=1e-3), "epsilon"),
        (lambda: pendulum().policy, "normalizer=False"),
        (
            lambda: PPO("MlpPolicy", "CartPole-v1", policy_kwargs=SMALL, **SHORT),
            r"log_std: missing.*policy_net.0.weight: \(4, 4\) torch.float32, stored \(4, 3\)",
        ),
        (lambda: pendulum(clip_obs=10.0).policy.double(), "torch.float64, stored"),
        (lambda: nn.Linear(3, 1), "log_std: missing"),
    ],
)
def test_another_model_is_refused_and_left_as_it_was(
    make: Callable[[], Any], said: str, normalised: wt.Run
) -> None:
    target = make()
    module = getattr(target, "policy", target)
    before = [p.detach().clone() for p in module.parameters()]
    with pytest.raises(PolicyError, match=said):
        normalised.load_into(target, 1)
    assert all(torch.equal(p, q) for p, q in zip(module.parameters(), before, strict=True))


def test_a_module_without_a_normaliser_is_loaded_when_asked_for(normalised: wt.Run) -> None:
    policy = pendulum().policy
    normalised.load_into(policy, 1, normalizer=False)
    stored = normalised.layout.unflatten(normalised.weights[1])
    assert np.array_equal(policy.action_net.weight.detach().numpy(), stored["action_net.weight"])


def plain_run(path: Path) -> tuple[wt.Run, nn.Sequential]:
    actor = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))
    box = spaces.Box(-1, 1, (1,))
    layout, policy = describe_mlp(actor, spaces.Box(-1, 1, (3,)), box)
    with wt.RunWriter(path, wt.RunInfo(run_id="r", layout=layout, policy=policy)) as writer:
        tensors = {**actor.state_dict(), "log_std": torch.ones(1)}
        writer.append(layout.flatten({n: x.numpy() for n, x in tensors.items()}), num_timesteps=0)
    return wt.open_run(path), actor


def test_tensors_by_name_are_loaded(tmp_path: Path) -> None:
    run, actor = plain_run(tmp_path / "r.zarr")
    mine, log_std = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1)), torch.zeros(1)
    with pytest.raises(PolicyError, match="log_std: missing"):
        run.load_into(mine)
    run.load_into({**dict(mine.named_parameters()), "log_std": log_std})
    assert log_std.item() == 1
    assert torch.equal(mine(torch.ones(3)), actor(torch.ones(3)))


def test_what_no_run_stores_is_not_passed_over(tmp_path: Path) -> None:
    run, _ = plain_run(tmp_path / "r.zarr")

    class Net(nn.Sequential):
        def __init__(self) -> None:
            super().__init__(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))
            self.log_std = nn.Parameter(torch.zeros(1))

    more = Net()
    more.gain = nn.Parameter(torch.ones(1))
    with pytest.raises(PolicyError, match=r"does not store.*\n.*\n.*gain"):
        run.load_into(more)
    counting = Net()
    counting.register_buffer("scale", torch.ones(1))
    with pytest.raises(PolicyError, match=r"buffers.*\n.*\n.*scale"):
        run.load_into(counting)
    run.load_into(counting, keep_buffers=True)
    assert counting.log_std.item() == 1
    shared = Net()
    shared[2].bias = nn.Parameter(shared.log_std.data)  # two parameters in the same memory
    with pytest.raises(PolicyError, match="share memory"):
        run.load_into(shared)
    assert shared.log_std.item() == 0
    with pytest.raises(IndexError):
        run.load_into(Net(), 7)
