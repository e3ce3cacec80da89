from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from tests.tipl.lively import HORIZONS as SOME
from tests.tipl.lively import lively_causal, lively_gate
from tipl import TIPL, Persistence, Reconstruction
from tipl.checks.copies import RefitConfig, random_symmetry, random_walks, run_like
from tipl.checks.measures import (
    Fit,
    causality,
    check,
    drift,
    equivariance,
    scale,
    skills,
)
from tipl.checks.model import refit_of
from tipl.checks.results import NULL, TOLERANCE
from tipl.forecaster import Forecaster
from tipl.models.baselines import (
    DMD,
    WNN,
    Ema,
    EndPoints,
    Extrapolation,
    ModeSteps,
    NinoMLP,
    ProjectedSteps,
    Regression,
    Slope,
    Steps,
)
from tipl.models.baselines.nowcaster import LOOP
from tipl.models.stretched import StretchedGate
from tipl.models.tipl import TIPLConfig
from tipl.models.tipl.network import GPT, GPTConfig
from weighttraj.policies import load_policies

HORIZONS = (1, 2, 5, 10)
STEPS = 60
BRIEFLY = replace(LOOP, n_batches=STEPS, batch_size=1024)


def regression(features: object, by_phase: bool = False) -> Fit:
    return partial(Regression.fit, features=features, by_phase=by_phase, horizons=HORIZONS)


def network(kind: type[WNN] | type[NinoMLP]) -> Fit:
    return partial(kind.fit, horizons=HORIZONS, training=BRIEFLY)


# What needs no fit, and which tests it fails.
NAIVE = [
    (Persistence(), {"drift"}),
    (DMD(), set()),
    *((Extrapolation(v), {"null"}) for v in (Steps(1), Slope(5), Slope(200), Ema(0.95))),
]
# A fit, and which tests what it gives fails. Every fit shrinks: real runs are no lines.
FITTED = [
    (regression(Steps(1)), {"drift"}),
    (regression(Ema(0.95)), {"drift"}),
    (regression(Steps(20)), {"drift"}),
    (regression(Steps(20), by_phase=True), {"drift"}),
    (regression(ProjectedSteps()), {"drift"}),
    (regression(ModeSteps()), {"drift"}),
    (regression(EndPoints()), {"drift", "scale", "sign"}),
    (network(WNN), {"drift", "sign"}),
    (network(NinoMLP), {"drift", "scale", "sign"}),
]


def label(value: object) -> str:
    """What a test is called."""
    if isinstance(value, set):
        return f"fails {' '.join(sorted(value)) or 'none'}"
    if isinstance(value, partial):
        features = value.keywords.get("features", value.func.__self__)
        return features.name + "-phase" * value.keywords.get("by_phase", False)
    return value.name


@pytest.fixture(scope="module")
def runs(small_dataset: Path) -> list[wt.Run]:
    return wt.open(small_dataset).split("train").runs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One for all: runs that are there already are not written again."""
    return tmp_path_factory.mktemp("checks")


@pytest.mark.parametrize(("forecaster", "fails"), NAIVE, ids=label)
def test_baselines_without_a_fit(
    forecaster: object, fails: set[str], runs: list[wt.Run], folder: Path
) -> None:
    found = check(forecaster, runs[0], folder, horizons=HORIZONS)
    assert {name for name, passed in found.passed.items() if not passed} == fails, found


@pytest.mark.parametrize(("fit", "fails"), FITTED, ids=label)
def test_baselines_with_a_fit(fit: Fit, fails: set[str], runs: list[wt.Run], folder: Path) -> None:
    fitted = fit(runs)
    refit = refit_of(fitted, RefitConfig(folder=folder, horizons=HORIZONS, batches=STEPS))
    found = check(fitted, runs[0], folder, fit=refit, horizons=HORIZONS)
    assert {name for name, passed in found.passed.items() if not passed} == fails, found


NETWORKS = [lively_gate(), lively_causal(), StretchedGate(lively_gate(), {1: 4.0, 2: 2.0, 5: 1.5})]


@pytest.mark.parametrize("forecaster", NETWORKS, ids=label)
def test_networks(forecaster: Forecaster, runs: list[wt.Run], tmp_path: Path) -> None:
    """But for random walks, for which they are trained, in tests of their own."""
    where = (forecaster, runs[0], tmp_path)
    assert causality(*where, 20, SOME)
    for symmetry in ("permutation", "sign"):
        assert equivariance(*where, [9, 40], SOME, symmetry=symmetry) < TOLERANCE
    assert scale(*where, [9, 40], SOME) < TOLERANCE


def test_what_has_no_fit_is_not_refitted(folder: Path) -> None:
    config = RefitConfig(folder=folder, horizons=HORIZONS)
    for forecaster in (Persistence(), Extrapolation(Steps(1)), DMD(), Reconstruction(3)):
        assert refit_of(forecaster, config) is None


def test_a_refit_is_of_the_same_kind_and_sizes(
    runs: list[wt.Run], folder: Path, tmp_path: Path
) -> None:
    gpt = GPTConfig(rank=3, max_timestep=48, block_size=4, n_layer=2, n_head=2, n_embd=8)
    old = TIPL(GPT(gpt), TIPLConfig(gpt=gpt, every=2))
    config = RefitConfig(folder=tmp_path, horizons=(1,), batches=3)
    walks = random_walks(runs[0], folder, count=2)
    fit = refit_of(old, config)
    assert fit is not None
    found = fit(walks)
    assert isinstance(found, TIPL)
    assert found.config == replace(old.config, gpt=replace(gpt, max_timestep=299), parameters=122)
    trained = [run.weights[:] for run in wt.open(tmp_path / "walks").split("train")]
    assert all(np.array_equal(a, b.weights[:]) for a, b in zip(trained, walks, strict=True))
    assert np.isfinite(skills(found, walks[:1], [1])).all()

    by_phase = Regression.fit(runs, Ema(0.9), by_phase=True, horizons=(1, 5))
    again = refit_of(by_phase, config)
    assert again is not None
    other = again(walks)
    assert isinstance(other, Regression)
    assert (other.name, other.horizons) == (by_phase.name, (1,))
    assert not np.array_equal(other.coefficients, by_phase.coefficients[:, :1])


def test_the_null_sees_a_forecaster_that_knows_the_future(runs: list[wt.Run], folder: Path) -> None:
    walk = random_walks(runs[0], folder, count=1)
    assert skills(Persistence(), walk, [1, 20]).tolist() == [0, 0]
    assert skills(Reconstruction(20), walk, [20])[0] > 10 * NULL


def test_causality_sees_a_look_ahead(runs: list[wt.Run], folder: Path) -> None:
    class Ahead(Persistence):
        def forecast(self, run: wt.Run, starts: list[int], horizons: list[int]) -> np.ndarray:
            after = np.minimum(np.asarray(starts) + 1, len(run) - 1)
            return np.repeat(run.weights[after][:, None], len(horizons), axis=1)

    class Length(Persistence):
        def forecast(self, run: wt.Run, starts: list[int], horizons: list[int]) -> np.ndarray:
            return super().forecast(run, starts, horizons) + np.float32(len(run))

    assert causality(Persistence(), runs[0], folder, 20, [1, 3])
    assert not causality(Ahead(), runs[0], folder, 20, [1, 3])
    assert not causality(Length(), runs[0], folder, 20, [1, 3])


def test_errors_are_relative_to_the_displacement(runs: list[wt.Run], folder: Path) -> None:
    where = (runs[0], folder, [20, 30], [1, 3])
    assert drift(Persistence(), *where) == pytest.approx(1, rel=1e-5)
    assert scale(Persistence(), *where) == 0

    class Constant(Persistence):
        def forecast(self, run: wt.Run, starts: list[int], horizons: list[int]) -> np.ndarray:
            return super().forecast(run, starts, horizons) + np.float32(0.5)

    assert scale(Constant(), *where) == pytest.approx(1, rel=1e-5)
    assert equivariance(Constant(), *where, symmetry="permutation") == 0
    assert equivariance(Constant(), *where, symmetry="sign") > 0.5


@pytest.mark.parametrize("symmetry", ["permutation", "sign"])
def test_symmetries_leave_the_policy_as_it_is(symmetry: str, runs: list[wt.Run]) -> None:
    weights = runs[0].weights[10:12]
    order, signs = random_symmetry(runs[0].layout, symmetry, np.random.default_rng(0))
    altered = weights[:, order] * signs
    assert not np.array_equal(altered, weights)
    policies = load_policies(runs[0], np.array([10, 11]))
    inputs = np.random.default_rng(1).normal(size=(2, 5, 4)).astype(np.float32)
    before, after = (
        policies.with_weights(w).distribution(inputs).mean.numpy() for w in (weights, altered)
    )
    np.testing.assert_allclose(after, before, atol=1e-6)
    assert before.std() > 1e-3


def test_a_run_like_another(runs: list[wt.Run], tmp_path: Path) -> None:
    run = runs[0]
    weights = np.arange(60 * 122, dtype=np.float32).reshape(60, 122)
    made = run_like(run, weights, tmp_path)
    assert np.array_equal(made.weights[:], weights)
    assert made.layout == run.layout
    assert made.info.cadence == run.info.cadence
    assert made.phase.tolist() == [-1, *(list(range(4)) * 15)[:59]]
    assert np.array_equal(made.phase[:49], run.phase)
    assert np.array_equal(made.obs_norm(7).mean, run.obs_norm(7).mean)
    assert (np.diff(made.num_timesteps) >= 0).all()
    changed = run_like(run, weights, tmp_path)
    assert changed.path == made.path
