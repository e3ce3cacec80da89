from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import weighttraj as wt
from weighttraj.errors import PolicyError
from weighttraj.policies import Policy, evaluate, load_policy


def test_the_policy_is_the_network_written_out(full_run: wt.Run) -> None:
    t, raw = 7, np.array([0.01, -0.02, 0.3, -0.4])
    tensors = full_run.layout.unflatten(full_run.weights[t])
    stats = full_run.obs_norm(t)
    assert stats is not None
    x = np.clip((raw - stats.mean) / np.sqrt(stats.var + 1e-8), -10, 10)
    for i in (0, 2):
        weight, bias = (tensors[f"mlp_extractor.policy_net.{i}.{n}"] for n in ("weight", "bias"))
        x = np.tanh(weight @ x + bias)
    expected = tensors["action_net.weight"] @ x + tensors["action_net.bias"]
    action, state = full_run.load_policy(t).predict(raw, deterministic=True)
    np.testing.assert_allclose(action, expected, rtol=1e-5)
    assert state is None


def test_actions_are_clipped_and_batched_as_observations_are(full_run: wt.Run) -> None:
    policy = full_run.load_policy(-1)
    assert policy.predict(np.zeros(4))[0].shape == (1,)
    loud = policy.with_weights(full_run.weights[-1] * 20)
    actions = loud.predict(np.random.default_rng(0).normal(size=(500, 4)) * 100)[0]
    assert actions.shape == (500, 1)
    assert actions.min() == -3
    assert actions.max() == 3
    assert repr(policy) == "<Policy gaussian, tanh, units [8, 8, 1]>"


def test_each_snapshot_has_its_own_normaliser(full_run: wt.Run) -> None:
    early, late = full_run.load_policy(1), full_run.load_policy(15)
    raw = np.array([0.1, 0.1, 0.1, 0.1])
    assert not np.array_equal(early.normalize(raw), late.normalize(raw))
    forecast = early.with_weights(full_run.weights[15])
    assert np.array_equal(forecast.normalize(raw), early.normalize(raw))
    assert np.array_equal(forecast.weights, late.weights)


def test_a_wrong_observation_is_refused(full_run: wt.Run) -> None:
    with pytest.raises(PolicyError, match=r"\(4,\) or \(batch, 4\)\n  got: \(5,\)"):
        full_run.load_policy(0).predict(np.zeros(5))


def test_a_policy_whose_layout_lacks_a_layer_is_refused(full_run: wt.Run) -> None:
    spec = replace(full_run.info.policy, layers=(("no.weight", "no.bias"),))
    with pytest.raises(PolicyError, match=r"no\.weight"):
        Policy(spec, full_run.layout, full_run.weights[0])


def test_there_are_no_snapshots_beyond_the_last(full_run: wt.Run) -> None:
    with pytest.raises(IndexError):
        load_policy(full_run, 16)


def test_returns_are_those_of_gymnasiums_loop(full_run: wt.Run) -> None:
    import gymnasium as gym

    policy = full_run.load_policy(-1)
    played = evaluate(policy, full_run, episodes=3, seed=11)
    for i in range(3):
        env = gym.make("InvertedPendulum-v4")
        observation, _ = env.reset(seed=11 + i)
        total, steps, over = 0.0, 0, False
        while not over:
            action = policy.predict(observation, deterministic=True)[0]
            observation, reward, terminated, truncated, _ = env.step(action)
            total, steps, over = total + float(reward), steps + 1, terminated or truncated
        assert (played.returns[i], played.lengths[i]) == (total, steps)


@pytest.mark.parametrize("deterministic", [True, False])
def test_an_episode_does_not_depend_on_the_others(full_run: wt.Run, deterministic: bool) -> None:
    policy = full_run.load_policy(3)
    many = evaluate(policy, full_run, episodes=6, deterministic=deterministic)
    few = evaluate(policy, full_run, episodes=2, deterministic=deterministic)
    assert np.array_equal(many.returns[:2], few.returns)
    again = evaluate(policy, full_run, episodes=6, deterministic=deterministic)
    assert np.array_equal(many.returns, again.returns)


def test_the_runs_own_time_limit_holds(full_run: wt.Run) -> None:
    env = full_run.info.env
    assert env is not None
    short = evaluate(full_run.load_policy(-1), replace(env, max_episode_steps=5), episodes=4)
    assert short.lengths.tolist() == [5] * 4


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
