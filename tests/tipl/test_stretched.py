from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from tests.tipl.lively import HORIZONS, lively_gate
from tipl.checks.copies import RefitConfig, random_walks
from tipl.checks.model import refit_of
from tipl.errors import EvaluateError, ForecastError, ModelError, TrainError
from tipl.evaluation.returns import Player
from tipl.evaluation.starts import learning_phase
from tipl.models.stretched import Stretched, StretchedGate, StretchedTrainConfig, train_stretched
from tipl.models.stretched.train import gains_of
from tipl.registry import load
from weighttraj.policies import load_policies
from weighttraj.store.catalog import read_dataset_info, write_dataset_info

AMPLITUDES = {1: 4.0, 2: 2.0, 5: 1.5}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three released runs, which learn: two for validation, one for tests."""
    path = tmp_path_factory.mktemp("drift") / "data"
    (path / "runs").mkdir(parents=True)
    released = wt.open_dataset("inverted-pendulum-v4-ppo-v1").path
    info = read_dataset_info(released)
    runs = tuple(run for run in info.runs if run.seed in (30, 31, 40))
    for run in runs:
        shutil.copy(released / run.path, path / run.path)
    write_dataset_info(path, replace(info, runs=runs))
    return path


@pytest.fixture(scope="module")
def config(data: Path) -> StretchedTrainConfig:
    lively_gate(64).save(data.with_name("gate"))
    return StretchedTrainConfig(
        along=data.with_name("gate"), data=data, out=data.with_name("model"), horizons=(1, 5),
        amplitudes=(0.5, 1, 8), starts=3, episodes=5,
    )  # fmt: skip


@pytest.fixture(scope="module")
def trained(config: StretchedTrainConfig) -> StretchedGate:
    return train_stretched(config)


@pytest.fixture(scope="module")
def short(small_dataset: Path) -> wt.Run:
    """One of few snapshots."""
    return wt.open_dataset(small_dataset).split("test").runs[0]


@pytest.fixture(scope="module")
def run(data: Path) -> wt.Run:
    return wt.open_dataset(data).split("test").runs[0]


# The forecaster


def test_it_goes_further_along_the_gates_way(run: wt.Run) -> None:
    gate, starts, horizons = lively_gate(64), [3, 30], [5, 1]
    now = run.weights[starts][:, None].astype(np.float64)
    short = gate.forecast(run, starts, horizons) - now
    long = StretchedGate(gate, AMPLITUDES).forecast(run, starts, horizons) - now
    factors = np.array([[1.5], [4.0]]) * np.ones(run.layout.size)
    factors[:, run.layout["log_std"].slice] = 1  # the noise moves as the gate says
    np.testing.assert_allclose(long, factors * short, atol=1e-6)
    assert np.abs(short).max() > 1e-4


def test_a_horizon_without_amplitude_is_refused(run: wt.Run) -> None:
    with pytest.raises(ForecastError, match="not fitted for this horizon"):
        StretchedGate(lively_gate(64), {1: 2.0}).forecast(run, [3], [5])


def test_it_is_saved_and_loaded(run: wt.Run, tmp_path: Path) -> None:
    drift = StretchedGate(lively_gate(64), AMPLITUDES)
    drift.save(tmp_path / "copy")
    again = load(tmp_path / "copy")
    assert again.name == "copy"
    request = (run, [3, 30], [5, 1])
    assert np.array_equal(again.forecast(*request), drift.forecast(*request))
    file = tmp_path / "copy/config.json"
    file.write_text(file.read_text().replace('"5": 1.5', '"7": 1.5'))
    with pytest.raises(ModelError, match="amplitudes of horizons"):
        StretchedGate.load(tmp_path / "copy")


def test_it_is_fitted_to_walks_with_its_amplitudes(short: wt.Run, tmp_path: Path) -> None:
    config = RefitConfig(folder=tmp_path, horizons=(1, 5, 9), batches=5)
    fit = refit_of(StretchedGate(lively_gate(64), AMPLITUDES), config)
    assert fit is not None
    again = fit(random_walks(short, tmp_path, count=4))
    assert isinstance(again, StretchedGate)
    assert again.amplitudes == {1: 4.0, 5: 1.5}


# Along other forecasters


def test_any_other_forecast_is_followed_too(run: wt.Run, tmp_path: Path) -> None:
    slope, starts, horizons = load("trend-5"), [9, 30], [1, 5, 25]
    now = run.weights[starts][:, None].astype(np.float64)
    rival = Stretched(slope, {1: 4.0, 25: 2.0})
    between = 3.0  # 5 lies half-way between 1 and 25 in log h
    factors = np.array([[4.0], [between], [2.0]]) * np.ones(run.layout.size)
    factors[:, run.layout["log_std"].slice] = 1
    expected = factors * (slope.forecast(run, starts, horizons) - now)
    np.testing.assert_allclose(rival.forecast(run, starts, horizons) - now, expected, atol=1e-6)
    assert np.abs(expected).max() > 1e-3
    rival.save(tmp_path / "rival")
    again = load(tmp_path / "rival")
    assert (again.name, again.causal) == ("rival", True)
    assert np.array_equal(
        again.forecast(run, starts, horizons), rival.forecast(run, starts, horizons)
    )
    file = tmp_path / "rival/config.json"
    file.write_text(file.read_text().replace('"25": 2.0', '"soon": 2.0'))
    with pytest.raises(ModelError, match="not of horizons"):
        load(tmp_path / "rival")


def test_how_far_a_rival_goes_is_chosen_as_for_the_gate(config: StretchedTrainConfig) -> None:
    name = "trend-5"
    rival = train_stretched(replace(config, along=name, out=config.out.with_name("rival")))
    assert isinstance(rival, Stretched)
    lines = (config.out.with_name("rival") / "log.jsonl").read_text().splitlines()
    best = max(map(json.loads, lines), key=lambda line: line["gain_5"])
    assert rival.amplitudes[5] == best["amplitude"]
    assert load(config.out.with_name("rival")).name == "rival"
    with pytest.raises(ForecastError, match="no such forecaster"):
        train_stretched(replace(config, along="tomorrow", out=config.out.with_name("none")))


# The choice


def test_amplitudes_are_those_of_the_highest_gain(
    trained: StretchedGate, config: StretchedTrainConfig, data: Path
) -> None:
    lines = [json.loads(line) for line in (config.out / "log.jsonl").read_text().splitlines()]
    assert [line["amplitude"] for line in lines] == [0.5, 1, 8]
    for h in (1, 5):
        best = max(lines, key=lambda line: line[f"gain_{h}"])
        assert trained.amplitudes[h] == best["amplitude"]
    inside = sorted(trained.amplitudes[h] for h in (1, 5))
    assert inside[0] <= trained.amplitudes[2] <= inside[1]
    # One number of the log, computed the long way.
    added = by_training = 0.0
    for run in wt.open_dataset(data):
        if run.split != "validation":
            continue
        end = min(learning_phase(run), len(run) - 1 - 5 - 1)
        starts = np.linspace(min(10, end // 4), end, 5)[1:-1].round().astype(int)
        drift = StretchedGate(lively_gate(64), dict.fromkeys(HORIZONS, 8.0))
        forecast = drift.forecast(run, starts.tolist(), [5])[:, 0]
        with Player(run, 5, 0, modes=("held",)) as player:
            (now,) = player.returns(load_policies(run, starts), starts)
            (later,) = player.returns(load_policies(run, starts + 5), starts)
            policies = load_policies(run, starts).with_weights(forecast)
            (reached,) = player.returns(policies, starts)
        added, by_training = added + (reached - now).sum(), by_training + (later - now).sum()
    assert lines[2]["gain_5"] == pytest.approx(added / by_training)


def test_a_run_that_gains_more_counts_more() -> None:
    one = {"forecast": np.array([[10.0], [0.0]]), "training": np.array([10.0])}
    other = {"forecast": np.array([[-10.0], [45.0]]), "training": np.array([90.0])}
    np.testing.assert_allclose(gains_of([one, other]), [[0.0], [0.45]])


def test_what_was_measured_is_not_measured_again(
    trained: StretchedGate, config: StretchedTrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("tipl.models.stretched.train._measure", never)
    assert train_stretched(config).amplitudes == trained.amplitudes
    with pytest.raises(TrainError, match="other settings"):
        train_stretched(replace(config, episodes=6))


def test_what_it_needs_is_said(
    config: StretchedTrainConfig, small_dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(TrainError, match="runs in the validation split"):
        train_stretched(replace(config, data=small_dataset, out=tmp_path / "a"))
    with pytest.raises(TrainError, match="factors above 0"):
        train_stretched(replace(config, amplitudes=(0, 1), out=tmp_path / "b"))
    with pytest.raises(ForecastError, match="not fitted for this horizon"):
        train_stretched(replace(config, horizons=(3,), out=tmp_path / "c"))
    still = {"forecast": np.ones((2, 1)), "training": np.zeros(1)}
    with pytest.raises(TrainError, match="training adds nothing"):
        gains_of([still])
    bare = tmp_path / "bare"
    shutil.copytree(small_dataset, bare)
    info = read_dataset_info(bare)
    runs = [replace(run, split="validation") for run in info.runs]
    write_dataset_info(bare, replace(info, runs=tuple(runs)))
    with pytest.raises(EvaluateError, match="weighttraj returns"):
        train_stretched(replace(config, data=bare, out=tmp_path / "d"))
