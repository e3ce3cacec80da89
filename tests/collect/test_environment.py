"""A run says truly whether its environment can be made again, and why not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import weighttraj as wt
from weighttraj import environments
from weighttraj.collect import WeightTrajectoryCallback, describe_mlp
from weighttraj.errors import CollectError, PolicyError
from weighttraj.policies import evaluate

Make = Callable[[], Any]


class Paying(gym.Env[np.ndarray, np.ndarray]):
    """Pays a bonus, or what a function says of the action, and ends after ten steps."""

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 4}  # noqa: RUF012
    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(
        self, reward: Any = None, bonus: Any = 1.0, render_mode: str | None = None, **other: Any
    ) -> None:
        self.reward, self.bonus, self.other = reward, bonus, other
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, Any]:
        super().reset(seed=seed)
        self.steps = 0
        return self._look(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
        self.steps += 1
        reward = self.bonus if self.reward is None else self.reward(action)
        return self._look(), float(reward), self.steps == 10, False, {}

    def _look(self) -> np.ndarray:
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)


class PayingTwice(Paying):
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
        observation, reward, *rest = super().step(action)
        return (observation, 2 * reward, *rest)  # type: ignore[return-value]


class Restless(Paying):
    """Does not repeat itself."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
        observation, _, *rest = super().step(action)
        return (observation, float(np.random.default_rng().random()), *rest)  # type: ignore[return-value]


class Colour(Enum):
    RED = 1


@pytest.fixture(autouse=True, scope="module")
def registered() -> Iterator[None]:
    gym.register("Paying-v0", Paying)
    gym.register("Restless-v0", Restless)
    gym.register("Limited-v0", Paying, max_episode_steps=5)
    gym.register("Square-v0", Paying, kwargs={"reward": np.sum, "table": np.arange(3)})
    gym.register("Normalising-v0", lambda **_: gym.wrappers.NormalizeObservation(Paying()))
    yield
    for name in ("Paying", "Restless", "Limited", "Square", "Normalising"):
        del gym.registry[f"{name}-v0"]


pytestmark = pytest.mark.filterwarnings("ignore:this training is recorded, but its environment")


def record(make: Make, path: Path) -> wt.Run:
    """A short training, recorded."""
    env = make()
    model = PPO("MlpPolicy", env, n_steps=16, batch_size=16, n_epochs=1, seed=0, device="cpu")
    with WeightTrajectoryCallback(path / "run.zarr", every=1) as callback:
        model.learn(16, callback=callback)
    return wt.open_run(path / "run.zarr")


def changed(**attributes: Any) -> Make:
    """Makes an environment of which attributes were set afterwards."""

    def make() -> Any:
        env = gym.make("Paying-v0")
        for name, value in attributes.items():
            setattr(env.unwrapped, name, value)
        return env

    return make


def nested(depth: int) -> Any:
    """Dicts in one another."""
    return {"a": nested(depth - 1)} if depth else 5


def within_itself() -> list[Any]:
    value: list[Any] = [5]
    value.append(value)
    return value


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (lambda _: 5.0, "function"),
        (np.square, "ufunc"),
        (np.ones(1), "ndarray"),
        (np.float32(5), "float32"),
        (5 + 0j, "complex"),
        (math.nan, "float"),
        (Paying, "type"),
        (Colour.RED, "Colour"),
        ({5}, "set"),
        (b"5", "bytes"),
        ({5: 5}, "dict"),
        ([0, {"a": lambda: 5}], "list"),
        (10**30, "int"),
        (Path("a"), "PosixPath"),
        (nested(25), "dict"),
        (within_itself(), "list"),
    ],
)
def test_a_keyword_that_cannot_be_written_is_named(value: Any, kind: str, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"cannot be made again from the record\n.*`other`"):
        run = record(lambda: gym.make("Paying-v0", other=value, bonus=2.0), tmp_path)
    assert run.info.env is not None
    assert run.info.env.kwargs == {"bonus": 2.0}
    assert run.info.env.cannot_remake == (f"keyword `other` ({kind})",)
    with pytest.raises(PolicyError, match=r"(?s)cannot be made again: keyword `other`.*my_functio"):
        evaluate(run.load_policy(-1), run)


def test_a_reward_function_is_given_again_by_a_function_that_makes_the_environment(
    tmp_path: Path,
) -> None:
    def make() -> Any:
        return gym.make("Paying-v0", reward=lambda _: 5.0)

    run = record(make, tmp_path)
    with pytest.raises(PolicyError, match="keyword `reward`"):
        evaluate(run.load_policy(-1), run)
    played = evaluate(run.load_policy(-1), make, episodes=3)
    assert played.returns.tolist() == [50.0] * 3


@pytest.mark.parametrize(
    "value", [(0.7, math.inf), math.inf, [1, -math.inf], {"a": (1,)}, "inf", nested(20)]
)
def test_a_keyword_comes_back_as_it_was(value: Any, tmp_path: Path) -> None:
    run = record(lambda: gym.make("Paying-v0", other=value), tmp_path)
    assert run.info.env is not None
    assert run.info.env.cannot_remake == ()
    again: Any = environments.remake(run.info.env).unwrapped
    assert repr(again.other) == repr({"other": value})


def test_an_infinite_range_makes_the_environment_of_the_training(tmp_path: Path) -> None:
    def make() -> Any:
        return gym.make("Hopper-v5", healthy_z_range=(0.7, math.inf), max_episode_steps=30)

    run = record(make, tmp_path)
    assert run.info.env is not None
    again = environments.remake(run.info.env)
    assert again.unwrapped._healthy_z_range == (0.7, math.inf)  # type: ignore[attr-defined]
    policy = run.load_policy(-1)
    expected = evaluate(policy, make, episodes=2)
    assert evaluate(policy, run, episodes=2).returns.tolist() == expected.returns.tolist()


def test_how_pictures_are_made_is_not_remembered(tmp_path: Path) -> None:
    run = record(lambda: gym.make("Paying-v0", render_mode="human"), tmp_path)
    assert run.info.env is not None
    assert run.info.env.kwargs == {}
    assert run.info.env.cannot_remake == ()
    old = wt.format.EnvInfo(id="Paying-v0", kwargs={"render_mode": "human"})
    assert environments.remake(old).unwrapped.render_mode is None


def test_what_the_registration_brings_it_brings_again(tmp_path: Path) -> None:
    run = record(lambda: gym.make("Square-v0"), tmp_path)
    assert run.info.env is not None
    assert run.info.env.kwargs == {}
    assert run.info.env.cannot_remake == ()
    assert environments.remake(run.info.env).unwrapped.reward is np.sum  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (changed(bonus=3.0), r"differs in the reward of step 1 \(1.0, where .* 3.0\)"),
        (changed(reward=lambda action: action.sum()), "differs in the reward of step 1"),
        (changed(action_space=spaces.Box(-2, 2, (1,))), "differs in its space of actions"),
        (
            lambda: DummyVecEnv([lambda: gym.make("Paying-v0"), changed(bonus=3.0)]),
            "differs in the reward",
        ),
        (
            lambda: DummyVecEnv([lambda b=b: gym.make("Paying-v0", bonus=b) for b in (1.0, 2.0)]),
            "differ from one another",
        ),
        (lambda: gym.make("Normalising-v0"), "registration wraps it in NormalizeObservation"),
        (lambda: gym.wrappers.RescaleAction(gym.make("Paying-v0"), -2, 2), "RescaleAction"),
    ],
)
@pytest.mark.filterwarnings("ignore:the weights of this training are recorded")  # RescaleAction
def test_an_environment_that_is_not_what_its_id_makes_is_noticed(
    make: Make, reason: str, tmp_path: Path
) -> None:
    run = record(make, tmp_path)
    assert run.info.env is not None
    with pytest.raises(PolicyError, match=f"cannot be made again: .*{reason}"):
        environments.remake(run.info.env)


def test_another_class_under_the_same_id_is_noticed(tmp_path: Path) -> None:
    gym.register("Twice-v0", Paying)
    env = gym.make("Twice-v0")
    del gym.registry["Twice-v0"]
    gym.register("Twice-v0", PayingTwice)
    info = record(lambda: env, tmp_path).info.env
    del gym.registry["Twice-v0"]
    assert info is not None
    (reason,) = info.cannot_remake
    assert "it is another class" in reason
    assert "PayingTwice" in reason


def test_an_environment_that_does_not_repeat_itself_is_not_blamed(tmp_path: Path) -> None:
    info = record(lambda: gym.make("Restless-v0"), tmp_path).info.env
    assert info is not None
    assert info.cannot_remake == ()


@pytest.mark.parametrize(
    ("make", "limit"),
    [
        (lambda: gym.make("Limited-v0"), 5),
        (lambda: gym.make("Limited-v0", max_episode_steps=3), 3),
        (lambda: gym.make("Limited-v0", max_episode_steps=-1), 10),
        (lambda: gym.wrappers.TimeLimit(gym.make("Limited-v0"), 4), 4),
        (lambda: gym.wrappers.TimeLimit(gym.make("Limited-v0"), 9), 5),
    ],
)
def test_episodes_are_as_long_as_in_the_training(make: Make, limit: int, tmp_path: Path) -> None:
    run = record(make, tmp_path)
    assert evaluate(run.load_policy(-1), run, episodes=2).lengths.tolist() == [limit] * 2


def test_comparing_moves_no_random_number(tmp_path: Path) -> None:
    class Drawing(Paying):
        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
            observation, _, *rest = super().step(action)
            return (observation, float(np.random.random()), *rest)  # type: ignore[return-value]

    gym.register("Drawing-v0", Drawing)
    ends = []
    for with_callback in (True, False):
        model = PPO("MlpPolicy", gym.make("Drawing-v0"), n_steps=16, batch_size=16, seed=0)
        callback = WeightTrajectoryCallback(tmp_path / "run.zarr") if with_callback else None
        model.learn(32, callback=callback)
        ends.append(torch.nn.utils.parameters_to_vector(model.policy.parameters()))
    info = wt.open_run(tmp_path / "run.zarr").info.env
    del gym.registry["Drawing-v0"]
    assert info is not None
    assert info.cannot_remake == ()
    assert torch.equal(*ends)


def test_an_environment_with_a_handle_of_a_simulator_is_left_alone(tmp_path: Path) -> None:
    ended: list[str] = []

    class Handle:
        def __del__(self) -> None:
            ended.append("connection")

    class Connected(Paying):
        def __init__(self) -> None:
            super().__init__()
            self.nested = {"handle": [Handle()]}

    gym.register("Connected-v0", Connected)
    env = gym.make("Connected-v0")
    info = record(lambda: env, tmp_path).info.env
    del gym.registry["Connected-v0"]
    assert info is not None
    assert info.cannot_remake == ()
    assert ended == []


def test_an_infinite_clip_of_the_normaliser_is_stored_and_acts(tmp_path: Path) -> None:
    made: list[VecNormalize] = []

    def make() -> Any:
        made.append(VecNormalize(DummyVecEnv([lambda: gym.make("Paying-v0")]), clip_obs=math.inf))
        return made[0]

    run = record(make, tmp_path)
    raw = np.random.default_rng(0).normal(size=(8, 2)) * 1e3
    normalized = made[0].normalize_obs(raw.astype(np.float32))
    assert np.abs(normalized).max() > 10
    assert run.info.obs_norm is not None
    assert (run.info.obs_norm.clip_low, run.info.obs_norm.clip_high) == (None, None)
    assert np.array_equal(run.load_policy(-1).normalize(raw.astype(np.float32)), normalized)


def test_actions_behind_a_clip_are_stored_unbounded_and_played_within_bounds(
    tmp_path: Path,
) -> None:
    class Costly(Paying):
        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
            observation, _, *rest = super().step(action)
            return (observation, float(np.abs(action).max()), *rest)  # type: ignore[return-value]

    gym.register("Costly-v0", Costly)
    env = gym.wrappers.ClipAction(gym.make("Costly-v0"))
    network = torch.nn.Sequential(torch.nn.Linear(2, 1))
    torch.nn.init.constant_(network[0].bias, 10.0)  # far outside
    layout, policy = describe_mlp(network, env.observation_space, env.action_space)
    info = wt.RunInfo(
        run_id="run", layout=layout, policy=policy, env=wt.format.EnvInfo(id="Costly-v0")
    )
    with wt.RunWriter(tmp_path / "run.zarr", info) as writer:
        weights = {**network.state_dict(), "log_std": torch.zeros(1)}
        writer.append(layout.flatten(weights), num_timesteps=0)
    run = wt.open_run(tmp_path / "run.zarr")
    assert (run.info.policy.action_low, run.info.policy.action_high) == ((-math.inf,), (math.inf,))
    looked = np.ones(2, np.float32)
    expected = network(torch.from_numpy(looked)).detach().numpy()
    assert run.load_policy().predict(looked, deterministic=True)[0] == pytest.approx(expected)
    played = evaluate(run.load_policy(), run, episodes=2)
    del gym.registry["Costly-v0"]
    assert played.returns.tolist() == [10.0, 10.0]


def test_settings_of_a_normaliser_are_numbers(tmp_path: Path) -> None:
    def make(**settings: Any) -> Any:
        return VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), **settings)

    run = record(lambda: make(clip_obs=np.float32(0.1), epsilon=np.float64(1e-6)), tmp_path)
    assert run.info.obs_norm is not None
    assert run.info.obs_norm.clip_high == float(np.float32(0.1))
    assert run.info.obs_norm.epsilon == 1e-6
    with pytest.raises(CollectError, match=r"(?s)for clip_obs.*ndarray"):
        record(lambda: make(clip_obs=np.array([1.0, 2.0, 3.0])), tmp_path / "array")
