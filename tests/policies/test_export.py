"""Snapshots as Stable-Baselines3 models, loaded as any user would."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import weighttraj as wt
from tests.small import CONFIGS, learn
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.errors import PolicyError, StoreExistsError
from weighttraj.policies import export_sb3
from weighttraj.run import Run


@pytest.fixture(scope="module", params=list(CONFIGS))
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> wt.Run:
    path = tmp_path_factory.mktemp("run") / f"{request.param}.zarr"
    learn(CONFIGS[request.param], WeightTrajectoryCallback(path, every=4))
    return wt.open_run(path)


class Told:
    """What a store says, with other metadata."""

    def __init__(self, run: wt.Run, info: wt.RunInfo) -> None:
        self.path, self.info, self.specs = run.path, info, run._store.specs
        self.read, self.chunk_rows = run._store.read, run._store.chunk_rows


def told(run: wt.Run, **changes: object) -> wt.Run:
    """The run as if its metadata said something else."""
    store = Told(run, replace(run.info, **changes))  # type: ignore[arg-type]
    return Run(run.path, lambda: store)  # type: ignore[arg-type, return-value]


def env_of(run: wt.Run) -> DummyVecEnv:
    assert run.info.env is not None
    env_id = run.info.env.id
    return DummyVecEnv([lambda: gym.make(env_id)])


def observations(run: wt.Run) -> np.ndarray:
    """Raw observations, from usual to far outside the clip, in the environment's own type."""
    space = env_of(run).observation_space
    raw = np.random.default_rng(0).normal(size=(200, 4)) * np.logspace(-2, 3, 200)[:, None]
    return raw.astype(space.dtype)


def test_the_exported_model_acts_as_the_snapshot_does(run: wt.Run, tmp_path: Path) -> None:
    raw = observations(run)
    for t in (0, 3, len(run) - 1):
        exported = export_sb3(run, t, tmp_path / str(t))
        model, inputs = PPO.load(exported.model, device="cpu"), raw
        if exported.vecnormalize is not None:
            normalize = VecNormalize.load(str(exported.vecnormalize), env_of(run))
            inputs = normalize.normalize_obs(raw)
        expected = run.load_policy(t).predict(raw, deterministic=True)[0]
        actions = model.predict(inputs, deterministic=True)[0]
        if run.info.policy.head == "categorical":
            assert np.array_equal(actions, expected)
            assert len(np.unique(actions)) == 2
        else:
            np.testing.assert_allclose(actions, expected, rtol=1e-6, atol=1e-7)
    assert (exported.vecnormalize is None) == (run.info.obs_norm is None)


def test_the_actor_is_the_snapshot_bit_by_bit(run: wt.Run, tmp_path: Path) -> None:
    model = PPO.load(export_sb3(run, 5, tmp_path / "sb3").model, device="cpu")
    state = {name: tensor.numpy() for name, tensor in model.policy.state_dict().items()}
    assert run.layout.flatten(state).tobytes() == run.weights[5].tobytes()
    assert model.num_timesteps == run.num_timesteps[5]
    assert model.seed == run.info.seed
    assert model.lr_schedule(1.0) == run.learning_rate[5]
    recorded = run.info.algorithm
    assert recorded is not None
    for name in ("n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "vf_coef"):
        assert getattr(model, name) == recorded.hyperparameters[name]
    assert model.clip_range(1.0) == 0.2  # type: ignore[operator]
    assert model.policy.optimizer.defaults["eps"] == 1e-5


def test_the_normaliser_is_set_up_for_evaluation(run: wt.Run, tmp_path: Path) -> None:
    exported = export_sb3(run, 5, tmp_path / "sb3")
    stats, norm = run.obs_norm(5), run.info.obs_norm
    if stats is None or norm is None:
        assert exported.vecnormalize is None
        assert [p.name for p in (tmp_path / "sb3").iterdir()] == ["model.zip"]
        return
    normalize = VecNormalize.load(str(exported.vecnormalize), env_of(run))
    assert np.array_equal(normalize.obs_rms.mean, stats.mean)  # type: ignore[union-attr]
    assert np.array_equal(normalize.obs_rms.var, stats.var)  # type: ignore[union-attr]
    assert normalize.obs_rms.count == stats.count  # type: ignore[union-attr]
    rewards = run.ret_norm(5)
    assert rewards is not None
    assert (normalize.ret_rms.mean, normalize.ret_rms.var) == (rewards.mean, rewards.var)
    assert (normalize.epsilon, normalize.clip_obs) == (norm.epsilon, norm.clip_high)
    assert (normalize.training, normalize.norm_reward) == (False, False)


def test_training_can_go_on_from_a_snapshot(run: wt.Run, tmp_path: Path) -> None:
    exported = export_sb3(run, -1, tmp_path / "sb3")
    env = env_of(run)
    if exported.vecnormalize is not None:
        env = VecNormalize.load(str(exported.vecnormalize), env)  # type: ignore[assignment]
    model = PPO.load(exported.model, env=env, device="cpu")  # SB3 compares the spaces
    model.learn(64, reset_num_timesteps=False)
    assert model.num_timesteps == run.num_timesteps[-1] + 64


@pytest.mark.parametrize("t", [0, 7])
def test_the_critic_is_the_stored_one(full_run: wt.Run, tmp_path: Path, t: int) -> None:
    exported = export_sb3(full_run, t, tmp_path / "sb3")
    assert exported.critic == "stored"
    state = PPO.load(exported.model, device="cpu").policy.state_dict()
    layout = full_run.info.critic_layout
    assert layout is not None
    flat = layout.flatten({name: tensor.numpy() for name, tensor in state.items()})
    assert flat.tobytes() == full_run["critic/weights"][t].tobytes()


def test_a_critic_that_is_not_stored_is_fresh(run: wt.Run, tmp_path: Path) -> None:
    one, other = (export_sb3(run, 5, tmp_path / name) for name in ("one", "other"))
    assert (one.critic, other.critic) == ("fresh", "fresh")
    states = [PPO.load(e.model, device="cpu").policy.state_dict() for e in (one, other)]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_random_numbers_go_on_as_they_were(full_run: wt.Run, tmp_path: Path) -> None:
    # Not Python's own generator: beartype, which checks types in these tests, draws from it.
    before = torch.get_rng_state(), np.random.get_state()[1].tolist()
    export_sb3(full_run, 0, tmp_path / "sb3")
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.random.get_state()[1].tolist() == before[1]


def test_sb3_loads_it_without_this_package(full_run: wt.Run, tmp_path: Path) -> None:
    exported = export_sb3(full_run, 2, tmp_path / "sb3")
    code = (
        "import pickle, sys; sys.modules['weighttraj'] = None\n"
        "from stable_baselines3 import PPO\n"
        "print(PPO.load(sys.argv[1]).num_timesteps)\n"
        "print(pickle.load(open(sys.argv[2], 'rb')).clip_obs)\n"
    )
    command = [sys.executable, "-c", code, str(exported.model), str(exported.vecnormalize)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(full_run.num_timesteps[2]), "10.0"]


def test_a2c_is_loaded_as_a2c(tmp_path: Path) -> None:
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=4, critic=True)
    A2C("MlpPolicy", "CartPole-v1", device="cpu", seed=0).learn(100, callback=callback)
    run = wt.open_run(tmp_path / "run.zarr")
    exported = export_sb3(run, -1, tmp_path / "sb3")
    assert exported.critic == "stored"
    model, raw = A2C.load(exported.model, device="cpu"), observations(run)
    expected = run.load_policy(-1).predict(raw, deterministic=True)[0]
    assert np.array_equal(model.predict(raw, deterministic=True)[0], expected)


@pytest.mark.parametrize("env_id", ["Unknown-v7", "module:Unknown-v0", None])
def test_without_its_environment_the_recorded_spaces_serve(
    run: wt.Run, tmp_path: Path, env_id: str | None
) -> None:
    info = run.info.env
    assert info is not None
    alone = told(run, env=replace(info, id=env_id) if env_id else None)
    there = PPO.load(export_sb3(alone, 4, tmp_path / "alone").model, device="cpu")
    here = PPO.load(export_sb3(run, 4, tmp_path / "sb3").model, device="cpu")
    assert there.action_space == here.action_space
    inputs = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    actions = [m.predict(inputs, deterministic=True)[0] for m in (here, there)]
    assert np.array_equal(*actions)


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "MountainCar-v0"])
def test_another_environment_is_refused(full_run: wt.Run, tmp_path: Path, env_id: str) -> None:
    info = full_run.info.env
    assert info is not None
    with pytest.raises(PolicyError, match="not the one that the policy was trained in"):
        export_sb3(told(full_run, env=replace(info, id=env_id)), 0, tmp_path / "sb3")
    assert not (tmp_path / "sb3").exists()


@pytest.mark.parametrize(("low", "high"), [(-5.0, 10.0), (None, 10.0), (-10.0, None)])
def test_a_clip_that_vecnormalize_cannot_do_is_refused(
    full_run: wt.Run, tmp_path: Path, low: float | None, high: float | None
) -> None:
    norm = full_run.info.obs_norm
    assert norm is not None
    odd = told(full_run, obs_norm=replace(norm, clip_low=low, clip_high=high))
    with pytest.raises(PolicyError, match="same bound below and above"):
        export_sb3(odd, 0, tmp_path / "sb3")
    free = told(full_run, obs_norm=replace(norm, clip_low=None, clip_high=None))
    exported = export_sb3(free, 3, tmp_path / "free")
    raw = observations(full_run)
    inputs = VecNormalize.load(str(exported.vecnormalize), env_of(full_run)).normalize_obs(raw)
    assert np.array_equal(inputs, free.load_policy(3).normalize(raw))
    assert np.abs(inputs).max() > 10  # type: ignore[arg-type]


def test_hyper_parameters_that_make_no_model_are_named(full_run: wt.Run, tmp_path: Path) -> None:
    algorithm = full_run.info.algorithm
    assert algorithm is not None
    values = algorithm.hyperparameters | {"batch_size": 1}
    odd = told(full_run, algorithm=replace(algorithm, hyperparameters=values))
    with pytest.raises(PolicyError, match=r"make no PPO[\s\S]*batch_size"):
        export_sb3(odd, 0, tmp_path / "sb3")


def test_a_run_that_says_little_gives_sb3s_defaults(full_run: wt.Run, tmp_path: Path) -> None:
    layout = full_run.info.critic_layout
    assert layout is not None
    params = tuple(replace(p, name=f"other.{p.name}") for p in layout.params)
    little = told(full_run, algorithm=None, critic_layout=replace(layout, params=params))
    exported = export_sb3(little, 0, tmp_path / "sb3")
    assert exported.critic == "fresh"  # SB3 has no parameters of these names
    assert PPO.load(exported.model, device="cpu").n_steps == 2048


def test_policies_that_are_no_networks_are_refused(full_run: wt.Run, tmp_path: Path) -> None:
    odd = replace(full_run.info.policy, kind="other", cannot_rebuild=("a recurrent network",))
    with pytest.raises(PolicyError, match="a recurrent network"):
        export_sb3(told(full_run, policy=odd), 0, tmp_path / "sb3")


def test_what_exists_is_not_overwritten(full_run: wt.Run, tmp_path: Path) -> None:
    with pytest.raises(StoreExistsError):
        export_sb3(full_run, 0, tmp_path)
    with pytest.raises(IndexError):
        export_sb3(full_run, 16, tmp_path / "sb3")
    assert list(tmp_path.iterdir()) == []
