from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from torch import Tensor

import weighttraj as wt
from tests.small import SMALL_RECIPE
from tests.tipl.lively import GATE, HORIZONS, lively_gate
from tipl import change
from tipl.checks.copies import RefitConfig, random_walks, run_like
from tipl.checks.measures import (
    causality,
    equivariance,
    scale,
    skills,
)
from tipl.checks.model import refit_of
from tipl.checks.results import NULL, TOLERANCE
from tipl.errors import ForecastError, ModelError, TrainError
from tipl.models.baselines import Ema
from tipl.models.baselines.data import Trajectory
from tipl.models.gate import Gate, GateTrainConfig, train_gate
from tipl.models.gate.adam import AdamReader
from tipl.models.gate.data import PARAMS, GateExamples, examples_of
from tipl.models.gate.features import Features, features
from tipl.models.gate.forecaster import GateModelConfig
from tipl.models.gate.history import History, histories
from tipl.models.gate.network import GateNetwork, Input
from tipl.models.gate.train import relative_error
from tipl.structure import Clock, Structure
from tipl.training import loop
from tipl.training.checkpoint import read_log
from weighttraj.collect import collect
from weighttraj.collect.settings import Seeds
from weighttraj.store.catalog import read_dataset_info, write_dataset_info


@pytest.fixture(scope="module")
def runs(small_dataset: Path) -> list[wt.Run]:
    return wt.open(small_dataset).split("train").runs


@pytest.fixture(scope="module")
def config(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> GateTrainConfig:
    out = tmp_path_factory.mktemp("gate") / "model"
    return change(
        GateTrainConfig(data=(small_dataset,), out=out),
        horizons=HORIZONS,
        starts=40,
        n_batches=60,
        batch_size=8,
        save_every=20,
        width=GATE.width,
        experts=GATE.experts,
    )


@pytest.fixture(scope="module")
def trained(config: GateTrainConfig) -> Gate:
    return train_gate(config)


def unseen(config: GateTrainConfig) -> wt.Run:
    return wt.open_dataset(config.data[0]).split("test").runs[0]


# History and features


def test_history_is_what_it_says(runs: list[wt.Run]) -> None:
    weights = runs[0].weights[:31].astype(np.float64)
    steps = np.diff(weights, axis=0)
    (_, history), *_ = list(histories(runs[0], [30], 20, (0.5, 0.9)))
    np.testing.assert_allclose(history.basis[:20], steps[::-1][:20], atol=1e-7)
    np.testing.assert_allclose(history.basis[-1], steps.mean(0), atol=1e-7)
    ema = Ema(0.9)(Trajectory.of(runs[0]), [30])
    np.testing.assert_allclose(history.basis[21], next(ema)[2][0], atol=1e-7)
    powers = 0.95 ** np.arange(30)[::-1]
    squares = (powers[:, None] * steps**2).sum(0) / powers.sum()
    np.testing.assert_allclose(history.squares, squares, rtol=1e-4, atol=1e-12)


def test_a_walk_that_goes_on_is_the_walk_from_the_beginning(runs: list[wt.Run]) -> None:
    alone = [h.basis.clone() for _, h in histories(runs[0], [40], 20, (0.9,))]
    list(histories(runs[0], [3, 20], 20, (0.9,)))
    further = [h.basis.clone() for _, h in histories(runs[0], [40], 20, (0.9,))]
    assert torch.equal(alone[0], further[0])
    places = [place for place, _ in histories(runs[0], [30, 2, 2, 7], 20, (0.9,))]
    assert places == [1, 2, 3, 0]


def test_features_of_a_run_that_has_not_moved_are_finite(runs: list[wt.Run]) -> None:
    structure, clock = Structure.of(runs[0].layout), Clock.of(runs[0])
    history = History(runs[0].weights[0], GATE.lags, GATE.betas)
    for _ in range(2):
        seen = features(history, structure, clock, GATE)
        inputs, _ = seen.of()
        assert inputs.shape == (GATE.inputs, 122)
        assert seen.contexts.shape == (7, GATE.contexts)
        assert torch.isfinite(inputs).all()
        assert torch.isfinite(seen.contexts).all()
        history.push(runs[0].weights[0])


def test_the_structure_knows_rows_columns_and_kinds(runs: list[wt.Run]) -> None:
    layout = runs[0].layout
    structure = Structure.of(layout)
    part = layout["mlp_extractor.policy_net.2.weight"].slice
    rows = structure.row[part].view(8, 8)
    columns = structure.column[part].view(8, 8)
    assert (rows == rows[:, :1]).all()
    assert (columns == columns[:1]).all()
    assert len(structure.row.unique()) == sum(p.shape[0] for p in layout.params)
    assert structure.kind.tolist() == [5, 0, 3, 1, 3, 2, 4]


def numbers(seen: Features) -> tuple[Tensor, Tensor, Tensor]:
    inputs, basis = seen.of()
    return basis.T, inputs.T, seen.contexts


@pytest.mark.parametrize("name", get_args(Input))
def test_a_part_that_is_left_out_is_zeros_and_nothing_else_is(
    runs: list[wt.Run], name: Input
) -> None:
    structure, clock = Structure.of(runs[0].layout), Clock.of(runs[0])
    (_, history), *_ = list(histories(runs[0], [30], GATE.lags, GATE.betas))
    whole = features(history, structure, clock, GATE)
    without = features(history, structure, clock, replace(GATE, without=(name,)))
    gone = [
        (one != other).any(0).sum()
        for one, other in zip(numbers(whole), numbers(without), strict=True)
    ]
    parts = {
        "steps": [20, 20, 0],
        "averages": [7, 7, 0],
        "drift": [1, 1, 0],
        "sizes": [0, 3, 1],
        "course": [0, 0, GATE.course],
        "kind": [0, 0, 6],
        "phase": [0, 0, 1],
        "time": [0, 0, 1],
        "rate": [0, 0, 2],
    }
    assert gone == parts[name]
    both = replace(GATE, without=get_args(Input))
    nothing = features(history, structure, clock, both)
    assert not any(part.any() for part in numbers(nothing))


# Network


def test_before_training_it_is_persistence(runs: list[wt.Run]) -> None:
    gate = Gate(GateNetwork(GATE), GateModelConfig(network=GATE, every=2))
    forecast = gate.forecast(runs[0], [0, 20], [1, 5])
    assert np.array_equal(forecast, np.repeat(runs[0].weights[[0, 20]][:, None], 2, axis=1))


def test_one_tensor_after_the_other_is_the_whole(runs: list[wt.Run]) -> None:
    gate, structure, clock = lively_gate(), Structure.of(runs[0].layout), Clock.of(runs[0])
    for _, history in histories(runs[0], [17], GATE.lags, GATE.betas):
        seen = features(history, structure, clock, GATE)
    with torch.no_grad():
        basis, inputs, contexts = numbers(seen)
        whole = gate.network(inputs, contexts, basis, structure.tensor)
        parts = gate.displacements(seen, structure, [2, 0])
    assert whole.abs().max() > 1e-4
    torch.testing.assert_close(parts, whole.T[[2, 0]], rtol=1e-4, atol=1e-8)


def test_it_finds_nothing_in_random_walks(
    trained: Gate, runs: list[wt.Run], tmp_path: Path
) -> None:
    walks = random_walks(runs[0], tmp_path, count=6, length=200)
    config = RefitConfig(folder=tmp_path, horizons=HORIZONS, batches=30)
    fit = refit_of(trained, config)
    assert fit is not None
    again = fit(walks[2:])
    assert isinstance(again, Gate)
    assert again.config.network == trained.config.network
    assert (np.abs(skills(again, walks[:2], HORIZONS)) < NULL).all()


def test_one_network_serves_policies_of_any_size(tmp_path: Path) -> None:
    layout = wt.ParamLayout.of(
        {
            "in": ((6, 3), "weight", ("hidden_0", "observation")),
            "out": ((2, 6), "weight", ("action", "hidden_0")),
        }
    )
    info = wt.RunInfo(run_id="wide", layout=layout, block=8)
    with wt.RunWriter(tmp_path / "wide.zarr", info) as writer:
        rng = np.random.default_rng(0)
        for t in range(20):
            writer.append(rng.normal(size=30).astype(np.float32), num_timesteps=t)
    gate = replace(lively_gate(), config=GateModelConfig(network=GATE, every=None))
    forecast = gate.forecast(wt.open_run(tmp_path / "wide.zarr"), [0, 9], HORIZONS)
    assert forecast.shape == (2, 3, 30)


# Adam's moments


@pytest.fixture(scope="module")
def with_moments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One run for training and one for tests, a snapshot after each gradient step."""
    store = replace(SMALL_RECIPE.store, every=1, optimizer_moments=True)
    recipe = replace(SMALL_RECIPE, store=store, seeds=Seeds(train=[0], test=[2]))
    folder = tmp_path_factory.mktemp("moments") / "small"
    collect(recipe, folder)
    return folder


BLIND = replace(GATE, phases=8)
ADAM = replace(BLIND, adam=True)


def test_the_direction_is_the_update_that_adam_made(with_moments: Path) -> None:
    run = wt.open(with_moments).runs[0]
    reader, weights, rates = AdamReader(run, len(run) - 1), run.weights[:], run.learning_rate
    assert not reader.at(0).direction.any()
    for t in range(1, len(run)):
        step = weights[t].astype(np.float64) - weights[t - 1]
        now = reader.at(t)
        np.testing.assert_allclose(now.direction * rates[t], step, rtol=1e-3, atol=2e-7)
        assert (now.gradient > 0).any()


def test_what_the_optimizer_knows_is_seen(with_moments: Path) -> None:
    run = wt.open(with_moments).runs[0]
    structure, clock = Structure.of(run.layout), Clock.of(run)
    (_, history), *_ = list(histories(run, [30], ADAM.lags, ADAM.betas))
    adam = AdamReader(run, 30).at(30)
    plain, seen = (
        features(history, structure, clock, sizes, moments)
        for sizes, moments in ((BLIND, None), (ADAM, adam))
    )
    basis, inputs, contexts = numbers(seen)
    _, known, of_tensors = numbers(plain)
    assert inputs.shape == (122, ADAM.inputs)
    assert contexts.shape == (7, ADAM.contexts)
    # What both see is the same.
    assert torch.equal(inputs[:, : BLIND.basis], known[:, : BLIND.basis])
    assert torch.equal(inputs[:, ADAM.basis :][:, :3], known[:, BLIND.basis :])
    assert torch.equal(contexts[:, : BLIND.contexts], of_tensors)
    assert torch.nn.functional.cosine_similarity(basis[:, -1], adam.direction, 0) > 0.5
    for name in get_args(Input):
        other = features(history, structure, clock, replace(ADAM, without=(name,)), adam)
        for one, rest in zip((basis, inputs, contexts), numbers(other), strict=True):
            assert torch.equal(one[:, -1], rest[:, -1])


def test_with_moments_it_turns_and_grows_as_weights_do(with_moments: Path, tmp_path: Path) -> None:
    run = wt.open(with_moments).runs[0]
    gate, where = lively_gate(1, ADAM), ([5, 30], HORIZONS)
    assert causality(gate, run, tmp_path, 30, HORIZONS)
    for symmetry in ("permutation", "sign"):
        assert equivariance(gate, run, tmp_path, *where, symmetry=symmetry) < TOLERANCE
    assert scale(gate, run, tmp_path, *where) < TOLERANCE


def test_a_network_with_moments_is_trained_saved_and_loaded(
    with_moments: Path, config: GateTrainConfig, tmp_path: Path
) -> None:
    settings = change(config, data=(with_moments,), out=tmp_path / "model", adam=True)
    model = train_gate(settings)
    run = wt.open(with_moments).split("test").runs[0]
    assert model.config.network.adam
    assert np.array_equal(
        Gate.load(tmp_path / "model").forecast(run, [9], [2]), model.forecast(run, [9], [2])
    )
    fit = refit_of(model, RefitConfig(folder=tmp_path, horizons=HORIZONS, batches=2))
    assert fit is not None
    walker = fit(random_walks(run, tmp_path, count=4, length=20))
    assert isinstance(walker, Gate)
    assert walker.config.network.adam


def test_a_run_without_moments_is_refused(config: GateTrainConfig) -> None:
    with pytest.raises(ModelError, match="optimizer_moments = true"):
        lively_gate(2, ADAM).forecast(unseen(config), [5], [1])


# Training


def test_examples_are_what_forecasts_see(runs: list[wt.Run]) -> None:
    rng = np.random.default_rng(0)
    found = [one for run in runs for one in examples_of(run, GATE, 2000, rng)]  # every start
    examples = GateExamples.of([one | {"group": torch.tensor(0)} for one in found])
    assert len(examples) == sum(len(run) - 2 for run in runs)
    assert examples.inputs.shape[1:] == (PARAMS, GATE.inputs)
    assert examples.weight.sum(1).numpy() == pytest.approx(np.ones(len(examples)), rel=1e-3)
    gate = lively_gate()
    error, count = relative_error(gate.network, examples)
    skill = 1 - (error / count).item()
    # The same of the forecasts.
    ratios = []
    for run in runs:
        weights = run.weights[:]
        for t in range(1, len(run) - 1):
            for h in (h for h in HORIZONS if t + h < len(run)):
                error = gate.forecast(run, [t], [h])[0, 0] - weights[t + h]
                ratios.append((error**2).sum() / ((weights[t + h] - weights[t]) ** 2).sum())
    assert skill == pytest.approx(1 - np.mean(ratios), abs=1e-3)


def test_it_learns(trained: Gate, config: GateTrainConfig) -> None:
    lines = [json.loads(line) for line in (config.out / "log.jsonl").read_text().splitlines()]
    assert [line["batch"] for line in lines] == [0, 20, 40, 60]
    assert lines[-1]["error"] < 0.95
    assert (skills(trained, [unseen(config)], HORIZONS) > 0.05).all()


def test_an_interrupted_training_ends_as_an_undisturbed_one(
    trained: Gate, config: GateTrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = loop._Loop.step

    def stopped(self: Any, n: int) -> float:
        if n == 33:
            raise KeyboardInterrupt
        return step(self, n)

    settings = change(config, out=tmp_path / "model")
    with monkeypatch.context() as patch:
        patch.setattr(loop._Loop, "step", stopped)
        with pytest.raises(KeyboardInterrupt):
            train_gate(settings)
    again = train_gate(settings)
    for name, tensor in trained.network.state_dict().items():
        assert torch.equal(tensor, again.network.state_dict()[name]), name
    ours, theirs = (
        [{k: v for k, v in line.items() if k != "batches_per_s"} for line in read_log(out)]
        for out in (settings.out, config.out)
    )
    assert ours == theirs


def test_validation_keeps_the_best_state(
    small_dataset: Path, config: GateTrainConfig, tmp_path: Path
) -> None:
    """Where nothing can be learnt, persistence stays."""
    data = tmp_path / "data"
    shutil.copytree(small_dataset, data)
    info = read_dataset_info(data)
    entries = [replace(run, split="validation") if run.seed == 2 else run for run in info.runs]
    write_dataset_info(data, replace(info, runs=tuple(entries)))
    settings = change(config, data=(data,), out=tmp_path / "model", n_batches=4, save_every=2,
        learning_rate=30.0,
    )  # fmt: skip
    model = train_gate(settings)
    assert not model.network.experts.any()
    lines = [json.loads(line) for line in (settings.out / "log.jsonl").read_text().splitlines()]
    assert lines[0]["validation_error"] == pytest.approx(1, abs=1e-4)
    assert min(line["validation_error"] for line in lines[1:]) > 1


def test_it_is_saved_and_loaded(trained: Gate, config: GateTrainConfig, tmp_path: Path) -> None:
    trained.save(tmp_path / "copy")
    again = Gate.load(tmp_path / "copy")
    assert again.name == "copy"
    request = (unseen(config), [3, 30], [5, 1])
    assert np.array_equal(again.forecast(*request), trained.forecast(*request))
    (tmp_path / "copy/model.safetensors").write_bytes(b"damaged")
    with pytest.raises(ModelError, match="cannot be loaded"):
        Gate.load(tmp_path / "copy")


def test_what_it_was_not_trained_for_is_refused(trained: Gate, config: GateTrainConfig) -> None:
    run = unseen(config)
    with pytest.raises(ForecastError, match=r"\[3\]"):
        trained.forecast(run, [5], [3])
    other = replace(trained, config=replace(trained.config, every=64))
    with pytest.raises(ModelError, match="every 64 gradient steps"):
        other.forecast(run, [5], [1])


def test_runs_that_are_too_short_are_refused(config: GateTrainConfig, tmp_path: Path) -> None:
    settings = change(config, out=tmp_path, horizons=(1, 100))
    with pytest.raises(TrainError, match="runs of more than 102 snapshots"):
        train_gate(settings)


def test_other_settings_are_refused(trained: Gate, config: GateTrainConfig) -> None:
    with pytest.raises(TrainError, match="other settings"):
        train_gate(change(config, n_batches=61))
    assert train_gate(config).config == trained.config


@pytest.mark.parametrize("setting", ["save_every", "n_batches", "starts", "width"])
def test_impossible_settings_leave_no_folder(
    config: GateTrainConfig, tmp_path: Path, setting: str
) -> None:
    settings = change(config, out=tmp_path / "model", **{setting: 0})
    with pytest.raises(TrainError, match=f"{setting} of at least 1"):
        train_gate(settings)
    assert not settings.out.exists()


def test_run_like_keeps_what_the_clock_reads(runs: list[wt.Run], tmp_path: Path) -> None:
    made = run_like(runs[0], runs[0].weights[:20], tmp_path)
    ours, theirs = Clock.of(made), Clock.of(runs[0])
    assert np.array_equal(ours.phase, theirs.phase[:20])
    np.testing.assert_allclose(ours.rate, theirs.rate[:20])
