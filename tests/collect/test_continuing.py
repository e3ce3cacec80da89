"""Training that goes on, and training that is stopped."""

from __future__ import annotations

import copy
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import weighttraj as wt
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.errors import CollectError
from weighttraj.format import Continuation
from weighttraj.tools.lint import lint

pytestmark = pytest.mark.filterwarnings("ignore:the weights of this training are recorded")

SETTINGS: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "n_epochs": 1, "device": "cpu"}


def ppo(**settings: Any) -> PPO:
    return PPO("MlpPolicy", "Pendulum-v1", **(SETTINGS | {"seed": 0} | settings))


def first_run(folder: Path) -> Path:
    """A run of 64 environment steps and its model, saved."""
    model = ppo()
    model.learn(64, callback=WeightTrajectoryCallback(folder / "first.zarr", every=1))
    model.save(folder / "model.zip")
    return folder / "first.zarr"


@pytest.mark.parametrize("reset", [False, True])
def test_a_run_says_which_snapshot_it_continues_and_its_counters_go_on(
    reset: bool, tmp_path: Path
) -> None:
    first = wt.open_run(first_run(tmp_path))
    model = PPO.load(tmp_path / "model.zip", env=gym.make("Pendulum-v1"))
    callback = WeightTrajectoryCallback(tmp_path / "second.zarr", every=1, continues=first.path)
    model.learn(64, callback=callback, reset_num_timesteps=reset)
    run = wt.open_run(tmp_path / "second.zarr")
    digest = first["digest"][-1].tobytes().hex()
    assert run.info.continues == Continuation(
        num_timesteps=64, run_id="first", snapshot=4, digest=digest
    )
    assert np.array_equal(run.weights[0], first.weights[-1])
    assert run["index/gradient_step"][:].tolist() == [4, 5, 6, 7, 8]
    assert run.iteration.tolist() == [2, 3, 3, 4, 4]
    assert run.phase.tolist() == [-1, 0, 1, 0, 1]
    assert run["index/epoch"][:].tolist() == [0, 0, 1, 0, 1]
    assert run.num_timesteps.tolist() == [64, 96, 96, 128, 128]
    assert lint(run.path) == []


def test_an_off_policy_run_goes_on(tmp_path: Path) -> None:
    settings = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "device": "cpu"}
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=100, seed=0, **settings)
    model.learn(20, callback=WeightTrajectoryCallback(tmp_path / "a.zarr", every=5))
    callback = WeightTrajectoryCallback(tmp_path / "b.zarr", every=5, continues=tmp_path / "a.zarr")
    model.learn(10, callback=callback, reset_num_timesteps=False)
    run = wt.open_run(tmp_path / "b.zarr")
    assert run["index/gradient_step"][:].tolist() == [10, 15, 20]
    assert run.num_timesteps.tolist() == [20, 25, 30]
    assert set(run.iteration.tolist()) == {-1}


def test_a_model_that_is_no_snapshot_of_the_run_is_refused(tmp_path: Path) -> None:
    first = first_run(tmp_path)
    for model, got in (
        (ppo(seed=1), "other weights"),
        (ppo(policy_kwargs={"net_arch": [4]}), "another layout"),
    ):
        callback = WeightTrajectoryCallback(tmp_path / "second.zarr", continues=first)
        with pytest.raises(CollectError, match=got):
            model.learn(32, callback=callback)
    assert not (tmp_path / "second.zarr").exists()


def test_a_normaliser_that_was_not_loaded_is_refused(tmp_path: Path) -> None:
    def env() -> VecNormalize:
        return VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))

    model = PPO("MlpPolicy", env(), seed=0, **SETTINGS)
    model.learn(64, callback=WeightTrajectoryCallback(tmp_path / "first.zarr", every=1))
    again = {"continues": tmp_path / "first.zarr", "every": 1}
    callback = WeightTrajectoryCallback(tmp_path / "second.zarr", **again)  # type: ignore[arg-type]
    model.learn(32, callback=callback, reset_num_timesteps=False)
    counts = wt.open_run(tmp_path / "second.zarr")["obs_norm/count"][:]
    assert 64 < counts[0] < 66
    model.set_env(env())
    callback = WeightTrajectoryCallback(tmp_path / "third.zarr", continues=tmp_path / "second.zarr")
    with pytest.raises(CollectError, match=r"VecNormalize\.load"):
        model.learn(32, callback=callback)


@pytest.mark.parametrize("reset", [False, True])
def test_a_trained_model_of_unknown_origin_is_marked_and_found(reset: bool, tmp_path: Path) -> None:
    first_run(tmp_path)
    model = PPO.load(tmp_path / "model.zip", env=gym.make("Pendulum-v1"))
    callback = WeightTrajectoryCallback(tmp_path / "second.zarr", every=1)
    model.learn(32, callback=callback, reset_num_timesteps=reset)
    run = wt.open_run(tmp_path / "second.zarr")
    before = 0 if reset else 64
    assert run.info.continues == Continuation(num_timesteps=before)
    assert run.num_timesteps.tolist() == [before, before + 32, before + 32]
    assert run["index/gradient_step"][:].tolist() == [0, 1, 2]
    (finding,) = (f for f in lint(run.path) if f.check == "start")
    assert f"starts from a trained model: num_timesteps {before} at the start" in finding.message


def test_a_fresh_training_continues_nothing(tmp_path: Path) -> None:
    run = wt.open_run(first_run(tmp_path))
    assert run.info.continues is None
    assert lint(run.path) == []


def test_a_run_that_begins_late_is_found(tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((2,), "weight", ("fixed",))})
    with wt.RunWriter(tmp_path / "r.zarr", wt.RunInfo(run_id="r", layout=layout)) as writer:
        for t in range(3):
            writer.append(np.full(2, t), num_timesteps=100 + t)
    (finding,) = lint(tmp_path / "r.zarr")
    assert (finding.check, "num_timesteps 100" in finding.message) == ("start", True)


def test_a_second_call_of_learn_is_told_what_to_do(tmp_path: Path) -> None:
    model = ppo()
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1)
    model.learn(32, callback=callback)
    with pytest.raises(CollectError, match=r"(?s)second call.*continues='.*run\.zarr'"):
        model.learn(32, callback=callback, reset_num_timesteps=False)
    run = wt.open_run(tmp_path / "run.zarr")
    assert (len(run), run.info.status) == (3, "complete")


# Stopped


class Stop(BaseCallback):
    """Ends the training by an exception in a rollout or in an update."""

    def __init__(self, error: type[BaseException], where: str) -> None:
        super().__init__()
        self.error, self.where = error, where

    def _on_step(self) -> bool:
        if self.where == "rollout" and self.num_timesteps == 80:
            raise self.error
        return True

    def _on_training_start(self) -> None:
        steps = iter(range(6))
        if self.where == "update":
            hook = self.model.policy.optimizer.register_step_post_hook
            self.handle = hook(lambda *_: self._stop(next(steps)))

    def _stop(self, step: int) -> None:
        if step == 4:
            self.handle.remove()
            raise self.error


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError])
@pytest.mark.parametrize(("where", "snapshots"), [("rollout", 5), ("update", 6)])
def test_an_exception_in_learn_commits_all_that_was_recorded(
    error: type[BaseException], where: str, snapshots: int, tmp_path: Path
) -> None:
    model = ppo()
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1)
    with pytest.raises(error):
        model.learn(320, callback=[callback, Stop(error, where)])
    run = wt.open_run(tmp_path / "run.zarr")
    assert (len(run), run.info.status) == (snapshots, "crashed")
    assert wt.verify(run.path) == []
    assert not {"train", "collect_rollouts", "_excluded_save_params"} & vars(model).keys()
    again = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1, resume=True)
    ppo().learn(160, callback=again)
    run = wt.open_run(tmp_path / "run.zarr")
    assert (len(run), run.info.status) == (11, "complete")


def test_models_that_are_saved_or_copied_while_they_are_recorded_have_their_own_methods(
    tmp_path: Path,
) -> None:
    class Save(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 40:
                self.model.save(tmp_path / "saved.zip")
                self.copied = copy.copy(vars(self.model))
            return True

    model, save = ppo(), Save()
    one = WeightTrajectoryCallback(tmp_path / "one.zarr", every=1)
    two = WeightTrajectoryCallback(tmp_path / "two.zarr", every=2)
    model.learn(64, callback=[one, two, save])
    assert "train" in save.copied
    assert "train" not in vars(model)
    loaded = PPO.load(tmp_path / "saved.zip", env=gym.make("Pendulum-v1"))
    assert not {"train", "collect_rollouts", "_excluded_save_params"} & vars(loaded).keys()
    loaded.learn(32)
    assert len(wt.open_run(tmp_path / "one.zarr")) == 5
    assert len(wt.open_run(tmp_path / "two.zarr")) == 3


def test_verify_says_how_much_of_a_stopped_run_is_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from weighttraj.cli import main

    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1)
    with pytest.raises(KeyboardInterrupt):
        ppo().learn(320, callback=[callback, Stop(KeyboardInterrupt, "rollout")])
    monkeypatch.setattr(sys, "argv", ["weighttraj", "verify", str(tmp_path / "run.zarr")])
    main()
    assert "5 snapshots are committed, and the run is not finished (crashed)" in "".join(
        capsys.readouterr().out.split("\n")
    )
