"""The collector on real short trainings: what it stores is what the agent was."""

from __future__ import annotations

import copy
import gc
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
)

import weighttraj as wt
from tests.small import CONFIGS, SMALL, learn
from weighttraj.collect import WeightTrajectoryCallback, make_ppo
from weighttraj.collect.agents import actor_parameters
from weighttraj.errors import CollectError, PolicyError, SnapshotError, StoreExistsError


def flat(model: Any) -> np.ndarray:
    parameters = [p.detach().reshape(-1) for p in actor_parameters(model.policy).values()]
    return torch.cat(parameters).numpy()


class Witness(BaseCallback):
    """Records the live agent at every gradient step, without moving the random state."""

    def __init__(self, raw: np.ndarray) -> None:
        super().__init__()
        self.raw = raw
        self.agents: list[dict[str, Any]] = []
        self.stats: list[Any] = []

    def _on_training_start(self) -> None:
        self.model.policy.optimizer.register_step_post_hook(self._look)
        self._look()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.stats.append(copy.deepcopy(live_stats(self.model)))

    def _look(self, *_: object) -> None:
        state = torch.get_rng_state()
        inputs = live_inputs(self.model, self.raw)
        deterministic = self.model.policy.predict(inputs, deterministic=True)[0]
        torch.manual_seed(5)
        sampled = self.model.policy.predict(inputs)[0]
        self.model.policy.set_training_mode(True)
        torch.set_rng_state(state)
        self.agents.append(
            {"weights": flat(self.model), "deterministic": deterministic, "sampled": sampled}
        )


def live_stats(model: Any) -> Any:
    env = model.get_env()
    if isinstance(env, VecNormalize):
        return env.obs_rms
    normalizers = [
        w for w in chain(env.envs[0]) if isinstance(w, gym.wrappers.NormalizeObservation)
    ]
    return normalizers[0].obs_rms if normalizers else None


def live_inputs(model: Any, raw: np.ndarray) -> np.ndarray:
    """Raw observations as the training environment's own code would show them to the agent."""
    env = model.get_env()
    if isinstance(env, VecNormalize):
        return env.normalize_obs(raw)  # type: ignore[return-value]
    inputs = []
    for row in raw:
        for wrapper in reversed(chain(env.envs[0])):
            if isinstance(wrapper, gym.wrappers.NormalizeObservation):
                wrapper.update_running_mean = False
                row = wrapper.observation(row)
                wrapper.update_running_mean = True
            elif isinstance(wrapper, gym.ObservationWrapper):
                row = wrapper.observation(row)
        inputs.append(row)
    return np.stack(inputs)


def chain(env: Any) -> list[Any]:
    wrappers = []
    while isinstance(env, gym.Wrapper):
        wrappers.append(env)
        env = env.env
    return wrappers


def test_training_is_the_same_with_and_without_the_collector(tmp_path: Path) -> None:
    script = Path(__file__).with_name("neutrality.py")
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", script, tmp_path],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    result = json.loads(done.stdout.splitlines()[-1])
    assert result == {name: {"weights": True, "random": True} for name in CONFIGS}


@pytest.mark.parametrize("name", CONFIGS)
def test_stored_policies_act_bit_by_bit_as_the_agent_did(name: str, tmp_path: Path) -> None:
    space = gym.make(CONFIGS[name].env_id).observation_space
    rng = np.random.default_rng(0)
    raw = (rng.normal(size=(16, *space.shape)) * 3).astype(space.dtype)  # type: ignore[misc]
    witness = Witness(raw)
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=2)
    learn(CONFIGS[name], [callback, witness])
    run = wt.open_run(tmp_path / "run.zarr")
    seen = [witness.agents[i] for i in run["index/gradient_step"][:]]
    assert len(run) == len(seen) == 17
    for t, agent in enumerate(seen):
        policy = run.load_policy(t)
        assert np.array_equal(run.weights[t], agent["weights"])
        assert np.array_equal(policy.predict(raw, deterministic=True)[0], agent["deterministic"])
        torch.manual_seed(5)
        assert np.array_equal(policy.predict(raw)[0], agent["sampled"])
    assert not np.array_equal(seen[0]["weights"], seen[-1]["weights"])


@pytest.mark.parametrize("name", ["gymnasium", "vecnormalize", "categorical"])
def test_stored_statistics_are_the_live_normalisers(name: str, tmp_path: Path) -> None:
    witness = Witness(np.zeros((1, 4)))
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=4)
    learn(CONFIGS[name], [callback, witness])
    run = wt.open_run(tmp_path / "run.zarr")
    assert run.info.obs_norm is not None
    for t, iteration in enumerate(run.iteration):
        stats = run.obs_norm(t)
        assert stats is not None
        if iteration:
            live = witness.stats[iteration - 1]
            assert np.array_equal(stats.mean, live.mean)
            assert np.array_equal(stats.var, live.var)
            assert stats.count == live.count
    counts = run["obs_norm/count"][:]
    assert (np.diff(counts)[run["index/phase"][1:] == 0] > 50).all()


def test_a_run_without_normaliser_says_so(tmp_path: Path) -> None:
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr")
    learn(CONFIGS["none"], callback)
    run = wt.open_run(tmp_path / "run.zarr")
    assert run.info.obs_norm is None
    assert run.obs_norm(0) is None
    assert run.ret_norm(0) is None


def test_the_papers_cadence(full_run: wt.Run) -> None:
    assert len(full_run) == 3 * 5 + 1
    assert full_run.phase.tolist() == [-1, *([0, 1, 2, 3, 4] * 3)]
    assert full_run.iteration.tolist() == [0, *[1] * 5, *[2] * 5, *[3] * 5]
    assert full_run["index/gradient_step"][:].tolist() == list(range(0, 961, 64))
    assert full_run["index/epoch"][:].tolist() == [0, *([2, 4, 6, 8, 10] * 3)]
    assert full_run.num_timesteps.tolist() == [0, *[2048] * 5, *[4096] * 5, *[6144] * 5]
    assert full_run.layout.size == 122


def test_the_learning_rate_is_annealed_as_cleanrls(full_run: wt.Run) -> None:
    rates = full_run.learning_rate
    assert np.isnan(rates[0])
    expected = np.repeat([3e-4, 2e-4, 1e-4], 5)  # frac = 1 - (iteration - 1) / iterations
    np.testing.assert_allclose(rates[1:], expected, rtol=1e-12)


def test_diagnostics_stand_beside_the_last_snapshot_of_their_update(full_run: wt.Run) -> None:
    last = full_run.phase == 4
    for name in ("approx_kl", "clip_fraction", "value_loss", "explained_variance"):
        values = full_run[f"train/{name}"][:]
        assert np.isfinite(values[last]).all(), name
        assert np.isnan(values[~last]).all(), name
    returns = full_run["train/ep_rew_mean"][:]
    assert np.isnan(returns[0])
    assert (returns[1:] > 1).all()


def test_moments_and_critic_are_stored_when_asked_for(full_run: wt.Run) -> None:
    assert full_run["optimizer/exp_avg"][0].any() == np.False_
    assert full_run["optimizer/exp_avg_sq"][1].min() > 0
    critic = full_run.info.critic_layout
    assert critic is not None
    assert critic.size == full_run["critic/weights"].shape[1] == 4 * 64 + 64 + 64 * 64 + 64 + 64 + 1
    assert not np.array_equal(full_run["critic/weights"][0], full_run["critic/weights"][-1])


def test_probe_observations_are_network_inputs_of_each_rollout(full_run: wt.Run) -> None:
    probes = full_run["probe/observations"][:]
    assert probes.shape == (3, 64, 4)
    assert np.abs(probes).max() <= 10
    assert 0.3 < probes[1:].std() < 3


def test_the_record_says_what_made_it(full_run: wt.Run) -> None:
    info = full_run.info
    assert info.algorithm is not None
    assert info.env is not None
    assert (info.algorithm.name, info.env.id, info.seed) == ("PPO", "InvertedPendulum-v4", 1)
    assert info.algorithm.hyperparameters["n_steps"] == 2048
    assert info.provenance.threads == 1
    assert {"torch", "mujoco", "gymnasium", "stable-baselines3"} <= info.provenance.packages.keys()
    assert [s.role for s in info.layout.params][:3] == ["log_std", "weight", "bias"]
    assert info.layout["mlp_extractor.policy_net.2.weight"].axes == ("hidden_1", "hidden_0")
    assert wt.verify(full_run.path) == []


def test_diagnostics_are_never_known_too_early(tmp_path: Path) -> None:
    learn(SMALL, WeightTrajectoryCallback(tmp_path / "run.zarr", every=5))  # 8 steps an update
    run = wt.open_run(tmp_path / "run.zarr")
    known = run["index/gradient_step"][np.isfinite(run["train/approx_kl"][:])]  # type: ignore[index]
    assert known.tolist() == [32]


@pytest.mark.parametrize(("every", "steps"), [(5, [0, 5, 10, 15, 20, 25, 30, 32]), (64, [0, 32])])
def test_the_last_weights_are_stored_exactly_once(
    every: int, steps: list[int], tmp_path: Path
) -> None:
    model = learn(SMALL, WeightTrajectoryCallback(tmp_path / "run.zarr", every=every))
    run = wt.open_run(tmp_path / "run.zarr")
    assert run["index/gradient_step"][:].tolist() == steps
    assert np.array_equal(run.weights[-1], flat(model))


def test_a2c_is_collected(tmp_path: Path) -> None:
    model = A2C("MlpPolicy", "Pendulum-v1", n_steps=5, seed=0, device="cpu")
    model.learn(50, callback=WeightTrajectoryCallback(tmp_path / "run.zarr", every=2))
    run = wt.open_run(tmp_path / "run.zarr")
    assert run["index/gradient_step"][:].tolist() == [0, 2, 4, 6, 8, 10]
    assert np.isfinite(run["train/policy_loss"][1:]).all()
    assert np.array_equal(run.weights[-1], flat(model))
    observation = np.array([0.1, 0.2, 0.3], np.float32)
    expected = model.predict(observation, deterministic=True)[0]
    assert np.array_equal(run.load_policy().predict(observation, deterministic=True)[0], expected)


@pytest.mark.parametrize("vec_env", [DummyVecEnv, SubprocVecEnv])
def test_several_environments_share_one_policy(vec_env: type, tmp_path: Path) -> None:
    kwargs = {"start_method": "fork"} if vec_env is SubprocVecEnv else {}
    env = make_vec_env("Pendulum-v1", n_envs=3, vec_env_cls=vec_env, vec_env_kwargs=kwargs)
    env = VecNormalize(env)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, device="cpu")
    model.learn(192, callback=WeightTrajectoryCallback(tmp_path / "run.zarr", every=4))
    raw = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    expected = model.predict(env.normalize_obs(raw), deterministic=True)[0]
    env.close()
    run = wt.open_run(tmp_path / "run.zarr")
    assert run.info.policy.cannot_rebuild == ()
    assert np.array_equal(run.load_policy().predict(raw, deterministic=True)[0], expected)


def test_cleanrls_clipping_lambda_is_understood(tmp_path: Path) -> None:
    def env() -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = gym.make("InvertedPendulum-v4")
        env = gym.wrappers.NormalizeObservation(env)
        space = env.observation_space
        return gym.wrappers.TransformObservation(env, lambda o: np.clip(o, -10, 10), space)

    model = PPO("MlpPolicy", DummyVecEnv([env]), n_steps=64, device="cpu")
    model.learn(64, callback=WeightTrajectoryCallback(tmp_path / "run.zarr"))
    norm = wt.open_run(tmp_path / "run.zarr").info.obs_norm
    assert norm is not None
    assert (norm.clip_low, norm.clip_high) == (-10, 10)


# Policies that are recorded but not rebuilt


class Extractor(BaseFeaturesExtractor):
    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__(space, features_dim=5)
        self.linear = torch.nn.Linear(space.shape[0], 5)  # type: ignore[index]

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return self.linear(observations)  # type: ignore[no-any-return]


def scaled_env() -> gym.Env[Any, Any]:
    env = gym.make("Pendulum-v1")
    return gym.wrappers.TransformObservation(env, lambda o: 2 * o, env.observation_space)


def rescaled_env() -> gym.Env[Any, Any]:
    return gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), -1, 1)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (
            lambda: PPO(
                "MlpPolicy",
                "Pendulum-v1",
                n_steps=64,
                policy_kwargs={"features_extractor_class": Extractor},
                device="cpu",
            ),
            "features from Extractor",
        ),
        (
            lambda: PPO("MlpPolicy", DummyVecEnv([scaled_env]), n_steps=64, device="cpu"),
            "environment wrapper TransformObservation",
        ),
        (
            lambda: PPO(
                "MlpPolicy",
                VecFrameStack(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), 2),
                n_steps=64,
                device="cpu",
            ),
            "environment wrapper VecFrameStack",
        ),
        (
            lambda: PPO("MlpPolicy", "Pendulum-v1", n_steps=64, use_sde=True, device="cpu"),
            "state-dependent exploration",
        ),
        (
            lambda: PPO("MlpPolicy", SubprocVecEnv([rescaled_env]), n_steps=64, device="cpu"),
            "environment wrapper RescaleAction",
        ),
        (
            lambda: PPO(
                "MlpPolicy",
                "Pendulum-v1",
                n_steps=64,
                policy_kwargs={"activation_fn": lambda: torch.nn.LeakyReLU(0.2)},
                device="cpu",
            ),
            "hidden modules",
        ),
    ],
)
def test_other_policies_are_recorded_all_the_same(
    make: Callable[[], PPO], reason: str, tmp_path: Path
) -> None:
    model = make()
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=4)
    with pytest.warns(UserWarning, match=reason):
        model.learn(64, callback=callback)
    run = wt.open_run(tmp_path / "run.zarr")
    model.get_env().close()  # type: ignore[union-attr]
    assert np.array_equal(run.weights[-1], flat(model))
    with pytest.raises(PolicyError, match=reason):
        run.load_policy()


# Bad input


def test_an_existing_path_is_refused_before_training(tmp_path: Path) -> None:
    (tmp_path / "run.zarr").mkdir()
    model = make_ppo(SMALL, seed=0)
    with pytest.raises(StoreExistsError, match="choose another path"):
        model.learn(256, callback=WeightTrajectoryCallback(tmp_path / "run.zarr"))
    assert model.num_timesteps == 0


def test_diverged_training_stops_and_keeps_what_was_finite(tmp_path: Path) -> None:
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1)
    config = replace(SMALL, normalization="none")
    model = make_ppo(config, seed=0)
    steps = itertools.count(1)

    def poison(*_: object) -> None:
        if next(steps) == 6:
            with torch.no_grad():
                model.policy.action_net.weight.fill_(float("nan"))

    model.policy.optimizer.register_step_post_hook(poison)
    with pytest.raises(SnapshotError, match="training has diverged"):
        model.learn(256, callback=callback)
    callback.close()
    run = wt.open_run(tmp_path / "run.zarr")
    assert (len(run), run.info.status) == (6, "crashed")
    assert wt.verify(run.path) == []


@pytest.mark.parametrize("managed", [True, False])
def test_an_interrupted_training_is_committed_when_the_callback_goes(
    managed: bool, tmp_path: Path
) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 150:
                raise KeyboardInterrupt
            return True

    model = make_ppo(SMALL, seed=0)
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=4)
    with pytest.raises(KeyboardInterrupt):
        if managed:
            with callback:
                model.learn(256, callback=[callback, Stop()])
        else:
            model.learn(256, callback=[callback, Stop()])
    del model, callback
    gc.collect()
    run = wt.open_run(tmp_path / "run.zarr")
    assert (len(run), run.info.status) == (5, "crashed")


@pytest.mark.parametrize("last", [True, False])
def test_another_callback_that_fails_at_the_end_costs_no_snapshot(
    last: bool, tmp_path: Path
) -> None:
    """Neither one that comes later in the list nor one that comes before."""

    class Fails(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_training_end(self) -> None:
            raise OSError("no space")

    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=4)
    model = make_ppo(SMALL, seed=0)
    with pytest.raises(OSError, match="no space"):
        model.learn(256, callback=[callback, Fails()] if last else [Fails(), callback])
    run = wt.open_run(tmp_path / "run.zarr")  # nothing has been collected as garbage
    assert (len(run), run.info.status) == (9, "complete" if last else "crashed")
    assert wt.verify(run.path) == []


def test_a_callback_records_one_training(tmp_path: Path) -> None:
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr")
    with pytest.raises(CollectError, match="before training"):
        _ = callback.writer
    learn(SMALL, callback)
    with pytest.raises(CollectError, match="second call"):
        learn(SMALL, callback)


def test_moments_of_an_optimizer_without_them_are_refused(tmp_path: Path) -> None:
    model = A2C("MlpPolicy", "Pendulum-v1", device="cpu")
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", optimizer_moments=True)
    with pytest.raises(CollectError, match="RMSprop"):
        model.learn(5, callback=callback)


@pytest.mark.parametrize("every", [0, -1])
def test_an_impossible_cadence_is_refused(every: int, tmp_path: Path) -> None:
    with pytest.raises(CollectError, match="at least 1"):
        WeightTrajectoryCallback(tmp_path / "run.zarr", every=every)


def normalized() -> gym.Env[Any, Any]:
    return gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1"))


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: DummyVecEnv([normalized, normalized]), "n_envs=1, or normalise with VecNormalize"),
        (lambda: VecNormalize(DummyVecEnv([normalized])), "one on top of the other"),
        (lambda: SubprocVecEnv([normalized], "fork"), "live in other processes"),
    ],
)
def test_ambiguous_normalisers_are_refused(
    env: Callable[[], Any], message: str, tmp_path: Path
) -> None:
    model = PPO("MlpPolicy", env(), n_steps=64, device="cpu")
    with pytest.raises(CollectError, match=message):
        model.learn(64, callback=WeightTrajectoryCallback(tmp_path / "run.zarr"))
    model.get_env().close()  # type: ignore[union-attr]


# Wrappers: which leave the policy as it is, and which do not


class PaidTwice(gym.RewardWrapper):  # type: ignore[type-arg]
    def reward(self, reward: Any) -> float:
        return 2 * float(reward) + float(np.abs(self.unwrapped.state).sum())  # type: ignore[attr-defined]


class PaidByStep(gym.Wrapper):  # type: ignore[type-arg]
    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, float(reward) + 1, terminated, truncated, info


class PaidTogether(VecEnvWrapper):
    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * 3, dones, infos


class Blinking(gym.Wrapper):  # type: ignore[type-arg]
    """Hides an observation now and then."""

    steps = 0

    def step(self, action: Any) -> Any:
        self.steps += 1
        observation, *rest = self.env.step(action)
        return (observation * (self.steps % 20 > 0), *rest)


class Sticky(gym.Wrapper):  # type: ignore[type-arg]
    """Repeats the last action now and then, by the global generator."""

    last: Any = None

    def step(self, action: Any) -> Any:
        self.last = self.last if self.last is not None and np.random.random() < 0.2 else action
        return self.env.step(self.last)


class Aged(gym.wrappers.TimeLimit):  # type: ignore[type-arg]
    def step(self, action: Any) -> Any:
        observation, *rest = super().step(action)
        return (observation * 0.5, *rest)


class Halved(VecNormalize):
    def normalize_obs(self, obs: Any) -> Any:
        return super().normalize_obs(obs) / 2  # type: ignore[operator]


class Scaled(VecEnvWrapper):
    def reset(self) -> Any:
        return 2 * self.venv.reset()  # type: ignore[operator]

    def step_wait(self) -> Any:
        observations, *rest = self.venv.step_wait()
        return (2 * observations, *rest)  # type: ignore[operator]


def pendulum(wrap: Callable[[Any], Any] = lambda env: env, vec: Any = None) -> Any:
    env = DummyVecEnv([lambda: wrap(gym.make("Pendulum-v1"))] * 2)
    return vec(env) if vec else env


@pytest.mark.filterwarnings("ignore:this training is recorded:UserWarning")
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: pendulum(PaidTwice), "PaidTwice"),
        (lambda: pendulum(PaidByStep), "PaidByStep"),
        (lambda: VecNormalize(pendulum(PaidTwice)), "PaidTwice"),
        (lambda: pendulum(vec=PaidTogether), "PaidTogether"),
    ],
)
def test_a_wrapper_of_rewards_leaves_the_policy_and_hides_the_environment(
    make: Callable[[], Any], name: str, tmp_path: Path
) -> None:
    env = make()
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, device="cpu")
    model.learn(64, callback=WeightTrajectoryCallback(tmp_path / "run.zarr"))
    run = wt.open_run(tmp_path / "run.zarr")
    raw = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    inputs = env.normalize_obs(raw) if isinstance(env, VecNormalize) else raw
    expected = model.predict(inputs, deterministic=True)[0]
    assert np.array_equal(run.load_policy().predict(raw, deterministic=True)[0], expected)
    with pytest.raises(PolicyError, match=f"cannot be made again: environment wrapper {name}"):
        wt.policies.evaluate(run.load_policy(), run, episodes=1)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: pendulum(Blinking), "Blinking"),
        (lambda: pendulum(Sticky), "Sticky"),
        (lambda: pendulum(lambda env: Aged(env, 100)), "Aged"),
        (lambda: pendulum(vec=Halved), "Halved"),
        (lambda: pendulum(vec=Scaled), "Scaled"),
    ],
)
def test_a_wrapper_that_changes_observations_or_actions_is_named(
    make: Callable[[], Any], name: str, tmp_path: Path
) -> None:
    model = PPO("MlpPolicy", make(), n_steps=32, batch_size=32, n_epochs=1, device="cpu")
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr")
    with pytest.warns(UserWarning, match=f"environment wrapper {name}"):
        model.learn(64, callback=callback)
    run = wt.open_run(tmp_path / "run.zarr")
    with pytest.raises(PolicyError, match=f"environment wrapper {name}"):
        run.load_policy()
