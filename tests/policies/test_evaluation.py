"""Any policy is evaluated in any environment, from the same seeds, and can be stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import weighttraj as wt
from weighttraj.errors import CollectError, PolicyError
from weighttraj.format import EnvInfo
from weighttraj.policies import ending, evaluate, load_policies


class Walk(gym.Env[np.ndarray, np.ndarray]):
    """Pays the action; ends when the walk leaves an interval. Has no id and no time limit."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, width: float = 3.0) -> None:
        self.width = width

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, Any]:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.place.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
        self.place += np.asarray(action, np.float32).reshape(1)
        over = bool(abs(self.place[0]) > self.width)
        return self.place.copy(), float(np.sum(action)), over, False, {}


def right(observation: np.ndarray) -> np.ndarray:
    assert observation.shape == (1,)
    return np.ones(1)


def test_a_function_is_evaluated_in_an_environment_that_nobody_registered() -> None:
    starts = [Walk().reset(seed=seed)[0][0] for seed in (5, 6, 7)]
    expected = [int(np.floor(3 - start)) + 1 for start in starts]
    for env in (Walk(), Walk, lambda: Walk(3.0)):
        played = evaluate(right, env, episodes=3, seed=5)
        assert played.lengths.tolist() == expected
        assert played.returns.tolist() == expected


@pytest.mark.parametrize("deterministic", [True, False])
def test_loaded_policies_get_the_same_in_an_environment_as_in_its_id(
    full_run: Any, deterministic: bool
) -> None:
    policies = load_policies(full_run, [0, 15])
    by_id = evaluate(policies, full_run, episodes=3, seed=2, deterministic=deterministic)
    env = gym.make("InvertedPendulum-v4")
    for other in (env, lambda: gym.make("InvertedPendulum-v4")):
        played = evaluate(policies, other, episodes=3, seed=2, deterministic=deterministic)
        assert played.returns.tolist() == by_id.returns.tolist()
        assert played.lengths.tolist() == by_id.lengths.tolist()
    single = evaluate(policies[[1]], env, episodes=3, seed=2, deterministic=deterministic)
    assert single.returns[0].tolist() == by_id.returns[1].tolist()


@pytest.mark.parametrize(
    "model",
    [
        lambda: PPO("MlpPolicy", "CartPole-v1", n_steps=64, seed=0, device="cpu"),
        lambda: A2C("MlpPolicy", "CartPole-v1", seed=0, device="cpu").policy,
        lambda: DQN("MlpPolicy", "CartPole-v1", seed=0, device="cpu", buffer_size=10),
    ],
)
def test_models_act_as_in_a_loop_of_their_own(model: Any) -> None:
    policy = model()
    played = evaluate(policy, "CartPole-v1", episodes=3)
    for seed in range(3):
        env = gym.make("CartPole-v1")
        observation, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            action, _ = policy.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(int(action))
            total, over = total + float(reward), terminated or truncated
        assert played.returns[seed] == total == played.lengths[seed]
    sampled = evaluate(policy, "CartPole-v1", episodes=3, deterministic=False)
    again = evaluate(policy, "CartPole-v1", episodes=3, deterministic=False)
    assert sampled.returns.tolist() == again.returns.tolist()


def test_a_recurrent_model_keeps_its_state_within_an_episode() -> None:
    model = RecurrentPPO("MlpLstmPolicy", "CartPole-v1", n_steps=16, seed=3, device="cpu")
    played = evaluate(model, "CartPole-v1", episodes=2)
    env = gym.make("CartPole-v1")
    observation, _ = env.reset(seed=1)
    state, start, over, length = None, np.ones(1), False, 0
    while not over:
        action, state = model.predict(observation, state, start, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(int(action))
        start, over, length = np.zeros(1), terminated or truncated, length + 1
    assert played.lengths[1] == length


def test_a_model_gets_the_observations_that_its_vecnormalize_makes() -> None:
    venv = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model = PPO("MlpPolicy", venv, n_steps=64, seed=0, device="cpu").learn(64)
    played = evaluate(model, "Pendulum-v1", episodes=1)
    by_hand = evaluate(
        lambda raw: model.policy.predict(venv.normalize_obs(raw), deterministic=True)[0],
        "Pendulum-v1",
        episodes=1,
    )
    raw = evaluate(model.policy, "Pendulum-v1", episodes=1)
    assert played.returns.tolist() == by_hand.returns.tolist() != raw.returns.tolist()


def test_a_model_whose_normaliser_is_left_behind_is_refused() -> None:
    env = gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1"))
    model = PPO("MlpPolicy", env, n_steps=64, device="cpu")
    with pytest.raises(PolicyError, match="NormalizeObservation made"):
        evaluate(model, "Pendulum-v1", episodes=1)
    env.update_running_mean = False
    assert evaluate(model, env, episodes=1).lengths.tolist() == [200]


def test_an_episode_without_end_is_cut_off_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ending, "ENDLESS", 500)
    with pytest.raises(PolicyError, match=r"(?s)does not end.*500 steps.*max_steps"):
        evaluate(np.zeros_like, Walk(), episodes=1)
    played = evaluate(np.zeros_like, Walk(), episodes=2, max_steps=7)
    assert played.lengths.tolist() == [7, 7]
    assert evaluate(right, Walk(), episodes=1, max_steps=1000).lengths[0] < 5


def test_loaded_policies_meet_the_same_limits(
    full_run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ending, "ENDLESS", 3)
    policies, endless = load_policies(full_run, [0]), lambda: gym.make("InvertedPendulum-v4", -1)
    with pytest.raises(PolicyError, match="does not end"):
        evaluate(policies, endless, episodes=1)
    assert evaluate(policies, endless, episodes=1, max_steps=2).lengths.tolist() == [[2]]
    assert evaluate(policies, full_run, episodes=1, max_steps=2).lengths.tolist() == [[2]]


@pytest.mark.parametrize(
    ("policy", "env", "message"),
    [
        (right, DummyVecEnv([Walk]), "no environment that policies"),
        (right, 5, "no environment that policies"),
        (right, lambda: 5, "makes no Gymnasium environment"),
        (right, lambda: 1 / 0, "ZeroDivisionError"),
        (right, "CartPole-v1", "the policy fails"),
        (5, Walk, "no policy that can be evaluated"),
        (lambda _: "left", Walk, "the environment fails"),
        (
            PPO("MlpPolicy", "CartPole-v1", n_steps=64, device="cpu"),
            "Pendulum-v1",
            "the policy fails",
        ),
    ],
)
def test_what_does_not_fit_is_one_clear_error(policy: Any, env: Any, message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        evaluate(policy, env, episodes=1)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"frame_skip": 2_000_000_000}, "too many frames"),
        ({"frame_skip": 0}, "too many frames in a step, or none"),
        ({"frame_skip": "many"}, "the environment fails"),
        ({"unheard_of": 1}, r"(?s)the environment fails.*unheard_of"),
        ({"max_episode_steps": 5}, "contradict"),
        ({"id": "CartPole-v1"}, "contradict"),
        ({"env_id": "CartPole-v1"}, "the environment fails"),
        ({"reset_noise_scale": "large"}, "the environment fails"),
        ({"healthy_z_range": [0.7, "inf"]}, "the environment fails"),
        ({"width": 10**30}, "the environment fails"),
        ({"xml_file": "no.xml"}, "the environment fails"),
    ],
)
def test_keywords_of_a_stranger_are_one_clear_error(kwargs: dict[str, Any], message: str) -> None:
    info = EnvInfo(id="Hopper-v5", kwargs=kwargs, max_episode_steps=10)
    with pytest.raises((PolicyError, CollectError), match=message):
        evaluate(lambda _: np.zeros(3), info, episodes=1)


STOPPED = """
import sys
import gymnasium as gym
from gymnasium.envs.mujoco.inverted_pendulum_v4 import InvertedPendulumEnv
import numpy as np
import weighttraj as wt
from weighttraj.policies import evaluate, load_policies

class Endless(InvertedPendulumEnv):
    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        print("step", flush=True)
        return observation, reward, False, truncated, info

policy = lambda observation: np.zeros(1)
if sys.argv[2] == "loaded":
    policy = load_policies(wt.open_run(sys.argv[1]), [0])
try:
    evaluate(policy, Endless, episodes=3, max_steps=10**9)
except KeyboardInterrupt:
    print("stopped", flush=True)
"""


@pytest.mark.parametrize("kind", ["function", "loaded"])
def test_an_interrupt_ends_it_at_the_next_step(kind: str, full_run: Any, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(STOPPED)
    with subprocess.Popen(
        [sys.executable, script, str(full_run.path), kind],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
    ) as process:
        assert process.stdout is not None
        for _ in range(20):
            assert process.stdout.readline() == "step\n"
        process.send_signal(signal.SIGINT)
        lines = process.stdout.read().splitlines()  # to the end of the process
        assert process.wait(timeout=60) == 0
    assert lines[-1].endswith("stopped")  # the signal may come between a word and its line's end


def test_an_old_run_that_has_text_for_a_number_is_refused(full_run: Any) -> None:
    class Old(wt.Run):
        kwargs: dict[str, Any]

        @property
        def info(self) -> wt.RunInfo:
            info = super().info
            return replace(info, env=replace(info.env, kwargs=self.kwargs))  # type: ignore[type-var]

    run = Old(full_run.path, full_run._opener)
    for text in ("inf", "<lambda>", "make.<locals>.reward"):
        run.kwargs = {"a": 1, "reward": [0.7, text]}
        with pytest.raises(PolicyError, match="cannot be made again: keyword `reward`"):
            evaluate(full_run.load_policy(0), run, episodes=1)
    run.kwargs = {"a": {"b": ["/etc/model.xml"]}}
    with pytest.raises(PolicyError, match="made from files"):
        evaluate(full_run.load_policy(0), run, episodes=1)
