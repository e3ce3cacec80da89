"""Jumps in real trainings: what they change, and what they leave alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

import tipl
import weighttraj as wt
from tests.small import CONFIGS, SMALL, learn, random_states
from tipl.errors import ForecastError
from tipl.forecaster import Forecaster
from tipl.live import ForecastCallback, IterationAverage, Jump, JumpConfig, PopulationJumps
from tipl.live.guards import ReturnWatch, passes_batch
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.collect.agents import find_agent
from weighttraj.collect.describe import describe_run
from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.population import Population, origins_of
from weighttraj.collect.settings import Store

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
    for wrong in ({"horizon": 0}, {"period": 0}, {"schedule": ()}, {"schedule": ((1, 0),)}):
        with pytest.raises(ForecastError, match="expected"):
            JumpConfig(**wrong)  # type: ignore[arg-type]


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


def test_a_population_jumps_as_sb3_does() -> None:
    """The same outer steps from the same seed, up to the rounding of float32."""
    config = replace(SMALL, total_timesteps=192)
    callback = ForecastCallback(IterationAverage(0.0), OUTER)
    model = learn(config, callback)
    _, jumps = trained(config, [3, 4], OUTER)
    for one, other in zip(callback.jumps, jumps.jumps[0], strict=True):
        assert one.iteration == other.iteration
        assert one.size == pytest.approx(other.size, rel=1e-3)
    assert model.num_timesteps == 192


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
    before, after = states
    assert torch.equal(before.parameters, after.parameters)
    for name in before.moments:
        assert torch.equal(before.moments[name], after.moments[name])
    if before.obs_norm is not None:
        np.testing.assert_array_equal(before.obs_norm[0], after.obs_norm[0])
    plain, _ = trained(config, [3, 4, 5], None)
    np.testing.assert_array_equal(plain[1:], population.stack.values.numpy()[1:])


def test_the_batch_guard_of_a_population_refuses_a_long_jump() -> None:
    plain, _ = trained(SMALL, [3, 4], None)
    guarded, jumps = trained(SMALL, [3, 4], replace(OUTER, guard="batch"), 3.0)
    assert [jump.outcome for jump in jumps.jumps[0]] == ["refused"] * 3
    np.testing.assert_array_equal(plain, guarded)
