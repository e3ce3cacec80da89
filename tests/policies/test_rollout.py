from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v4 import InvertedPendulumEnv
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import weighttraj as wt
from tests.small import CONFIGS, SMALL, learn
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.errors import PolicyError
from weighttraj.format import EnvInfo
from weighttraj.policies import Evaluator, PolicyBatch, env_of, evaluate, export_sb3, load_policies

SLOW = "SlowInvertedPendulum-v0"


class SlowInvertedPendulum(InvertedPendulumEnv):
    """The same environment, but not under the name that has a kernel."""


gym.register(SLOW, SlowInvertedPendulum, max_episode_steps=1000)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def cheetah(tmp_path_factory: pytest.TempPathFactory) -> wt.Run:
    """A short training of HalfCheetah."""
    path = tmp_path_factory.mktemp("cheetah") / "run.zarr"
    config = replace(SMALL, env_id="HalfCheetah-v4", net_arch=(32, 32))
    learn(config, WeightTrajectoryCallback(path, every=4))
    return wt.open_run(path)


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> wt.Run:
    """A short training with discrete actions."""
    path = tmp_path_factory.mktemp("cartpole") / "run.zarr"
    learn(CONFIGS["categorical"], WeightTrajectoryCallback(path, every=4))
    return wt.open_run(path)


def by_sb3(run: wt.Run, t: int, env_id: str, episodes: int, folder: Path, **limit: Any) -> Any:
    """Returns and lengths by Stable-Baselines3, environment i seeded with i."""
    export = export_sb3(run, t, folder)
    assert export.vecnormalize is not None
    venv: VecEnv = make_vec_env(env_id, n_envs=episodes, seed=0, env_kwargs=limit)
    venv = VecNormalize.load(str(export.vecnormalize), venv)
    played = evaluate_policy(
        PPO.load(export.model, device="cpu"), venv, episodes, return_episode_rewards=True
    )
    venv.close()
    return played


def test_returns_are_those_of_stable_baselines3(full_run: wt.Run, tmp_path: Path) -> None:
    rows = [0, 7, len(full_run) - 1]
    played = evaluate(load_policies(full_run, rows), full_run, episodes=4)
    for i, t in enumerate(rows):
        returns, lengths = by_sb3(full_run, t, "InvertedPendulum-v4", 4, tmp_path / str(t))
        # SB3 lists episodes as they end.
        assert sorted(played.returns[i]) == sorted(returns)
        assert sorted(played.lengths[i]) == sorted(lengths)


def test_chaotic_episodes_start_as_those_of_stable_baselines3(
    cheetah: wt.Run, tmp_path: Path
) -> None:
    env = EnvInfo(id="HalfCheetah-v4", max_episode_steps=100)
    for t in (0, len(cheetah) - 1):
        played = evaluate(cheetah.load_policy(t), env, episodes=3)
        returns, _ = by_sb3(
            cheetah, t, "HalfCheetah-v4", 3, tmp_path / str(t), max_episode_steps=100
        )
        np.testing.assert_allclose(played.returns, returns, rtol=0, atol=1e-6)


@pytest.mark.parametrize("deterministic", [True, False])
def test_a_policy_does_not_depend_on_the_others(full_run: wt.Run, deterministic: bool) -> None:
    together = load_policies(full_run, slice(None))
    env = env_of(full_run)
    with Evaluator(env, episodes=3) as whole, Evaluator(env, episodes=3, block=5) as parts:
        expected = whole(together, deterministic=deterministic)
        got = parts(together, deterministic=deterministic)
        alone = [whole(p, deterministic=deterministic) for p in (together[[4]], together[9:10])]
        single = whole(full_run.load_policy(4), deterministic=deterministic)
    with Evaluator(env, episodes=3, threads=2) as threaded:
        by_two = threaded(together, deterministic=deterministic)
    for other in (got, by_two):
        assert np.array_equal(other.returns, expected.returns)
        assert np.array_equal(other.lengths, expected.lengths)
    for row, one in zip((4, 9), alone, strict=True):
        assert np.array_equal(one.returns[0], expected.returns[row])
    assert np.array_equal(single.returns, expected.returns[4])


@pytest.mark.parametrize("deterministic", [True, False])
def test_an_episode_does_not_depend_on_the_others(full_run: wt.Run, deterministic: bool) -> None:
    policy = full_run.load_policy(3)
    many = evaluate(policy, full_run, episodes=6, deterministic=deterministic)
    few = evaluate(policy, full_run, episodes=2, deterministic=deterministic)
    assert np.array_equal(many.returns[:2], few.returns)
    again = evaluate(policy, full_run, episodes=6, deterministic=deterministic)
    assert np.array_equal(many.returns, again.returns)
    other = evaluate(policy, full_run, episodes=2, seed=4, deterministic=deterministic)
    assert np.array_equal(many.returns[4:], other.returns)


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_slow_road_gives_the_same(full_run: wt.Run, deterministic: bool) -> None:
    policies = load_policies(full_run, [0, 8, 15])
    slow, fast = (
        Evaluator(EnvInfo(id=env_id), episodes=3) for env_id in (SLOW, "InvertedPendulum-v4")
    )
    assert (slow.simulator, fast.simulator) == ("gymnasium", "mujoco.batch")
    one = slow(policies, deterministic=deterministic)
    other = fast(policies, deterministic=deterministic)
    assert np.array_equal(one.returns, other.returns)
    assert np.array_equal(one.lengths, other.lengths)


@pytest.mark.parametrize("deterministic", [True, False])
def test_discrete_actions_are_those_of_gymnasiums_loop(
    cartpole: wt.Run, deterministic: bool
) -> None:
    rows = [0, len(cartpole) - 1]
    played = evaluate(
        load_policies(cartpole, rows), cartpole, episodes=4, deterministic=deterministic
    )
    for i, t in enumerate(rows):
        policy = cartpole.load_policy(t)
        for seed in range(4):
            env = gym.make("CartPole-v1")
            uniform = np.random.default_rng([seed, 1])
            observation, _ = env.reset(seed=seed)
            total, over = 0.0, False
            while not over:
                right = float(_probability_of_right(policy, observation))
                chosen = right > 0.5 if deterministic else uniform.random() > 1 - right
                observation, reward, terminated, truncated, _ = env.step(int(chosen))
                total, over = total + float(reward), terminated or truncated
            assert played.returns[i, seed] == total == played.lengths[i, seed]
    assert len(np.unique(played.returns)) > 2


def _probability_of_right(policy: wt.policies.Policy, observation: np.ndarray) -> Any:  # type: ignore[name-defined]
    import torch

    inputs = torch.from_numpy(policy.normalize(observation[None]))
    return policy.distribution(inputs).probs[0, 1]  # type: ignore[union-attr]


def test_sampled_actions_have_the_policys_deviation(cheetah: wt.Run) -> None:
    policies = load_policies(cheetah, [0, 1])
    zero = np.zeros((2, 400, 17))
    noise = np.random.default_rng(0).standard_normal((400, 6), np.float32)
    moved = policies.act(zero, noise) - policies.act(zero)
    log_std = cheetah.layout.unflatten(cheetah.weights[1])["log_std"]
    inside = np.abs(policies.act(zero, noise)[1]) < 1  # not clipped
    expected = (noise * np.exp(log_std))[inside]
    np.testing.assert_allclose(moved[1][inside], expected, atol=1e-6)
    assert inside.mean() > 0.5


def test_a_batch_acts_as_each_policy_alone(cheetah: wt.Run, cartpole: wt.Run) -> None:
    rng = np.random.default_rng(0)
    for run in (cheetah, cartpole):
        batch = load_policies(run, slice(None, None, 3))
        raw = rng.normal(size=(len(batch), 7, *batch.spec.observation_shape))
        actions = batch.act(raw)
        for i in range(len(batch)):
            alone = run.load_policy(3 * i).predict(raw[i], deterministic=True)[0]
            np.testing.assert_allclose(actions[i], alone, atol=2e-6)
            np.testing.assert_array_equal(
                batch.normalize(raw)[i], run.load_policy(3 * i).normalize(raw[i])
            )


def test_the_last_normalizer_is_the_last(full_run: wt.Run) -> None:
    own = load_policies(full_run, [2, 15])
    final = load_policies(full_run, [2, 15], final_normalizer=True)
    assert own.mean is not None
    assert final.mean is not None
    assert np.array_equal(own.mean[1], final.mean[1])
    assert np.array_equal(final.mean[0], final.mean[1])
    assert not np.array_equal(own.mean[0], final.mean[0])
    assert np.array_equal(own.weights, final.weights)


def test_the_runs_own_time_limit_holds(full_run: wt.Run) -> None:
    env = full_run.info.env
    assert env is not None
    policy = full_run.load_policy(-1)
    for env_id in (env.id, SLOW):
        limited = replace(env, id=env_id, max_episode_steps=5)
        assert evaluate(policy, limited, episodes=4).lengths.tolist() == [5] * 4


@pytest.fixture(scope="module")
def explosive(tmp_path_factory: pytest.TempPathFactory) -> str:
    """InvertedPendulum with steps so long that the physics breaks down within a few hundred."""
    plain = gym.make("InvertedPendulum-v5").unwrapped
    spec = mujoco.MjSpec.from_file(plain.fullpath)  # type: ignore[attr-defined]
    spec.option.timestep = 0.02
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.actuators[0].gear[0] = 1e9
    path = tmp_path_factory.mktemp("xml") / "explosive.xml"
    path.write_text(spec.to_xml())
    return str(path)


def test_unstable_simulations_are_marked(
    full_run: wt.Run, explosive: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    env = EnvInfo(id="InvertedPendulum-v5", kwargs={"xml_file": explosive})
    policies = load_policies(full_run, [0, 15])
    still = policies.with_weights(np.zeros_like(policies.weights))
    with Evaluator(env, episodes=2, threads=2) as evaluator:
        pushed = evaluator(policies.with_weights(policies.weights * 100))
        calm = evaluator(still)
    assert np.isnan(pushed.returns).all()
    assert (pushed.lengths < 1000).all()
    assert np.isfinite(calm.returns).all()
    assert not list(tmp_path.iterdir())  # MuJoCo would write a log


def test_weights_that_are_no_numbers_give_no_return(full_run: wt.Run) -> None:
    policies = load_policies(full_run, [0, 15])
    weights = policies.weights.copy()
    weights[0] = np.nan
    played = evaluate(policies.with_weights(weights), full_run, episodes=2)
    assert np.isnan(played.returns[0]).all()
    assert np.isfinite(played.returns[1]).all()


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1"])
def test_a_policy_of_another_environment_is_refused(full_run: wt.Run, env_id: str) -> None:
    with pytest.raises(PolicyError, match="does not fit the environment"):
        evaluate(full_run.load_policy(0), env_id, episodes=1)
    with pytest.raises(PolicyError, match="no episodes"):
        evaluate(full_run.load_policy(0), full_run, episodes=0)


def test_files_that_a_run_names_are_not_opened(full_run: wt.Run) -> None:
    class Elsewhere(wt.Run):
        @property
        def info(self) -> wt.RunInfo:
            info = super().info
            env = replace(info.env, kwargs={"xml_file": "/etc/model.xml"})  # type: ignore[type-var]
            return replace(info, env=env)

    with pytest.raises(PolicyError, match=r"/etc/model\.xml"):
        evaluate(full_run.load_policy(0), Elsewhere(full_run.path, full_run._opener))


def test_a_run_without_environment_cannot_be_evaluated(full_run: wt.Run) -> None:
    class Nowhere(wt.Run):
        @property
        def info(self) -> wt.RunInfo:
            return replace(super().info, env=None)

    with pytest.raises(PolicyError, match="which environment"):
        evaluate(full_run.load_policy(0), Nowhere(full_run.path, full_run._opener))


def test_snapshots_out_of_range_are_refused(full_run: wt.Run) -> None:
    with pytest.raises(IndexError):
        load_policies(full_run, [0, 16])
    assert repr(load_policies(full_run, [0, -1])) == (
        "<PolicyBatch of 2: gaussian, units [8, 8, 1]>"
    )
    assert isinstance(load_policies(full_run, slice(2, 4)), PolicyBatch)
