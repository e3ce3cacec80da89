"""Batched physics against Gymnasium's ``step``: equal to the last bit."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import ClipAction, NormalizeObservation, RecordEpisodeStatistics

from weighttraj import environments
from weighttraj.policies.kernels import kernel_for
from weighttraj.policies.simulators import PhysicsSimulator, make_simulator

FAMILIES = (
    "HalfCheetah",
    "Hopper",
    "InvertedDoublePendulum",
    "InvertedPendulum",
    "Reacher",
    "Swimmer",
    "Walker2d",
)
IDS = [f"{family}-{version}" for family in FAMILIES for version in ("v4", "v5")]
SEEDS = (3, 4)

SETTINGS: list[tuple[str, dict[str, Any]]] = [
    ("HalfCheetah-v4", {"exclude_current_positions_from_observation": False}),
    ("HalfCheetah-v5", {"forward_reward_weight": 0.3, "ctrl_cost_weight": 0.7, "frame_skip": 3}),
    ("Swimmer-v4", {"exclude_current_positions_from_observation": False}),
    ("Hopper-v4", {"healthy_reward": 0.25, "terminate_when_unhealthy": False}),
    ("Hopper-v5", {"healthy_state_range": (-2.0, 2.0), "healthy_z_range": (0.5, 1.24)}),
    ("Walker2d-v5", {"healthy_angle_range": (-0.1, 0.1), "reset_noise_scale": 0.1}),
    ("Walker2d-v4", {"terminate_when_unhealthy": False}),
    ("InvertedDoublePendulum-v5", {"healthy_reward": 3.0}),
    ("Reacher-v5", {"reward_dist_weight": 2.0, "reward_control_weight": 0.5}),
]


@pytest.mark.parametrize("steps", [200, pytest.param(1000, marks=pytest.mark.long)])
@pytest.mark.parametrize(("env_id", "kwargs"), [*((i, {}) for i in IDS), *SETTINGS])
def test_random_steps_are_gymnasiums(env_id: str, kwargs: dict[str, Any], steps: int) -> None:
    envs = [environments.make(env_id, **kwargs) for _ in range(2 * len(SEEDS))]
    simulator = make_simulator(lambda: environments.make(env_id, **kwargs), SEEDS)
    assert isinstance(simulator, PhysicsSimulator)
    observations = simulator.reset(2)
    expected = [env.reset(seed=SEEDS[i % 2])[0] for i, env in enumerate(envs)]
    assert np.array_equal(observations, expected)
    physics, rng = simulator._physics, np.random.default_rng(0)
    space = envs[0].action_space
    ended = 0
    for _ in range(steps):
        actions = rng.uniform(space.low, space.high, (len(envs), *space.shape)).astype(np.float32)  # type: ignore[attr-defined, misc]
        got = simulator.step(np.arange(len(envs)), actions)
        # Without the wrappers: nothing resets an episode that is over.
        pairs = zip(envs, actions, strict=True)
        steps_of_gymnasium = [env.unwrapped.step(action) for env, action in pairs]
        observed, rewards, terminated, _, _ = zip(*steps_of_gymnasium, strict=True)
        assert np.array_equal(got.observations, np.stack(observed))
        assert np.array_equal(got.rewards, np.array(rewards, float))
        assert np.array_equal(got.terminated, terminated)
        for field in ("qpos", "qvel"):
            truth = [getattr(env.unwrapped.data, field) for env in envs]  # type: ignore[attr-defined]
            assert np.array_equal(physics._fields[field], truth)
        assert not got.unstable.any()
        assert not got.truncated.any()
        ended += sum(terminated)
    if "Pendulum" in env_id or kwargs.get("healthy_z_range"):
        assert ended > 0  # else the comparison says nothing of terminal states


def test_some_simulations_can_stand_still() -> None:
    actions = np.random.default_rng(1).uniform(-1, 1, (40, 4, 3)).astype(np.float32)
    some, alone = (
        make_simulator(lambda: environments.make("Hopper-v4"), seeds) for seeds in (range(4), [2])
    )
    some.reset(1)
    alone.reset(1)
    for step, action in enumerate(actions):
        playing = np.array([0, 1, 2, 3] if step % 3 == 0 else [2, 3])
        got = some.step(playing, action[playing])
        expected = alone.step(np.array([0]), action[[2]])
        here = list(playing).index(2)
        assert np.array_equal(got.observations[here], expected.observations[0])
        assert got.rewards[here] == expected.rewards[0]


class Lighter(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> float:
        return 2.0 * float(reward)


@pytest.mark.parametrize("wrapper", [Lighter, ClipAction, NormalizeObservation])
def test_an_environment_that_is_wrapped_has_no_kernel(wrapper: Any) -> None:
    assert kernel_for(wrapper(environments.make("Hopper-v4"))) is None
    assert kernel_for(environments.make("Hopper-v4")) is not None


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1", "Ant-v4", "Humanoid-v5"])
def test_other_environments_have_no_kernel(env_id: str) -> None:
    assert kernel_for(environments.make(env_id)) is None
    assert kernel_for(RecordEpisodeStatistics(environments.make(env_id))) is None
