"""Jumps in real trainings: what they change, and what they leave alone."""

from __future__ import annotations

import json
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from msgspec.structs import replace as replace_struct
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

import tipl
import weighttraj as wt
from tests.pages import ROOT, run_command
from tests.small import CONFIGS, SMALL, learn, random_states
from tipl.errors import EvaluateError, ForecastError
from tipl.forecaster import Forecaster
from tipl.growing import GrowingRun
from tipl.live import ForecastCallback, IterationAverage, Jump, JumpConfig, PopulationJumps
from tipl.live.config import known_every, known_horizons
from tipl.live.guards import ReturnWatch, passes_batch
from tipl.live.path import TrainingPath
from tipl.live.plan import ppo_of, read_plan
from tipl.live.results import Cpu, Curve, Series, read_live
from tipl.live.study import LiveConfig, run_live
from tipl.live.summary import compare, final_returns, mean_log_ratio, steps_to, thresholds_of
from tipl.models.stretched import Stretched
from tipl.registry import unfitted
from tipl.saved import fingerprint
from weighttraj.atomic import lock_of
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.collect.agents import find_agent
from weighttraj.collect.describe import describe_run
from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.population import Population, origins_of
from weighttraj.collect.ppo import make_ppo
from weighttraj.collect.settings import Store
from weighttraj.tools.lint import lint_run

# 8 gradient steps an iteration: 4 snapshots. One iteration ahead along the last one is an outer
# step with sigma = 2.
EVERY, ITERATION = 2, 4
OUTER = JumpConfig(horizon=ITERATION, every=EVERY, first=1)
NEVER = replace(OUTER, first=1000)


class Ahead(Forecaster):
    """Moves every parameter by the same number."""

    name = "ahead"

    def __init__(self, far: float = 1.0) -> None:
        self.far = far

    def forecast(self, run: wt.Run, starts: Any, horizons: Any) -> np.ndarray:
        rows = run.weights[:][np.asarray(starts)][:, None]
        return np.repeat(rows + np.float32(self.far), len(horizons), 1)


def parameters(model: PPO) -> dict[str, np.ndarray]:
    return {name: p.detach().numpy().copy() for name, p in model.policy.named_parameters()}


def run_info(config: Any = SMALL) -> wt.RunInfo:
    model = origins_of(config, [0])[0].model
    env = model.get_env()
    assert env is not None
    return describe_run(find_agent(model), find_normalizers(env), "run", Store(every=EVERY))


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_a_training_that_never_jumps_is_the_same_bit_by_bit(name: str) -> None:
    plain = learn(CONFIGS[name], None)
    watched = learn(CONFIGS[name], ForecastCallback("last-iteration", NEVER))
    for parameter, values in parameters(plain).items():
        np.testing.assert_array_equal(values, parameters(watched)[parameter])
    assert random_states(plain) == random_states(watched)


@pytest.mark.parametrize("guard", ["none", "batch", "rollout"])
@pytest.mark.parametrize("name", ["vecnormalize", "categorical"])
def test_a_jump_moves_the_actor_alone(name: str, guard: Any) -> None:
    config = replace(CONFIGS[name], total_timesteps=128)
    seen: dict[str, dict[str, np.ndarray]] = {}

    class Spy(ForecastCallback):
        def _on_rollout_start(self) -> None:
            seen["before"] = parameters(self.model)
            super()._on_rollout_start()
            seen["after"] = parameters(self.model)

    callback = Spy("last-iteration", replace(OUTER, guard=guard, max_kl=10.0))
    learn(config, callback)
    (jump,) = callback.jumps
    assert (jump.iteration, jump.num_timesteps) == (1, 64)
    assert jump.relative_size == pytest.approx(1, abs=0.2)  # log_std stays
    for parameter, before in seen["before"].items():
        is_kept = "value" in parameter or parameter == "log_std" or jump.outcome == "refused"
        assert np.array_equal(before, seen["after"][parameter]) == is_kept, parameter


def test_a_forecaster_sees_the_path_without_the_jumps() -> None:
    seen: list[np.ndarray] = []

    class Watching(Ahead):
        def forecast(self, run: wt.Run, starts: Any, horizons: Any) -> np.ndarray:
            seen.append(run.weights[:].copy())
            assert len(run.phase) == len(run) == starts[0] + 1
            return super().forecast(run, starts, horizons)

    learn(SMALL, ForecastCallback(Watching(100.0), OUTER))
    assert [len(path) for path in seen] == [5, 9, 13]
    assert np.abs(np.diff(seen[-1], axis=0)).max() < 1  # a jump is 100
    np.testing.assert_array_equal(seen[0], seen[-1][:5])


def test_the_released_gate_forecasts_as_from_a_stored_run(tmp_path: Path) -> None:
    """From the path in memory come the numbers that a recorded run gives."""
    config = replace(SMALL, n_steps=256, total_timesteps=768, batch_size=64, n_epochs=80)
    gate = tipl.load("tipl-gate-inverted-pendulum-v4")
    made: list[np.ndarray] = []

    class Recorded(ForecastCallback):
        def _jump(self, now: np.ndarray, jump: Jump, after: np.ndarray) -> None:
            made.append(after)

    recorder = WeightTrajectoryCallback(tmp_path / "run.zarr", every=64)
    learn(config, [recorder, Recorded(gate, JumpConfig(horizon=50, log_std=True, first=1))])
    run = wt.open_run(tmp_path / "run.zarr")
    np.testing.assert_allclose(gate.forecast(run, [5, 10], [50])[:, 0], made, atol=1e-6)


RELEASED = ("tipl-gate", "tipl-drift", "tipl-causal", "ar-20-phase")


@pytest.mark.parametrize("name", [*unfitted(), *(f"{m}-inverted-pendulum-v4" for m in RELEASED)])
def test_a_run_in_memory_is_forecast_as_a_stored_one(name: str, full_run: wt.Run) -> None:
    """Also when it has grown since the last forecast."""
    forecaster, growing = tipl.load(name), GrowingRun(full_run.info)
    weights, columns = full_run.weights[:], ("num_timesteps", "iteration", "phase")
    for t in range(len(full_run)):
        index = {column: int(full_run[f"index/{column}"][t]) for column in columns}
        index["gradient_step"] = int(full_run["index/gradient_step"][t])
        growing.append(weights[t], learning_rate=float(full_run.learning_rate[t]), **index)
        if t in (4, 5, 10, 15):
            stored = forecaster.forecast(full_run, [t], [10])
            np.testing.assert_array_equal(forecaster.forecast(growing, [t], [10]), stored)


def test_a_recorded_training_says_where_it_jumped(tmp_path: Path) -> None:
    recorder = WeightTrajectoryCallback(tmp_path / "run.zarr", every=EVERY)
    callback = ForecastCallback(Ahead(), OUTER)
    learn(SMALL, [callback, recorder])
    told = json.loads((tmp_path / "run.jumps.json").read_text())
    assert [jump["iteration"] for jump in told] == [1, 2, 3]
    steps = np.abs(np.diff(wt.open_run(tmp_path / "run.zarr").weights[:], axis=0)).max(1)
    assert np.flatnonzero(steps > 0.5).tolist() == [4, 8, 12]  # the steps after each jump
    assert wt.verify(tmp_path / "run.zarr") == []


@pytest.mark.parametrize("name", ["gymnasium", "vecnormalize"])
def test_a_jump_that_ruins_the_return_is_undone(name: str) -> None:
    """Policy, critic, Adam and normaliser are what they were; the environment steps are spent."""
    config = replace(CONFIGS[name], total_timesteps=192)
    kept: list[Any] = []

    def state(callback: ForecastCallback) -> list[Any]:
        model = callback.model
        optimizer = model.policy.optimizer.state_dict()["state"]
        arrays = [value.numpy() for one in optimizer.values() for value in one.values()]
        statistics = [vars(stats)["mean"] for stats in callback._statistics()]
        return [*parameters(model).values(), *map(np.array, arrays), *map(np.array, statistics)]

    class Bad(ForecastCallback):
        def _on_rollout_start(self) -> None:
            if self._iteration == 1:
                kept.append(state(self))
                self._watch.add([1000.0, 1001.0])
            super()._on_rollout_start()
            if self._iteration == 2:
                kept.append(state(self))

    callback = Bad(Ahead(3.0), replace(OUTER, last=1, guard="rollout", episodes=2))
    model = learn(config, callback)
    assert [jump.outcome for jump in callback.jumps] == ["undone"]
    path = callback._path
    assert path is not None
    assert path._run.phase.tolist() == [-1, *[0, 1, 2, 3] * 3]
    assert np.abs(np.diff(path._run.rows, axis=0)).max() < 1
    before, after = kept
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)
    assert model.num_timesteps == 192


def test_the_batch_guard_refuses_what_the_last_rollout_speaks_against() -> None:
    callback = ForecastCallback(Ahead(3.0), replace(OUTER, guard="batch"))
    model, plain = learn(SMALL, callback), learn(SMALL, None)
    assert [jump.outcome for jump in callback.jumps] == ["refused"] * 3
    for name, values in parameters(plain).items():
        np.testing.assert_array_equal(values, parameters(model)[name])
    config = JumpConfig()
    assert passes_batch(0.01, 0.1, 0.2, config)
    assert not passes_batch(0.01, 0.2, 0.1, config)
    assert not passes_batch(0.1, 0.1, 0.2, config)
    assert not passes_batch(0.01, 0.1, float("nan"), config)


def test_the_batch_guard_takes_dictionaries_of_observations() -> None:
    env = make_vec_env(
        lambda: gym.wrappers.TransformObservation(
            gym.make("Pendulum-v1"),
            lambda seen: {"all": seen},
            gym.spaces.Dict({"all": gym.make("Pendulum-v1").observation_space}),
        ),
        n_envs=2,
        seed=0,
    )
    callback = ForecastCallback(Ahead(0.01), replace(OUTER, guard="batch", max_kl=1e-9))
    settings: Any = {"n_steps": 16, "batch_size": 8, "n_epochs": 2, "device": "cpu"}
    PPO("MultiInputPolicy", env, seed=0, **settings).learn(96, callback=callback)
    assert [jump.outcome for jump in callback.jumps] == ["refused"] * 2


def test_the_batch_guard_takes_binary_actions() -> None:
    class Switches(gym.Env[Any, Any]):
        observation_space = gym.spaces.Box(-1, 1, (2,))
        action_space = gym.spaces.MultiBinary(3)

        def reset(self, **settings: Any) -> Any:
            super().reset(**settings)
            return self.observation_space.sample(), {}

        def step(self, action: Any) -> Any:
            done = bool(self.np_random.random() < 0.1)
            return self.observation_space.sample(), float(sum(action)), done, False, {}

    settings: Any = {"n_steps": 32, "batch_size": 8, "n_epochs": 2, "device": "cpu", "seed": 0}
    callback = ForecastCallback(Ahead(0.01), replace(OUTER, guard="batch"))
    PPO("MlpPolicy", Switches(), **settings).learn(96, callback=callback)
    assert len(callback.jumps) == 2


def test_the_rollout_guard_refuses_normalizers_in_other_processes() -> None:
    def normalized() -> Any:
        return gym.wrappers.NormalizeObservation(gym.make("InvertedPendulum-v4"))

    env = SubprocVecEnv([normalized])
    try:
        callback = ForecastCallback("last-iteration", replace(OUTER, guard="rollout"))
        with pytest.raises(ForecastError, match="NormalizeObservation in a SubprocVecEnv"):
            PPO("MlpPolicy", VecMonitor(env), device="cpu").learn(64, callback=callback)
    finally:
        env.close()


def test_an_iteration_that_adds_no_snapshot_makes_no_jump() -> None:
    callback = ForecastCallback("tipl-gate", JumpConfig(horizon=50))
    with pytest.raises(ForecastError, match="at least 64"):
        learn(SMALL, callback)  # 8 gradient steps
    info = run_info()
    path = TrainingPath(Ahead(), OUTER, info.layout, np.zeros(info.layout.size, np.float32))
    weights = np.zeros(info.layout.size, np.float32)
    made = []
    for iteration in (1, 2, 3):
        if iteration != 2:  # as where target_kl ends an update at once
            assert [path.end_gradient_step() for _ in range(EVERY)][-1]
            path.append(weights, iteration, 64 * iteration, 1e-3)
        made.append(path.propose(weights, iteration, 64 * iteration, 0.5) is not None)
    assert made == [True, False, True]


def test_a_callback_follows_one_model() -> None:
    callback = ForecastCallback("last-iteration", OUTER)
    learn(SMALL, callback)
    with pytest.raises(ForecastError, match="another model"):
        learn(SMALL, callback)


def test_a_training_that_is_stopped_leaves_its_jumps(tmp_path: Path) -> None:
    class Stop(ForecastCallback):
        def _on_rollout_end(self) -> None:
            super()._on_rollout_end()
            if self._iteration == 3:
                raise KeyboardInterrupt

    recorder = WeightTrajectoryCallback(tmp_path / "run.zarr", every=EVERY)
    with pytest.raises(KeyboardInterrupt):
        learn(SMALL, [Stop(Ahead(), OUTER), recorder])
    assert len(json.loads((tmp_path / "run.jumps.json").read_text())) == 2
    run = wt.open_run(tmp_path / "run.zarr")
    assert (run.info.status, run.info.moved_by) == ("crashed", ("Stop",))
    assert "moved" in [finding.check for finding in lint_run(run)]
    again = WeightTrajectoryCallback(tmp_path / "run.zarr", every=EVERY, resume=True)
    learn(SMALL, [ForecastCallback(Ahead(), OUTER), again])
    assert wt.open_run(tmp_path / "run.zarr").info.status == "complete"


def test_jumps_that_are_refused_leave_an_ordinary_run(tmp_path: Path) -> None:
    recorder = WeightTrajectoryCallback(tmp_path / "run.zarr", every=EVERY)
    callback = ForecastCallback(Ahead(3.0), replace(OUTER, guard="batch"))
    learn(SMALL, [callback, recorder])
    assert {jump.outcome for jump in callback.jumps} == {"refused"}
    assert wt.open_run(tmp_path / "run.zarr").info.moved_by == ()


def test_a_callback_that_refuses_the_training_leaves_no_run(tmp_path: Path) -> None:
    recorder = WeightTrajectoryCallback(tmp_path / "run.zarr", every=EVERY)
    with pytest.raises(ForecastError, match="at least 64"):
        learn(SMALL, [recorder, ForecastCallback("tipl-gate")])
    assert not (tmp_path / "run.zarr").exists()


def test_a_log_that_cannot_be_written_is_told_before_the_training(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    callback = ForecastCallback("last-iteration", OUTER, log=tmp_path / "file/jumps.json")
    with pytest.raises(ForecastError, match="cannot be written"):
        learn(SMALL, callback)
    assert callback.num_timesteps == 0
    log = tmp_path / "new/jumps.json"
    learn(SMALL, ForecastCallback("last-iteration", OUTER, log=log))
    assert len(json.loads(log.read_text())) == 3


def test_a_return_falls_when_it_falls_beyond_its_noise() -> None:
    watch = ReturnWatch(JumpConfig(noise=2, episodes=4))
    assert not watch.has_fallen([-1e9])  # nothing is known before
    watch.add([10.0, 12.0, 8.0, 10.0])  # spread 1.63
    assert not watch.has_fallen([])
    assert not watch.has_fallen([7.0])
    assert watch.has_fallen([5.0])
    assert watch.has_fallen([8.0] * 100)


def test_a_reset_forgets_adams_direction() -> None:
    found: list[float] = []

    class Spy(ForecastCallback):
        def _on_rollout_start(self) -> None:
            super()._on_rollout_start()
            state = self.model.policy.optimizer.state
            if self._iteration == 1:
                found.extend(
                    float(state[p]["exp_avg"].abs().sum()) for p in self._agent.actor.values()
                )

    learn(replace(SMALL, total_timesteps=128), Spy(Ahead(), replace(OUTER, moments="reset")))
    assert found == [0.0] * len(found)
    assert found


def test_horizons_follow_the_schedule() -> None:
    known = (1, 2, 5, 10, 50)
    falling = JumpConfig(schedule="falling", horizon=50)
    assert [falling.horizon_at(1, left, known) for left in (1, 0.9, 0.2, 0.01)] == [50, 10, 10, 1]
    assert falling.horizon_at(1, 0.5, None) == 25
    listed = JumpConfig(schedule=((2, 50), (40, 10)))
    assert [listed.horizon_at(i, 1, known) for i in (1, 2, 39, 40, 90)] == [None, 50, 50, 10, 10]
    some = JumpConfig(first=3, period=4, last=11)
    assert [i for i in range(1, 20) if some.is_due(i)] == [3, 7, 11]
    assert JumpConfig(fade=True, amplitude=2).amplitude_at(0.25) == 0.5


@pytest.mark.parametrize(
    "wrong",
    [
        *({"horizon": 0}, {"period": 0}, {"schedule": ()}, {"schedule": ((1, 0),)}),
        *({"guard": "bacth"}, {"moments": "rest"}, {"schedule": "faling"}, {"every": 2.5}),
        *({"amplitude": np.float64("nan")}, {"first": 3, "last": 2}, {"horizon": "50"}),
    ],
)
def test_impossible_settings_of_jumps_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ForecastError, match="expected"):
        JumpConfig(**wrong)


def test_a_forecaster_that_needs_the_future_is_refused() -> None:
    with pytest.raises(ForecastError, match="a causal forecaster"):
        ForecastCallback("tipl-inverted-pendulum-v4")


def trained(config: Any, seeds: list[int], jump: JumpConfig | None, far: Any = None) -> Any:
    population = Population(config, origins_of(config, seeds))
    jumps = None
    if jump is not None:
        forecaster = IterationAverage(0.0) if far is None else Ahead(far)
        jumps = PopulationJumps(population, forecaster, jump, run_info(config))
    population.train(jumps.watchers if jumps else [], hook=jumps)
    population.close()
    return population.stack.values.numpy().copy(), jumps


def test_a_population_without_jumps_has_the_bits_of_one_without_a_hook() -> None:
    plain, _ = trained(SMALL, [3, 4], None)
    watched, _ = trained(SMALL, [3, 4], NEVER)
    np.testing.assert_array_equal(plain, watched)


@pytest.mark.parametrize(
    ("forecaster", "options", "outcomes"),
    [
        (IterationAverage(0.0), {}, ["accepted"] * 3),
        (IterationAverage(0.0), {"moments": "reset"}, ["accepted"] * 3),
        (IterationAverage(0.0), {"guard": "batch"}, ["accepted"] * 3),
        (IterationAverage(0.0), {"guard": "batch", "amplitude": -1.0}, ["refused"] * 3),
        (Ahead(3.0), {"guard": "rollout", "last": 1}, ["undone"]),
    ],
    ids=["plain", "reset", "passes", "refused", "undone"],
)
@pytest.mark.parametrize("normalization", ["gymnasium", "vecnormalize"])
def test_a_population_jumps_as_sb3_does(
    normalization: Any, forecaster: Forecaster, options: Any, outcomes: list[str]
) -> None:
    """The same seed gives the same jumps and the same weights, up to the rounding of float32."""
    config = replace(SMALL, total_timesteps=256, normalization=normalization)
    jump = replace(OUTER, episodes=2, **options)
    high = [1000.0, 1001.0]  # returns that the next rollout does not reach

    class Watched(ForecastCallback):
        def _on_rollout_start(self) -> None:
            super()._on_rollout_start()
            if self._iteration == 1:
                self._watch.add(high)

    callback = Watched(forecaster, jump)
    model = learn(config, callback)
    population = Population(config, origins_of(config, [3, 4]))
    jumps = PopulationJumps(population, forecaster, jump, run_info(config))

    def hook(boundary: Any) -> None:
        jumps(boundary)
        if boundary.iteration == 1:
            jumps.learners[0]._watch.add(high)

    population.train(jumps.watchers, hook=hook)
    population.close()
    assert [one.outcome for one in callback.jumps] == outcomes
    assert [one.outcome for one in jumps.jumps[0]] == outcomes
    for one, other in zip(callback.jumps, jumps.jumps[0], strict=True):
        assert one.iteration == other.iteration
        assert one.size == pytest.approx(other.size, rel=1e-3)
    learnt = population.read(0, critic=True)
    agent = find_agent(model)
    for rows, named in (("weights", agent.actor), ("critic", agent.critic)):
        theirs = np.concatenate([p.detach().numpy().ravel() for p in named.values()])
        np.testing.assert_allclose(learnt[rows], theirs, atol=1e-6)


@pytest.mark.parametrize("normalization", ["gymnasium", "vecnormalize", "none"])
def test_a_population_undoes_a_bad_jump_of_one_learner(normalization: Any) -> None:
    """The others' bits stay what they are without its jump."""
    config = replace(SMALL, total_timesteps=192, normalization=normalization)
    population = Population(config, origins_of(config, [3, 4, 5]))
    jump = replace(OUTER, last=1, guard="rollout", episodes=2)
    jumps = PopulationJumps(population, Ahead(3.0), jump, run_info(config), learners=1)
    states: list[Any] = []

    def hook(boundary: Any) -> None:
        if boundary.iteration == 1:
            states.append(population.save(0))
        jumps(boundary)
        jumps.learners[0]._watch.add([1000.0, 1001.0])
        if boundary.iteration == 2:
            states.append(population.save(0))

    population.train(jumps.watchers, hook=hook)
    population.close()
    assert [one.outcome for one in jumps.jumps[0]] == ["undone"]
    path = jumps.learners[0].path
    assert path._run.phase.tolist() == [-1, *[0, 1, 2, 3] * 3]
    assert np.abs(np.diff(path._run.rows, axis=0)).max() < 1
    before, after = states
    assert torch.equal(before.parameters, after.parameters)
    assert before.adam["step"] == 8
    for name in before.adam:
        assert torch.equal(before.adam[name], after.adam[name])
    for norm in ("obs_norm", "ret_norm"):
        old, new = getattr(before, norm), getattr(after, norm)
        assert (old is None) == (normalization == "none")
        for one, other in zip(old or (), new or (), strict=True):
            np.testing.assert_array_equal(one, other)
    plain, _ = trained(config, [3, 4, 5], None)
    np.testing.assert_array_equal(plain[1:], population.stack.values.numpy()[1:])


def test_the_batch_guard_of_a_population_refuses_a_long_jump() -> None:
    plain, _ = trained(SMALL, [3, 4], None)
    guarded, jumps = trained(SMALL, [3, 4], replace(OUTER, guard="batch"), 3.0)
    assert [jump.outcome for jump in jumps.jumps[0]] == ["refused"] * 3
    np.testing.assert_array_equal(plain, guarded)


# ``tipl live``

PLAN = """
id = "small"
rival = "outer"
population = 2
bootstrap = 50
seeds = { tuning = "10:12", test = "20:23" }
evaluation = { every = 1, episodes = 2, smooth = 1 }
tasks.pendulum = { recipe = "recipe.toml", total_timesteps = 256 }
[arms.ppo]
[arms.outer]
forecaster = "last-iteration"
jump = { horizon = 4, first = 1, every = 2 }
grid = { amplitude = [1.0, 2.0] }
[arms.far]
forecaster = "last-iteration"
jump = { horizon = 50, every = 2, guard = "batch" }
"""
SHORT = """
id = "pendulum"
[ppo]
n_steps = 64
batch_size = 16
n_epochs = 2
critic_arch = [8, 8]
[seeds]
train = "0:2"
[store]
every = 2
"""


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    (tmp_path / "recipe.toml").write_text(SHORT)
    (tmp_path / "plan.toml").write_text(PLAN)
    return tmp_path / "plan.toml"


def test_a_study_tunes_tests_and_goes_on_where_it_stopped(
    plan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(plan.parent)
    untuned = LiveConfig(plan=plan, out=plan.parent / "out")
    with pytest.raises(EvaluateError, match="--stage tuning"):
        run_live(untuned)
    run_command("tipl live plan.toml --out out --stage tuning")
    tuned = read_live(plan.parent / "out/tuning/results.json")
    assert len(tuned.series) == 4
    assert tuned.best["pendulum"]["outer"] in ("outer:amplitude=1.0", "outer:amplitude=2.0")
    run_command("tipl live plan.toml --out out --stage test")
    results = read_live(plan.parent / "out/test/results.json")
    assert {one.arm: len(one.curves) for one in results.series} == {"ppo": 3, "outer": 3, "far": 3}
    assert results.series[0].num_timesteps == [0, 64, 128, 192, 256]
    assert results.primary == {"pendulum": "far"}  # the rival is no candidate
    assert results.scores["pendulum"]["ppo"] == pytest.approx(1)
    assert {(f.arm, f.against) for f in results.figures} == {
        *(("outer", "ppo"), ("far", "ppo")),
        *(("ppo", "outer"), ("far", "outer")),
    }
    lines = (plan.parent / "out/test/curves.csv").read_text().splitlines()
    assert len(lines) == 1 + 3 * 3 * 5
    files = {file: file.stat().st_mtime_ns for file in plan.parent.rglob("2*.json")}
    assert len(files) == 3 * 2  # seeds 20 and 21, and 22 alone
    lost, *_ = files
    before = lost.read_bytes()
    lost.unlink()
    again = run_live(untuned)
    assert json.loads(lost.read_bytes())["curves"] == json.loads(before)["curves"]
    assert again.figures == results.figures
    assert {f: f.stat().st_mtime_ns for f in files if f != lost} == {
        file: time for file, time in files.items() if file != lost
    }
    page = plan.parent / "page.md"
    places = [f"out/test/results.json{section}" for section in (", summary", "", ", tables")]
    page.write_text("".join(f"<!-- live of {x} -->\n<!-- end of live -->\n" for x in places))
    run_command("tipl report out/test/results.json --into page.md")
    assert page.read_text().count("\n| ") == 2 + 3 + 2 * 3  # summary, overview, tables
    assert "| **far** | " in page.read_text()  # the best forecast of the tuning
    (line,) = (row for row in page.read_text().splitlines() if "| pendulum (3) | far |" in row)
    figures = {f.against: f.value for f in results.figures if (f.arm, f.name) == ("far", "final")}
    assert line.split(" | ")[-1].startswith(f"{100 * figures['ppo']:+.0f} %")  # the final return
    assert "| outer (amplitude " in page.read_text()
    for name in ("pendulum.svg", "pendulum-ratios.svg"):
        assert f"](out/test/{name})" in page.read_text()
        assert (plan.parent / "out/test" / name).read_text().startswith("\n<!DOCTYPE svg")
    assert "Not run yet" not in page.read_text()
    run_command("tipl live plan.toml --out out --stage test --arms outer")
    assert read_live(plan.parent / "out/test/results.json").figures == results.figures
    (plan.parent / "out/test/pendulum/far/22-22.json").unlink()
    run_command("tipl live plan.toml --out out --stage test --arms outer")
    run_command("tipl report out/test/results.json --into page.md")
    assert "Not run yet: pendulum (1 of 3 arms)." in page.read_text()


def test_two_commands_share_the_work(plan: Path) -> None:
    config = LiveConfig(plan=plan, out=plan.parent / "out", stage="tuning")
    here = config.out / "tuning/pendulum/ppo/10-11.json"
    here.parent.mkdir(parents=True)
    with ThreadPoolExecutor(1) as pool:
        with lock_of(here.with_name(".10-11.json.lock")):  # as another command holds it
            other = pool.submit(run_live, config)
            while len([*config.out.rglob("10-11.json")]) < 3:
                assert not other.done()
                time.sleep(0.05)
            assert not here.exists()
        results = other.result()
    assert here.exists()
    assert len(results.series) == 4
    assert not [*config.out.rglob(".*.lock")]


def test_a_task_that_cannot_be_read_costs_the_others_nothing(plan: Path) -> None:
    gone = '\ntasks.gone = { recipe = "gone.toml" }\n[arms.ppo]'
    plan.write_text(PLAN.replace("\n[arms.ppo]", gone))
    config = LiveConfig(plan=plan, out=plan.parent / "out", stage="tuning")
    results = run_live(replace(config, tasks=("pendulum",), arms=("far",)))
    assert [one.arm for one in results.series] == ["ppo", "far"]
    with pytest.raises(FileNotFoundError, match="gone"):
        run_live(config)


@pytest.mark.long
def test_processes_make_the_same_curves(plan: Path) -> None:
    stage = {"plan": plan, "stage": "tuning"}
    one = run_live(LiveConfig(**stage, out=plan.parent / "one"))  # type: ignore[arg-type]
    two = run_live(LiveConfig(**stage, out=plan.parent / "two", workers=2))  # type: ignore[arg-type]
    assert [x.curves for x in one.series] == [x.curves for x in two.series]


def test_a_bad_jump_is_undone_after_the_last_iteration_too() -> None:
    before: dict[str, np.ndarray] = {}

    class Bad(ForecastCallback):
        def _on_rollout_start(self) -> None:
            before.update(parameters(self.model))
            super()._on_rollout_start()
            self._watch.add([1000.0, 1001.0])

    config = replace(SMALL, total_timesteps=128)
    callback = Bad(Ahead(3.0), replace(OUTER, guard="rollout", episodes=2))
    model = learn(config, callback)
    assert [jump.outcome for jump in callback.jumps] == ["undone"]
    for name, values in parameters(model).items():
        np.testing.assert_array_equal(before[name], values)


def test_a_second_call_of_learn_continues_the_path() -> None:
    """Its first iteration is one of its own, and no jump of the first call is taken back."""
    callback = ForecastCallback(Ahead(0.001), replace(OUTER, guard="rollout", episodes=2))
    model = learn(replace(SMALL, total_timesteps=128), callback)
    callback._watch.add([1000.0, 1001.0])
    before = parameters(model)
    seen: list[dict[str, np.ndarray]] = []

    class Seen(BaseCallback):
        def _on_rollout_end(self) -> None:
            seen.append(parameters(self.model))  # type: ignore[arg-type]

        def _on_step(self) -> bool:
            return True

    model.learn(128, callback=[callback, Seen()], reset_num_timesteps=False)
    for name, values in before.items():
        np.testing.assert_array_equal(seen[0][name], values)
    path = callback._path
    assert path is not None
    assert path._run.phase.tolist() == [-1, *[0, 1, 2, 3] * 4]
    first, later = callback.jumps
    assert (first.iteration, first.outcome, later.iteration) == (1, "accepted", 3)


def test_the_rollout_guard_needs_the_returns_of_episodes() -> None:
    env = DummyVecEnv([lambda: gym.make("InvertedPendulum-v4")])
    settings: Any = {"n_steps": 64, "batch_size": 16, "n_epochs": 1, "device": "cpu"}
    callback = ForecastCallback("last-iteration", replace(OUTER, guard="rollout"))
    with pytest.raises(ForecastError, match="Monitor"):
        PPO("MlpPolicy", env, **settings).learn(128, callback=callback)
    PPO("MlpPolicy", env, **settings).learn(128, callback=ForecastCallback("last-step", OUTER))


def test_episodes_that_a_wrapper_ends_are_no_reason_to_refuse() -> None:
    class Half(gym.Wrapper[Any, Any, Any, Any]):
        """Ends an episode outside the Monitor, as Atari's wrapper does when a life is lost."""

        steps = 0

        def step(self, action: Any) -> Any:
            self.steps += 1
            seen, reward, done, late, info = self.env.step(action)
            return seen, reward, done or self.steps % 3 == 0, late, info

    env = make_vec_env("InvertedPendulum-v4", wrapper_class=Half)
    settings: Any = {"n_steps": 64, "batch_size": 16, "n_epochs": 2, "device": "cpu"}
    callback = ForecastCallback("last-iteration", replace(OUTER, guard="rollout"))
    PPO("MlpPolicy", env, **settings).learn(128, callback=callback)
    assert len(callback.jumps) == 1


def test_a_training_that_failed_is_continued_with_a_new_iteration() -> None:
    class Fails(ForecastCallback):
        def _on_gradient_step(self, *details: object) -> None:
            super()._on_gradient_step(*details)
            if self._iteration == 2 and len(cast(Any, self._path)._run) == 7:
                raise KeyboardInterrupt

    callback = Fails(Ahead(0.001), replace(OUTER, guard="rollout", episodes=2))
    model = make_ppo(SMALL, seed=3)
    with pytest.raises(KeyboardInterrupt):
        model.learn(256, callback=callback)
    model.learn(64, callback=callback, reset_num_timesteps=False)
    path = cast(Any, callback._path)
    assert path._run.phase.tolist() == [-1, 0, 1, 2, 3, 0, 1, 0, 1, 2, 3]


def test_horizons_and_cadence_of_a_stretched_forecaster_are_its_own() -> None:
    for name in ("ar-20-phase", "tipl-gate", "tipl-causal"):
        along = tipl.load(f"{name}-inverted-pendulum-v4")
        stretched = Stretched(along, {1: 2.0})
        assert known_horizons(stretched) == known_horizons(along) is not None
        assert known_every(stretched) == known_every(along)
    assert known_every(tipl.load("tipl-drift-inverted-pendulum-v4")) == 64
    assert known_horizons(tipl.load("last-step")) is None


def test_a_test_needs_the_tuning_of_its_own_plan(plan: Path) -> None:
    config = LiveConfig(plan=plan, out=plan.parent / "out", stage="tuning")
    run_live(config)
    plan.write_text(PLAN.replace("first = 1", "first = 2"))
    with pytest.raises(EvaluateError, match="or the plan was changed since"):
        run_live(replace(config, stage="test"))
    plan.write_text(PLAN)
    results = run_live(replace(config, stage="test", tasks=("pendulum",)))
    assert len(results.series) == 3


def test_trainings_with_another_forecaster_are_made_again(
    plan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder whose model has changed since, not a name alone."""
    monkeypatch.chdir(plan.parent)
    plan.write_text(
        PLAN.replace('"last-iteration"\njump = { horizon = 50', '"m"\njump = { horizon = 50')
    )
    config = LiveConfig(plan=plan, out=plan.parent / "out", stage="tuning")
    for decay in (0.9, 0.95):
        tipl.load(f"ema-{decay}").save("m")
        if decay == 0.95:  # trainings with the old model count no more, whatever is asked for
            assert [x.arm for x in run_live(replace(config, arms=("ppo",))).series] == [
                *("ppo", "outer", "outer"),
            ]
        run_live(config)
        made = json.loads((config.out / "tuning/pendulum/far/10-11.json").read_bytes())
        assert made["fingerprint"] == fingerprint(tipl.load("m"))
    shutil.rmtree("m")
    assert len(run_live(config).series) == 4  # all is there: no forecaster is needed


def test_a_damaged_file_of_trainings_is_refused(plan: Path) -> None:
    config = LiveConfig(plan=plan, out=plan.parent / "out", stage="tuning", arms=("ppo",))
    run_live(config)
    file = config.out / "tuning/pendulum/ppo/10-11.json"
    good = file.read_bytes()
    for bad in (good[:-20], good.replace(b'"seed":10', b'"seed":11')):
        file.write_bytes(bad)
        with pytest.raises(EvaluateError, match="damaged"):
            run_live(config)
    file.write_bytes(good)
    run_live(config)


def test_a_task_without_batched_physics_is_refused(plan: Path) -> None:
    recipe = plan.parent / "recipe.toml"
    recipe.write_text(SHORT.replace("[ppo]", '[ppo]\nenv_id = "Pendulum-v1"'))
    with pytest.raises(EvaluateError, match="planar MuJoCo"):
        run_live(LiveConfig(plan=plan, out=plan.parent / "out", stage="tuning"))


@pytest.mark.parametrize(
    ("names", "told"),
    [({"tasks": ("ppo",)}, "no such task"), ({"arms": ("pendulum",)}, "no such arm")],
)
def test_tasks_and_arms_that_the_plan_lacks_are_refused(
    plan: Path, names: dict[str, Any], told: str
) -> None:
    with pytest.raises(EvaluateError, match=told):
        run_live(LiveConfig(plan=plan, out=plan.parent / "out", **names))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('rival = "outer"', 'rival = "none"', "no arm 'none'"),
        ('"20:23"', '"20:23,22:24"', "seeds \\[22\\] stand twice"),
        ("[arms.ppo]", "[arms.ppo]\ngrid = { amplitude = [1.0] }", "without a grid"),
        ("[1.0, 2.0]", "[1.0, 1.0]", "no value, or one twice"),
        ("[1.0, 2.0]", "[]", "no value, or one twice"),
        ("[arms.far]", '[arms."../far"]', "a name has letters"),
        ('guard = "batch" }', 'guard = "batch" }\nlearning_rate = -1.0', "learning rate"),
        ("bootstrap = 50", "bootstrap = 0", "bootstrap is at least 1"),
        ('"20:23"', '"11:23"', "for tuning and for the test"),
        ("horizon = 4", "horison = 4", "no settings"),
        ("horizon = 4", "horizon = 0", "horizon of at least 1"),
        ("population = 2", "popolation = 2", "popolation"),
    ],
)
def test_an_invalid_plan_is_refused(plan: Path, old: str, new: str, told: str) -> None:
    plan.write_text(PLAN.replace(old, new))
    with pytest.raises(EvaluateError, match=told):
        read_plan(plan)


@pytest.mark.parametrize(("study", "trials_each"), [("live", 6), ("confirm", 9)])
def test_a_published_plan_can_be_read(study: str, trials_each: int) -> None:
    plan = read_plan(ROOT / f"docs/studies/{study}.toml")
    for task in plan.tasks:
        trials = plan.trials(task)
        assert {len(some) for name, some in trials.items() if name != "ppo"} == {trials_each}
        ppo, every = ppo_of(plan, task, ROOT / "docs/studies")
        assert ppo.gradient_steps_per_iteration // every == 5


def line(arm: str, *runs: list[float]) -> Series:
    """Trainings that were evaluated after 0, 100, 200, ... steps."""
    return Series(
        task="pendulum",
        arm=arm,
        trial=arm,
        settings={},
        num_timesteps=[100 * i for i in range(len(runs[0]))],
        curves=[Curve(seed=i, returns=list(run)) for i, run in enumerate(runs)],
        cpu=Cpu(training=1, forecasts=0, evaluation=0),
    )


def test_steps_to_a_return_are_interpolated_paired_and_censored(plan: Path) -> None:
    study = read_plan(plan)
    slow, fast = [0.0, 10, 20, 30, 40], [0.0, 20, 40, 40, 40]
    mine, others = line("far", fast, fast, [0.0] * 5), line("ppo", slow, slow, slow)
    evaluation = study.evaluation_of("pendulum")
    limits = thresholds_of(study, others)
    assert limits == pytest.approx({"50": 20, "75": 30, "90": 36, "95": 38})
    steps, censored = steps_to(mine, limits["75"], evaluation)
    np.testing.assert_allclose(steps, [150, 150, 400])
    assert censored == 1
    found = {figure.name: figure for figure in compare(study, mine, others, limits)}
    ratio = found["steps to 75 %"]
    assert ratio.value == pytest.approx((0.5 * 0.5 * 4 / 3) ** (1 / 3))
    assert (ratio.censored, ratio.censored_against) == (1, 0)
    assert found["worst decile"].value == pytest.approx(-1)
    assert mean_log_ratio(study, line("far", fast), line("ppo", slow), limits) < 0


def test_final_returns_the_worst_tenth_and_the_score_are_as_defined(plan: Path) -> None:
    evaluation = replace_struct(read_plan(plan).evaluation, last=0.1)
    rising = line("far", [float(i) for i in range(20)], [10.0] * 20)
    assert final_returns(rising, evaluation).tolist() == [18.5, 10.0]  # the last 2 of 20
    study = read_plan(plan)
    mine = line("far", *([float(i)] * 5 for i in range(1, 21)))
    others = line("ppo", *([10.0] * 5 for _ in range(20)))
    found = {figure.name: figure for figure in compare(study, mine, others, {"50": 5.0})}
    assert found["worst decile"].value == pytest.approx((1.5 - 10) / 10)  # 2 of 20 runs
    never, late = [0.0] * 5, [0.0, 0, 0, 0, 10]
    pair = line("far", never, late), line("ppo", late, never)
    expected = np.log([2 * 400 / 350, 350 / (2 * 400)]).mean()
    smooth = replace_struct(study, evaluation=replace_struct(study.evaluation, smooth=1))
    assert mean_log_ratio(smooth, *pair, {"50": 5.0}) == pytest.approx(expected)
    assert mean_log_ratio(smooth, pair[0], pair[0], {"50": 5.0}) == 0


def test_the_mean_of_several_evaluations_must_reach_a_threshold(plan: Path) -> None:
    evaluation = replace_struct(read_plan(plan).evaluation, smooth=3)
    # Means of three: 0, 3, 2, 4, 8. From 2 at 200 to 4 at 300 steps: 3.5 at 275.
    steps, censored = steps_to(line("far", [0.0, 6, 0, 6, 18]), 3.5, evaluation)
    assert (steps.tolist(), censored) == ([275.0], 0)


def test_an_average_of_iterations_follows_whole_iterations() -> None:
    run = GrowingRun(run_info())
    size = run.layout.size
    place = np.zeros(size, np.float32)
    for t in range(13):  # iterations of 4 snapshots with steps 1, 2 and 4
        place = place + np.float32(0 if t == 0 else 2 ** ((t - 1) // 4))
        index = {"num_timesteps": t, "iteration": 0, "gradient_step": t, "learning_rate": 1}
        run.append(place, phase=(t - 1) % 4 if t else -1, **index)
    last, average = (
        IterationAverage(beta).forecast(run, [12], [4, 8])[0, :, 0] - place[0]
        for beta in (0.0, 0.5)
    )
    assert last.tolist() == [16, 32]
    np.testing.assert_allclose(average, np.array([4, 8]) * (4 + 2 / 2 + 1 / 4) / 1.75)
