from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import weighttraj as wt
from weighttraj.errors import PolicyError
from weighttraj.policies import Policy, load_policy


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
