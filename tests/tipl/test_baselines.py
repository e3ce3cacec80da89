from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

import weighttraj as wt
from tipl.checks.copies import run_like
from tipl.checks.measures import skills
from tipl.errors import ForecastError, ModelError, TrainError
from tipl.forecaster import Forecaster
from tipl.models import baselines
from tipl.models.baselines import (
    DMD,
    WNN,
    Ema,
    EndPoints,
    Extrapolation,
    ModeSteps,
    NinoMLP,
    Persistence,
    ProjectedSteps,
    Reconstruction,
    Regression,
    Slope,
    Steps,
    fit_baselines,
    save_baselines,
)
from tipl.models.baselines.data import Trajectory, thinned
from tipl.models.baselines.modes import cluster, find_references
from tipl.models.baselines.nowcaster import LOOP
from tipl.models.baselines.subspace import prefix_basis
from tipl.registry import load, unfitted
from weighttraj.errors import DamageError

BRIEFLY = replace(LOOP, n_batches=30, batch_size=512)
P = 122


@pytest.fixture(scope="module")
def template(small_dataset: Path) -> wt.Run:
    """Layout, cadence and normalisers of every run here; four phases an iteration."""
    return wt.open(small_dataset).split("train").runs[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def every_baseline(small_dataset: Path) -> list[Forecaster]:
    runs = wt.open(small_dataset).split("train").runs
    return fit_baselines(runs, horizons=(1, 2, 5), training=BRIEFLY)


@pytest.fixture(scope="module")
def unseen(small_dataset: Path) -> wt.Run:
    return wt.open(small_dataset).split("test").runs[0]


def walk(
    template: wt.Run, folder: Path, coefficients: dict[int, Sequence[float]], n: int = 300
) -> wt.Run:
    """Steps that are autoregressive, with coefficients by the phase that a step leaves from."""
    rng = np.random.default_rng(sum(coefficients))
    steps = np.zeros((n, P))
    for t in range(2, n):
        first, second = coefficients[(t - 2) % 4 if len(coefficients) > 1 else 0]
        steps[t] = first * steps[t - 1] + second * steps[t - 2] + rng.normal(size=P)
    return run_like(template, 1e-2 * steps.cumsum(0), folder)


# What is fitted


def test_ar_finds_planted_coefficients(template: wt.Run, folder: Path) -> None:
    run = walk(template, folder, {0: (0.6, -0.3)})
    fitted = Regression.fit([run], Steps(20), horizons=[2, 1])
    one = np.array([0.6, -0.3, *[0] * 18])
    # d_{t+1} + d_{t+2}, with d_{t+2} = 0.6 d_{t+1} - 0.3 d_t + noise
    two = 1.6 * one + [-0.3, *[0] * 19]
    np.testing.assert_allclose(fitted.coefficients, [[one, two]], atol=0.03)
    assert (fitted.name, fitted.horizons, fitted.phases) == ("ar-20", (1, 2), None)


def test_each_phase_has_its_coefficients(template: wt.Run, folder: Path) -> None:
    planted = {0: (0.5, 0.0), 1: (-0.5, 0.2), 2: (0.9, 0.0), 3: (0.0, 0.0)}
    run = walk(template, folder, planted, n=400)
    fitted = Regression.fit([run], Steps(2), by_phase=True, horizons=[1])
    assert fitted.phases == (0, 1, 2, 3)
    np.testing.assert_allclose(fitted.coefficients[:, 0], list(planted.values()), atol=0.03)
    shared = Regression.fit([run], Steps(2), horizons=[1])
    gain = skills(fitted, [run], [1]) - skills(shared, [run], [1])
    assert gain[0] > 0.1
    # phi_0 belongs to no phase, and has no past: it is copied
    assert np.array_equal(fitted.forecast(run, [0], [1])[0, 0], run.weights[0])


def test_a_factor_is_least_squares(template: wt.Run, unseen: wt.Run) -> None:
    fitted = Regression.fit([unseen], Steps(1), horizons=[3])
    weights = unseen.weights[:].astype(np.float64)
    last, moved = np.diff(weights, axis=0)[: 49 - 1 - 3], weights[4:] - weights[1:-3]
    factor = (last * moved).sum() / (last**2).sum()
    np.testing.assert_allclose(fitted.coefficients, [[[factor]]])
    assert fitted.name == "last-step-shrunk"
    got = fitted.forecast(unseen, [20], [3])[0, 0] - weights[20]
    np.testing.assert_allclose(got, factor * (weights[20] - weights[19]), atol=1e-6)


def test_least_squares_has_skill_on_its_own_runs(unseen: wt.Run) -> None:
    """AR more than the last step alone, which is one of its coefficients."""
    fits = [
        Regression.fit([unseen], features, horizons=[1, 5])
        for features in (Steps(1), Steps(20), EndPoints(), ModeSteps(), ProjectedSteps())
    ]
    scores = np.array([skills(fit, [unseen], [1, 5]) for fit in fits])
    assert (scores > 0).all()
    assert (scores[1] >= scores[0]).all()


def test_lfd_finds_planted_coefficients(template: wt.Run, folder: Path) -> None:
    rng = np.random.default_rng(0)
    weights = 0.5 + 0.1 * rng.normal(size=(300, P))
    for t in range(5, 300):
        weights[t] = 0.7 * weights[t - 5] + 0.2 * weights[t - 1] + 0.05 + 0.1 * rng.normal(size=P)
    run = run_like(template, weights, folder)
    fitted = Regression.fit([run], EndPoints(), horizons=[1])
    assert fitted.name == "lfd-2"
    # displacements from the newest weights; four starts had a shorter window
    np.testing.assert_allclose(fitted.coefficients[0, 0], [0.7, -0.8, 0.05], atol=0.05)


def test_large_runs_are_sampled(template: wt.Run, unseen: wt.Run) -> None:
    whole = Trajectory.of(unseen)
    some = whole.sample(60, np.random.default_rng(0))
    assert 40 < len(some.tensor) < 80
    assert set(some.tensor) == set(range(7))
    assert some.importance.sum() == pytest.approx(P)
    columns = [
        int(np.flatnonzero((row == unseen.weights[:].T).all(1))[0]) for row in some.weights.T
    ]
    assert np.array_equal(whole.tensor[columns], some.tensor)
    assert np.array_equal(whole.sample(P, np.random.default_rng(0)).weights, unseen.weights[:])
    again = some.sample(30, np.random.default_rng(0))
    assert again.importance.sum() == pytest.approx(P)

    starts, counts = thinned(100, 20, np.random.default_rng(0))
    assert starts[:10].tolist() == list(range(10))
    assert len(set(starts.tolist())) == 20
    assert starts.max() < 100
    assert counts.sum() == pytest.approx(100)


def test_a_fit_to_a_sample_is_close(template: wt.Run, folder: Path) -> None:
    run = walk(template, folder, {0: (0.6, -0.3)})
    sampled = baselines.regression.RegressionFit(Steps(2), horizons=[1])
    sampled.add(Trajectory.of(run).sample(60, np.random.default_rng(0)))
    np.testing.assert_allclose(sampled.finish().coefficients, [[[0.6, -0.3]]], atol=0.03)


# What is not fitted


def test_ema_is_its_recursion(template: wt.Run, folder: Path) -> None:
    run = walk(template, folder, {0: (0.6, -0.3)})
    steps = np.diff(run.weights[:].astype(np.float64), axis=0)
    forecaster, mean = Extrapolation(Ema(0.9)), np.zeros(P)
    assert Ema(0.9).period < 140  # so that the run is longer than two
    got = forecaster.forecast(run, list(range(300)), [3])[:, 0]
    assert np.array_equal(got[0], run.weights[0])
    for t in range(1, 300):
        mean = 0.9 * mean + 0.1 * steps[t - 1]
        expected = run.weights[t] + 3 * mean / (1 - 0.9**t)
        np.testing.assert_allclose(got[t], expected, atol=1e-6)


def test_a_trend_is_the_slope_of_the_best_line(unseen: wt.Run) -> None:
    weights = unseen.weights[:].astype(np.float64)
    for start, window in ((30, 5), (3, 20), (1, 20)):
        rows = weights[max(0, start + 1 - window) : start + 1]
        slope = np.polyfit(np.arange(len(rows)), rows, 1)[0]
        got = Extrapolation(Slope(window)).forecast(unseen, [start], [4])[0, 0]
        np.testing.assert_allclose(got, weights[start] + 4 * slope, atol=1e-6)


def test_dmd_goes_on_with_a_linear_system(template: wt.Run, folder: Path) -> None:
    rng = np.random.default_rng(0)
    turn = 0.97 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    states = [np.array([1.0, 0.0])]
    for _ in range(80):
        states.append(turn @ states[-1])
    path = np.array(states) @ rng.normal(size=(2, P)) + rng.normal(size=P)
    run = run_like(template, path, folder)
    got = DMD(rank=2).forecast(run, [40], [1, 5, 30])[0]
    np.testing.assert_allclose(got, path[[41, 45, 70]], atol=2e-4)


def test_dmd_does_not_explode(template: wt.Run, folder: Path) -> None:
    growing = 1e-3 * 1.1 ** np.arange(60)[:, None] * np.random.default_rng(0).normal(size=P)
    run = run_like(template, growing, folder)
    moved = DMD().forecast(run, [59], [100])[0, 0] - run.weights[59]
    last = run.weights[59] - run.weights[58]
    np.testing.assert_allclose(moved, 100 * last, rtol=1e-3)  # without the clip 1e5 times


def test_the_basis_of_the_past_is_numpys(unseen: wt.Run) -> None:
    weights = unseen.weights[:31].astype(np.float64)
    basis = prefix_basis(unseen.weights, 30, 6, np.ones(P))
    np.testing.assert_allclose(basis @ basis.T, np.eye(6), atol=1e-8)
    vt = np.linalg.svd(weights - weights[30], full_matrices=False)[2][:6]
    np.testing.assert_allclose(np.abs((basis * vt).sum(1)), 1, atol=1e-6)
    assert len(prefix_basis(unseen.weights, 3, 6, np.ones(P))) == 3


def test_a_full_basis_leaves_steps_as_they_are(unseen: wt.Run) -> None:
    whole = Trajectory.of(unseen)
    starts = [5, 20, 39]  # at each of them the basis is found again
    plain = {place: x for place, _, x in Steps(20)(whole, starts)}
    for rank, close in ((48, True), (3, False)):
        for place, _, x in ProjectedSteps(rank=rank)(whole, starts):
            assert np.allclose(x, plain[place], atol=1e-6) == close
    for _, _, x in ProjectedSteps(rank=3)(whole, [39]):
        assert np.linalg.matrix_rank(x, tol=1e-6) == 3
        assert (x**2).sum() < (plain[2] ** 2).sum()


def test_modes_are_found_and_followed(template: wt.Run, folder: Path) -> None:
    rng = np.random.default_rng(0)
    profiles, mine = rng.normal(size=(60, 3)).cumsum(0), rng.integers(0, 3, P)
    run = run_like(template, profiles[:, mine] * rng.normal(size=P) + rng.normal(size=P), folder)
    references = find_references(run.weights[:30].astype(np.float64), 3)
    assert sorted(mine[references]) == [0, 1, 2]
    whole = Trajectory.of(run)
    plain = [x for _, _, x in Steps(20)(whole, [30, 45])]
    seen = [x for _, _, x in ModeSteps(modes=3)(whole, [30, 45])]
    np.testing.assert_allclose(seen, plain, atol=1e-5)
    fewer = [x for _, _, x in ModeSteps(modes=2)(whole, [30, 45])]
    assert not np.allclose(fewer, plain, atol=1e-2)


def test_clusters_join_what_is_alike() -> None:
    alike = np.array([[1, 0.9, 0.1, 0.2], [0.9, 1, 0.3, 0], [0.1, 0.3, 1, 0.8], [0.2, 0, 0.8, 1]])
    label = cluster(alike, 2)
    assert label[0] == label[1]
    assert label[2] == label[3]
    assert label[0] != label[2]
    assert len(set(cluster(alike, 4))) == 4


# Small networks


@pytest.mark.parametrize("kind", [WNN, NinoMLP])
def test_a_network_learns_what_can_be_learnt(
    kind: type[WNN] | type[NinoMLP], template: wt.Run, folder: Path
) -> None:
    def turning(seed: int) -> wt.Run:
        """Each parameter swings, at the same pace."""
        rng = np.random.default_rng(seed)
        swing = np.sin(0.2 * np.arange(100)[:, None] + rng.uniform(0, 6, P))
        return run_like(template, rng.normal(size=P) + 1e-2 * swing, folder)

    training = replace(LOOP, n_batches=500, batch_size=512, learning_rate=1e-2)
    fitted = kind.fit([turning(0), turning(1)], horizons=[1, 5], training=training)
    assert (skills(fitted, [turning(2)], [1, 5]) > 0.9).all()


def test_networks_are_seeded(template: wt.Run, unseen: wt.Run) -> None:
    before = torch.get_rng_state()
    made = [WNN.fit([unseen], horizons=[1], seed=seed, training=BRIEFLY) for seed in (0, 0, 1)]
    first, again, other = (m.forecast(unseen, [30], [1]) for m in made)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_validation_runs_choose_the_state(template: wt.Run, folder: Path, unseen: wt.Run) -> None:
    """On runs without anything to forecast the best network is one that has hardly learnt."""
    training = replace(LOOP, n_batches=100, batch_size=512)
    noise = walk(template, folder, {0: (0, 0)})
    plain = WNN.fit([unseen], horizons=[1, 5], training=training)
    chosen = WNN.fit([unseen], [noise], horizons=[1, 5], training=training)
    assert skills(chosen, [noise], [1, 5])[1] > skills(plain, [noise], [1, 5])[1]


# All of them


def test_names_are_stable(every_baseline: list[Forecaster]) -> None:
    without = (
        ["persistence", "last-step"]
        + [f"trend-{window}" for window in (5, 20, 50, 200)]
        + [f"ema-{beta}" for beta in (0.9, 0.95, 0.98)]
        + ["dmd", "last-iteration", "lines-50", "relex-50", "pptb-4"]
    )
    fitted = (
        ["last-step-shrunk"]
        + [f"ema-{beta}-shrunk" for beta in (0.9, 0.95, 0.98)]
        + ["ar-20", "ar-20-phase", "ar-20-svd", "cmd", "lfd-2", "wnn", "nino-mlp"]
    )
    assert list(unfitted()) == without
    assert [forecaster.name for forecaster in every_baseline] == without + fitted
    assert all(forecaster.causal for forecaster in every_baseline)
    assert load("ema-0.95") == Extrapolation(Ema(0.95))
    with pytest.raises(ForecastError, match=r"persistence, last-step(.|\n)*got: ar-20"):
        load("ar-20")


def test_all_are_saved_and_loaded(
    every_baseline: list[Forecaster], unseen: wt.Run, tmp_path: Path
) -> None:
    every_baseline = [*every_baseline, Reconstruction(7)]
    save_baselines(every_baseline, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {made.name for made in every_baseline}
    for made in every_baseline:
        again = load(tmp_path / made.name)
        assert type(again) is type(made)
        assert (again.name, again.causal) == (made.name, made.causal)
        request = (unseen, [0, 3, 40], [1, 5])
        assert np.array_equal(again.forecast(*request), made.forecast(*request)), made.name
        files = {path.name for path in (tmp_path / made.name).iterdir()}
        assert files in ({"config.json"}, {"config.json", "model.safetensors"})


def test_forecasts_have_the_form_of_the_request(
    every_baseline: list[Forecaster], unseen: wt.Run
) -> None:
    for made in every_baseline:
        found = made.forecast(unseen, [40, 0, 7, 7], [5, 1])
        assert found.dtype == np.float32
        assert found.shape == (4, 2, P)
        assert np.isfinite(found).all()
        alone = made.forecast(unseen, [7], [1, 5])
        np.testing.assert_allclose(found[2], alone[0, ::-1], atol=1e-6, err_msg=made.name)
        np.testing.assert_allclose(found[3], found[2], atol=1e-7)


def test_requests_that_cannot_be_met(every_baseline: list[Forecaster], unseen: wt.Run) -> None:
    for made in every_baseline:
        for starts, horizons in (([-1], [1]), ([49], [1]), ([3], [0]), ([], [1])):
            with pytest.raises(ForecastError, match="starts from 0 to 48, horizons from 1"):
                made.forecast(unseen, starts, horizons)
        if made.name not in unfitted():
            with pytest.raises(ForecastError, match=r"among \[1, 2, 5\](.|\n)*got: \[3\]"):
                made.forecast(unseen, [3], [1, 3])


def test_phases_that_were_not_fitted(template: wt.Run, folder: Path, unseen: wt.Run) -> None:
    short = run_like(template, template.weights[:4], folder)
    fitted = Regression.fit([short], Steps(1), by_phase=True, horizons=[1])
    assert fitted.phases == (0, 1)
    with pytest.raises(ForecastError, match=r"phases \[0, 1\](.|\n)*phases \[2, 3\]"):
        fitted.forecast(unseen, [1, 3, 4], [1])


def test_short_runs_are_refused(template: wt.Run, folder: Path) -> None:
    short = run_like(template, template.weights[:6], folder)
    for fit in (
        lambda: Regression.fit([short], Steps(20)),
        lambda: Regression.fit([], Steps(20)),
        lambda: WNN.fit([short], training=BRIEFLY),
        lambda: fit_baselines([short]),
    ):
        with pytest.raises(TrainError, match="too short"):
            fit()
    for horizons in ([], [0, 1]):
        with pytest.raises(TrainError, match="horizons from 1"):
            Regression.fit([short], Steps(20), horizons=horizons)


def test_a_damaged_run_is_refused_and_a_decoded_one_is_not_read_again(
    every_baseline: list[Forecaster],
    template: wt.Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    weights = 1e-3 * rng.normal(size=(300, P)).cumsum(0)
    run = run_like(template, weights, tmp_path)
    before = [made.forecast(run, [100, 127], [1, 5]) for made in every_baseline]
    for chunk in run.path.glob("policy/weights/c/2*"):  # rows 256 and later
        for file in [chunk] if chunk.is_file() else chunk.iterdir():
            file.write_bytes(b"damaged")
    damaged = wt.open_run(run.path)
    for made, expected in zip(every_baseline, before, strict=True):
        assert np.array_equal(made.forecast(damaged, [100, 127], [1, 5]), expected), made.name
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", str(tmp_path / "cache"))
    again = wt.open_run(run.path)
    for made in every_baseline:
        with pytest.raises(DamageError):
            made.forecast(again, [100], [1])


def test_a_fit_serves_policies_of_other_sizes(
    every_baseline: list[Forecaster], unseen: wt.Run, tmp_path: Path
) -> None:
    tensors = {
        "w": ((40, 20), "weight", ("hidden_0", "observation")),
        "b": ((40,), "bias", ("hidden_0",)),
    }
    info = wt.RunInfo(run_id="large", layout=wt.ParamLayout.of(tensors))
    rng = np.random.default_rng(0)
    with wt.RunWriter(tmp_path / "large.zarr", info) as writer:
        for t in range(30):
            row = rng.normal(size=840).astype(np.float32)
            writer.append(row, num_timesteps=t, phase=(t - 1) % 4 if t else -1)
    large = wt.open_run(tmp_path / "large.zarr")
    for made in every_baseline:
        assert made.forecast(large, [0, 20], [1]).shape == (2, 1, 840), made.name


def test_the_fit_says_what_it_does(small_dataset: Path, every_baseline: list[Forecaster]) -> None:
    dataset, said = wt.open(small_dataset), []
    again = fit_baselines(
        dataset.split("train").runs,
        dataset.split("test").runs[:1],
        horizons=(1, 2, 5),
        training=BRIEFLY,
        progress=said.append,
    )
    assert said[:3] == ["read seed0000", "read seed0001", "read seed0002, for validation"]
    assert said[-1] == "fitted nino-mlp"
    for one, other in zip(every_baseline, again, strict=True):
        if isinstance(one, Regression):  # validation runs are for the networks only
            assert np.array_equal(one.coefficients, other.coefficients)


# Files that don't fit


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "dmd"}, "of kind 'dmd', not 'regression'"),
        ({"horizons": [1, 2]}, r"not \{'coefficients': \(1, 2, 20\)\}"),
        ({"horizons": "all"}, "Expected `array`"),
        ({"features": {"kind": "future"}}, "features of kind 'future'; there are"),
        ({"features": {"kind": "steps", "lags": "many"}}, "Expected `int`"),
    ],
)
def test_settings_that_do_not_fit(
    change: dict, message: str, every_baseline: list[Forecaster], tmp_path: Path
) -> None:
    (made,) = [made for made in every_baseline if made.name == "ar-20"]
    made.save(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | change))
    with pytest.raises(ModelError, match=message):
        Regression.load(tmp_path)


def test_arrays_that_do_not_fit(every_baseline: list[Forecaster], tmp_path: Path) -> None:
    by = {made.name: made for made in every_baseline}
    for name in ("ar-20", "wnn"):
        by[name].save(tmp_path)
        file = tmp_path / "model.safetensors"
        arrays = load_file(file)
        save_file(dict(list(arrays.items())[1:]), file)
        with pytest.raises(ModelError, match="cannot be loaded"):
            load(tmp_path)
        file.write_bytes(b"damaged")
        with pytest.raises(ModelError, match="cannot be loaded"):
            load(tmp_path)
        file.unlink()
        with pytest.raises(FileNotFoundError):
            load(tmp_path)
    by["ar-20"].save(tmp_path)
    file = tmp_path / "model.safetensors"
    save_file({"coefficients": np.full((1, 3, 20), np.nan)}, file)
    with pytest.raises(ModelError, match="not finite"):
        load(tmp_path)


def test_folders_that_hold_nothing_of_ours(tmp_path: Path) -> None:
    with pytest.raises(ForecastError, match="there is no such forecaster"):
        load(tmp_path)
    with pytest.raises(FileNotFoundError):
        DMD.load(tmp_path)
    for text in ("{", "[]", '{"kind": "oracle"}', '{"kind": ["dmd"]}', "{}"):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(ModelError, match="no forecaster"):
            load(tmp_path)
        for kind in (Persistence, Extrapolation, DMD, Reconstruction):
            with pytest.raises(ModelError, match="cannot be loaded"):
                kind.load(tmp_path)
    (tmp_path / "config.json").write_text('{"kind": "extrapolation"}')
    with pytest.raises(ModelError, match="velocity"):
        load(tmp_path)
    (tmp_path / "config.json").write_text('{"kind": "reconstruction"}')
    with pytest.raises(ModelError, match="rank"):
        load(tmp_path)
