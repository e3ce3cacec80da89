from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

import weighttraj as wt
from tests.tipl.lively import CAUSAL, HORIZONS, lively_causal
from tipl import change
from tipl.checks.copies import RefitConfig, random_walks, run_like
from tipl.checks.measures import skills
from tipl.checks.model import refit_of
from tipl.checks.results import NULL
from tipl.errors import ForecastError, LeftOutWarning, ModelError, TrainError
from tipl.models.causal import Causal, CausalTrainConfig, train_causal
from tipl.models.causal.data import unit_rows
from tipl.models.causal.forecaster import CausalModelConfig
from tipl.models.causal.network import CausalGPT
from tipl.models.causal.train import CausalLearner


@pytest.fixture(scope="module")
def runs(small_dataset: Path) -> list[wt.Run]:
    return wt.open(small_dataset).split("train").runs


@pytest.fixture(scope="module")
def config(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> CausalTrainConfig:
    out = tmp_path_factory.mktemp("causal") / "model"
    return change(
        CausalTrainConfig(data=(small_dataset,), out=out),
        horizons=HORIZONS,
        starts=40,
        n_batches=80,
        batch_size=16,
        learning_rate=3e-3,
        save_every=40,
        rank=3,
        window=30,
        block_size=6,
        n_layer=1,
        n_head=2,
        n_embd=16,
    )


@pytest.fixture(scope="module")
def trained(config: CausalTrainConfig) -> Causal:
    return train_causal(config)


def unseen(config: CausalTrainConfig) -> wt.Run:
    return wt.open_dataset(config.data[0]).split("test").runs[0]


def test_before_training_it_is_persistence(runs: list[wt.Run]) -> None:
    model = Causal(CausalGPT(CAUSAL), CausalModelConfig(network=CAUSAL, every=2))
    forecast = model.forecast(runs[0], [0, 20], [1, 5])
    assert np.array_equal(forecast, np.repeat(runs[0].weights[[0, 20]][:, None], 2, axis=1))


def test_it_moves_within_the_directions_of_the_path(runs: list[wt.Run]) -> None:
    weights = runs[0].weights[:].astype(np.float64)
    moved = lively_causal().forecast(runs[0], [25], [1, 2, 5])[0] - weights[25]
    path = np.linalg.svd(weights[:26] - weights[25], full_matrices=False)[2][:3]
    assert np.linalg.norm(moved) > 1e-4
    np.testing.assert_allclose(moved @ path.T @ path, moved, atol=1e-6)


def test_the_unit_of_length_is_that_of_recent_or_of_the_first_steps() -> None:
    assert unit_rows(50, CAUSAL) == slice(30, 51)
    first = replace(CAUSAL, unit="first")
    assert (unit_rows(50, first), unit_rows(7, first)) == (slice(0, 21), slice(0, 8))


def test_early_starts_are_copied(runs: list[wt.Run]) -> None:
    forecast = lively_causal().forecast(runs[0], [2, 3], [1])
    assert np.array_equal(forecast[0, 0], runs[0].weights[2])
    assert not np.array_equal(forecast[1, 0], runs[0].weights[3])


def test_where_the_path_rests_it_is_copied(runs: list[wt.Run], tmp_path: Path) -> None:
    weights = runs[0].weights[:]
    rests = np.concatenate([weights[:10], np.repeat(weights[10:11], 30, axis=0)])
    flat = np.repeat(weights[:1], 20, axis=0)
    with np.errstate(all="raise"):
        later = lively_causal().forecast(run_like(runs[0], rests, tmp_path), [38], [1])
        early = lively_causal().forecast(run_like(runs[0], flat, tmp_path), [10], [1])
    assert np.array_equal(later[0, 0], weights[10])
    assert np.array_equal(early[0, 0], weights[0])


def test_the_error_that_is_learnt_is_that_of_the_weights(
    runs: list[wt.Run], config: CausalTrainConfig
) -> None:
    # So many draws find every start.
    learner = CausalLearner(replace(config, starts=2000))
    torch.nn.init.normal_(learner.network.head.weight, std=0.1)
    learner.prepare(Console(quiet=True))
    examples = learner._examples
    model = Causal(learner.network, CausalModelConfig(network=learner.network.config, every=2))
    ratios = []
    for run in runs:
        weights = run.weights[:]
        for t in range(3, len(run) - 1):
            for h in (h for h in HORIZONS if t + h < len(run)):
                error = model.forecast(run, [t], [h])[0, 0] - weights[t + h]
                ratios.append((error**2).sum() / ((weights[t + h] - weights[t]) ** 2).sum())
    with torch.no_grad():
        error, count = learner.loss(learner.network, examples)
    assert (error / count).item() == pytest.approx(np.mean(ratios), rel=1e-3)


def test_it_finds_nothing_in_random_walks(
    trained: Causal, runs: list[wt.Run], tmp_path: Path
) -> None:
    walks = random_walks(runs[0], tmp_path, count=6, length=200)
    fit = refit_of(trained, RefitConfig(folder=tmp_path, horizons=HORIZONS, batches=20))
    assert fit is not None
    again = fit(walks[2:])
    assert isinstance(again, Causal)
    assert again.config.network == trained.config.network
    assert (np.abs(skills(again, walks[:2], HORIZONS)) < NULL).all()


def test_it_learns_and_a_finished_training_is_loaded(
    trained: Causal, config: CausalTrainConfig
) -> None:
    assert (skills(trained, wt.open_dataset(config.data[0]).split("train").runs, [1]) > 0.05).all()
    again = train_causal(config)
    request = (unseen(config), [3, 30], [5, 1])
    assert np.array_equal(again.forecast(*request), trained.forecast(*request))
    assert again.name == "model"


def test_what_does_not_fit_is_refused(
    trained: Causal, config: CausalTrainConfig, tmp_path: Path
) -> None:
    run = unseen(config)
    with pytest.raises(ForecastError, match=r"\[3\]"):
        trained.forecast(run, [5], [3])
    other = replace(trained, config=replace(trained.config, every=64))
    with pytest.raises(ModelError, match="every 64 gradient steps"):
        other.forecast(run, [5], [1])
    with pytest.raises(TrainError, match="runs of more than 102 snapshots"):
        train_causal(change(config, out=tmp_path / "a", horizons=(1, 100)))
    with (
        pytest.warns(LeftOutWarning, match="seed000[01] is left out: no prefix of the run"),
        pytest.raises(TrainError, match="none of the runs can be trained on"),
    ):
        train_causal(change(config, out=tmp_path / "b", rank=40))
    with pytest.raises(TrainError, match="n_embd a multiple of n_head"):
        train_causal(change(config, out=tmp_path / "c", n_head=3))
    assert not (tmp_path / "c").exists()
    trained.save(tmp_path / "copy")
    (tmp_path / "copy/model.safetensors").write_bytes(b"damaged")
    with pytest.raises(ModelError, match="cannot be loaded"):
        Causal.load(tmp_path / "copy")
