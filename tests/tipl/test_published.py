"""Published ways to go on, on paths whose right continuation is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from tipl.checks.copies import run_like
from tipl.errors import ForecastError
from tipl.models.baselines.data import Trajectory
from tipl.models.baselines.features import Features
from tipl.models.baselines.naive import Extrapolation
from tipl.models.baselines.published import (
    LastIteration,
    LeadingDirections,
    Lines,
    Relex,
    iteration_length,
    leading,
)
from tipl.models.baselines.reconstruction import PathOracle
from tipl.registry import load

P = 122
ALL = [LastIteration(), Lines(), Relex(), LeadingDirections()]


@pytest.fixture(scope="module")
def template(small_dataset: Path) -> wt.Run:
    """Four snapshots an iteration."""
    return wt.open(small_dataset).split("train").runs[0]


def velocity(features: Features, run: wt.Run, start: int) -> np.ndarray:
    ((_, _, (found,)),) = features(Trajectory.of(run), [start])
    return found


@pytest.mark.parametrize("features", ALL, ids=lambda features: features.name)
def test_a_straight_line_is_forecast_exactly(
    features: Features, template: wt.Run, tmp_path: Path
) -> None:
    direction = np.random.default_rng(0).normal(size=P)
    run = run_like(template, 1e-2 * np.arange(80)[:, None] * direction, tmp_path)
    forecast = Extrapolation(features).forecast(run, [5, 40], [1, 10])
    expected = run.weights[:][[[6, 15], [41, 50]]]
    assert np.allclose(forecast, expected, atol=1e-4)
    assert not velocity(features, run, 0).any()


@pytest.mark.parametrize("features", ALL, ids=lambda features: features.name)
def test_only_the_past_counts(features: Features, template: wt.Run, tmp_path: Path) -> None:
    steps = np.random.default_rng(1).normal(size=(80, P))
    one = run_like(template, 1e-2 * steps.cumsum(0), tmp_path / "one")
    steps[41:] *= -3
    other = run_like(template, 1e-2 * steps.cumsum(0), tmp_path / "other")
    assert np.array_equal(velocity(features, one, 40), velocity(features, other, 40))


def test_the_last_iteration_is_that_of_four_snapshots(template: wt.Run, tmp_path: Path) -> None:
    rows = 1e-2 * np.random.default_rng(2).normal(size=(40, P)).cumsum(0)
    run = run_like(template, rows, tmp_path)
    weights = run.weights[:].astype(float)
    assert iteration_length(Trajectory.of(run), 20) == 4
    assert np.allclose(velocity(LastIteration(), run, 20), (weights[20] - weights[16]) / 4)
    assert np.allclose(velocity(LastIteration(), run, 2), (weights[2] - weights[0]) / 2)


def test_a_weight_follows_its_line_only_where_one_fits(template: wt.Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    rows = np.zeros((60, P))
    rows[:, :60] = 1e-2 * np.arange(60)[:, None]  # lines
    rows[:, 60:] = rng.choice([-1.0, 1.0], size=(60, P - 60))  # noise
    found = velocity(Lines(window=50, least=0.7), run_like(template, rows, tmp_path), 59)
    assert np.allclose(found[:60], 1e-2, rtol=1e-3)
    assert not found[60:].any()


def test_relex_has_one_direction_for_each_tensor(template: wt.Run, tmp_path: Path) -> None:
    rows = np.random.default_rng(4).normal(size=(60, P)).cumsum(0)
    run = run_like(template, rows, tmp_path)
    found, weights = velocity(Relex(window=20), run, 50), run.weights[31:51].astype(float)
    for param in run.layout.params:
        deltas = (weights - weights[0])[:, param.slice]
        direction = np.linalg.svd(deltas, full_matrices=False)[2][0]
        slope = np.polyfit(np.arange(20), deltas @ direction, 1)[0]
        assert np.allclose(found[param.slice], slope * direction)


def test_leading_directions_are_those_of_an_svd() -> None:
    rows = np.random.default_rng(5).normal(size=(6, 30))
    ours, numpys = leading(rows, 3), np.linalg.svd(rows)[2][:3]
    assert np.allclose(np.abs((ours * numpys).sum(1)), 1)
    assert not leading(np.outer([1.0, 2, 3], np.ones(30)), 2)[1].any()  # rank 1


def test_minor_directions_are_trimmed(template: wt.Run, tmp_path: Path) -> None:
    major, minor = np.linalg.qr(np.random.default_rng(6).normal(size=(P, 2)))[0].T
    time = np.arange(60)[:, None]
    rows = time * major + 0.1 * np.sin(time) * minor
    found = velocity(LeadingDirections(window=50, rank=1), run_like(template, rows, tmp_path), 59)
    assert found @ major == pytest.approx(1, abs=1e-2)
    assert abs(found @ minor) < 2e-3


@pytest.mark.parametrize("name", ["last-iteration", "lines-50", "relex-50", "pptb-4"])
def test_rivals_have_names_and_can_be_saved(name: str, template: wt.Run, tmp_path: Path) -> None:
    rival = load(name)
    rival.save(tmp_path / name)
    expected = rival.forecast(template, [20], [1, 5])
    assert np.array_equal(load(tmp_path / name).forecast(template, [20], [1, 5]), expected)


def test_the_path_oracle_knows_what_lies_in_the_directions_of_the_path(
    template: wt.Run, tmp_path: Path
) -> None:
    along, aside = np.linalg.qr(np.random.default_rng(0).normal(size=(P, 2)))[0].T
    time = np.arange(80)[:, None]
    path = 1e-2 * time * along + np.maximum(0, time - 40) * aside  # it turns after snapshot 40
    run = run_like(template, path, tmp_path)
    oracle = PathOracle()
    assert oracle.is_oracle
    moved = oracle.forecast(run, [40, 60], [10])[:, 0] - run.weights[[40, 60]]
    np.testing.assert_allclose(moved[0], 0.1 * along, atol=1e-4)
    np.testing.assert_allclose(moved[1], 0.1 * along + 10 * aside, atol=1e-4)
    with pytest.raises(ForecastError, match="the run ends before"):
        oracle.forecast(run, [79], [1])
