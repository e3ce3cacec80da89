from __future__ import annotations

import io
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

import weighttraj as wt
from tipl import TIPL, Persistence, Reconstruction, TemporalSVD, TrainConfig, change, train
from tipl.errors import ForecastError, ModelError, TrainError
from weighttraj.errors import FormatError
from weighttraj.store.catalog import read_dataset_info, write_dataset_info


@pytest.fixture
def config(small_dataset: Path, tmp_path: Path) -> TrainConfig:
    return change(
        TrainConfig(data=small_dataset, out=tmp_path / "model"),
        rank=8,
        n_batches=6,
        batch_size=8,
        warmup=3,
        block_size=5,
        n_layer=2,
        n_embd=16,
        save_every=3,
    )


def log(config: TrainConfig) -> list[dict[str, float]]:
    return [json.loads(line) for line in (config.out / "log.jsonl").read_text().splitlines()]


def test_training_lowers_the_loss_and_writes_a_log(config: TrainConfig) -> None:
    train(change(config, n_batches=300, learning_rate=1e-2, save_every=100))
    lines = log(config)
    assert [line["batch"] for line in lines] == [100, 200, 300]
    assert lines[-1]["wpe"] < 0.2 * lines[0]["wpe"]
    assert all(line["batches_per_s"] > 0 for line in lines)
    assert "validation_wpe" not in lines[0]  # the data set has no such split


def test_validation_is_one_step_ahead_without_dropout(config: TrainConfig, tmp_path: Path) -> None:
    data = tmp_path / "dataset"
    shutil.copytree(config.data, data)
    info = read_dataset_info(data)
    runs = [replace(run, split="validation") if run.seed == 2 else run for run in info.runs]
    write_dataset_info(data, replace(info, runs=tuple(runs)))
    # With a window of one, each forecast is from one token, as in training. 200 batches between
    # lines are enough for an error on all 48 windows.
    settings = change(config, data=data, block_size=1, dropout=0.5, save_every=200, n_batches=200)
    model, run = train(settings), wt.open(data).split("validation").runs[0]
    (line,) = log(config)
    weights = run.weights[:]
    svd = TemporalSVD.fit(weights, 8)
    truth = svd.inverse_transform(svd.transform(weights))[1:]
    forecasts = model.forecast(run, range(48), [1])[:, 0]
    assert line["validation_wpe"] == pytest.approx(np.mean((truth - forecasts) ** 2), rel=1e-4)
    # It leaves the parameters alone.
    parameters = train(change(settings, data=config.data, out=tmp_path / "plain")).network
    for name, tensor in parameters.state_dict().items():
        assert torch.equal(tensor, model.network.state_dict()[name]), name


def test_what_was_logged_and_not_saved_is_logged_once(config: TrainConfig) -> None:
    train(change(config, n_batches=3))
    with (config.out / "log.jsonl").open("a") as file:  # a process died before it saved
        file.write(json.dumps({"batch": 6, "wpe": 1e9}) + "\n")
    train(config)
    assert [line["batch"] for line in log(config)] == [3, 6]
    assert log(config)[-1]["wpe"] < 1e9


def test_a_bar_shows_speed_and_error(config: TrainConfig) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=120)
    train(config, console=console)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "6/6" in shown
    assert re.search(r"\d batches/s, wpe \d", shown)


def test_the_number_of_threads_is_put_back(config: TrainConfig) -> None:
    torch.set_num_threads(2)
    train(config)
    assert torch.get_num_threads() == 2


def test_an_interrupted_training_ends_as_an_undisturbed_one(
    config: TrainConfig, tmp_path: Path
) -> None:
    whole = train(config).network.state_dict()
    broken = change(config, out=tmp_path / "broken")
    train(change(broken, n_batches=3))
    again = train(broken).network.state_dict()
    for name, tensor in whole.items():
        assert torch.equal(tensor, again[name]), name


def test_a_finished_training_is_loaded(config: TrainConfig) -> None:
    first, second = train(config), train(config)
    for a, b in zip(first.network.parameters(), second.network.parameters(), strict=True):
        assert torch.equal(a, b)


def test_seeds_matter(config: TrainConfig, tmp_path: Path) -> None:
    one, two = train(config), train(change(config, seed=1, out=tmp_path / "other"))
    assert not torch.equal(one.network.head.weight, two.network.head.weight)


def test_a_saved_model_forecasts_the_same(config: TrainConfig) -> None:
    model, run = train(config), wt.open(config.data).split("test").runs[0]
    again = TIPL.load(config.out)
    assert again.config == model.config
    expected = model.forecast(run, [0, 3, 30], [1, 2, 10])
    assert expected.shape == (3, 3, 122)
    assert expected.dtype == np.float32
    assert np.array_equal(again.forecast(run, [0, 3, 30], [1, 2, 10]), expected)
    assert {p.name for p in config.out.iterdir()} == {
        "config.json",
        "log.jsonl",
        "model.safetensors",
        "state.safetensors",
        "train.json",
    }


def test_one_step_is_the_network_on_the_last_window(config: TrainConfig) -> None:
    model, run = train(config), wt.open(config.data).split("test").runs[0]
    weights = run.weights[:]
    svd = TemporalSVD.fit(weights, 8)
    tokens = torch.from_numpy(svd.transform(weights)[6:11].astype(np.float32))[None]
    mask = torch.ones(1, 5, dtype=torch.bool)
    with torch.no_grad():
        u = model.network(tokens, torch.arange(6, 11)[None], mask)[0, -1]
    expected = svd.inverse_transform(u.numpy())
    np.testing.assert_allclose(model.forecast(run, [10], [1])[0, 0], expected, atol=1e-6)


def test_starts_do_not_see_each_other(config: TrainConfig) -> None:
    model, run = train(config), wt.open(config.data).split("test").runs[0]
    alone = model.forecast(run, [20], [1, 5])
    np.testing.assert_allclose(model.forecast(run, [2, 20], [1, 5])[1:], alone, atol=1e-6)


def test_other_settings_are_not_mixed(config: TrainConfig) -> None:
    train(config)
    with pytest.raises(TrainError, match="'rank': 8"):
        train(change(config, rank=9))


def test_a_setting_that_is_newer_than_a_training_has_its_default(config: TrainConfig) -> None:
    train(config)
    file = config.out / "train.json"
    settings = json.loads(file.read_text())
    del settings["ema"]
    file.write_text(json.dumps(settings))
    with pytest.raises(TrainError, match=r"expected: {'ema': 0.0}\n  got: {'ema': 0.5}"):
        train(change(config, ema=0.5))
    train(config)


def test_other_data_are_not_mixed(config: TrainConfig, tmp_path: Path) -> None:
    train(config)
    other = tmp_path / "dataset"
    shutil.copytree(config.data, other)
    info = read_dataset_info(other)
    runs = [replace(run, split="train") if run.id == "seed0002" else run for run in info.runs]
    write_dataset_info(other, replace(info, runs=tuple(runs)))
    with pytest.raises(TrainError, match="seed0002"):
        train(change(config, data=other))
    moved = tmp_path / "moved"
    shutil.copytree(config.data, moved)
    train(change(config, data=moved))


def test_a_longer_training_is_not_passed_off_as_a_shorter_one(config: TrainConfig) -> None:
    train(config)
    with pytest.raises(TrainError, match="longer training"):
        train(change(config, n_batches=5))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n_head": 3}, "n_embd a multiple of n_head"),
        ({"seed": -1}, "seed of at least 0"),
        ({"learning_rate": -1.0}, "learning_rate of at least 0"),
        ({"save_every": 0}, "save_every of at least 1(.|\n)*save_every 0"),
        ({"dropout": 1.0}, "dropout below 1"),
        ({"block_size": 50}, "block_size at most 49"),
        ({"rank": 50}, "run seed0000 has no such coefficients"),
        ({"device": "xpu:9"}, "choose another --device"),
        ({"device": "nonsense"}, "choose another --device"),
    ],
)
def test_impossible_settings_leave_no_folder(
    config: TrainConfig, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(TrainError, match=message):
        train(change(config, **changes))
    assert not config.out.exists()


def test_a_data_set_without_training_runs_is_refused(config: TrainConfig, tmp_path: Path) -> None:
    (tmp_path / "dataset").mkdir()
    info = replace(read_dataset_info(config.data), runs=(), status="collecting")
    write_dataset_info(tmp_path / "dataset", info)
    with pytest.raises(FormatError, match="holds no run of this split"):
        train(change(config, data=tmp_path / "dataset"))


def test_a_loss_that_explodes_stops_the_training(config: TrainConfig) -> None:
    with pytest.raises(TrainError, match="lower --learning-rate"):
        train(change(config, learning_rate=1e30, n_batches=50))


def test_a_damaged_model_is_not_loaded(config: TrainConfig) -> None:
    train(config)
    text = (config.out / "config.json").read_text()
    (config.out / "config.json").write_text(text.replace('"n_layer": 2', '"n_layer": 3'))
    with pytest.raises(ModelError, match="Missing key"):
        TIPL.load(config.out)
    (config.out / "config.json").write_text(text)
    file = config.out / "model.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ModelError, match="cannot be loaded"):
        TIPL.load(config.out)


def test_runs_that_do_not_fit_the_model_are_refused(config: TrainConfig) -> None:
    model, run = train(config), wt.open(config.data).split("test").runs[0]
    with pytest.raises(ModelError, match="up to snapshot 48"):
        model.forecast(run, [48], [1])
    for starts, horizons in (([-1], [1]), ([49], [1]), ([3], [0]), ([], [1])):
        for forecaster in (model, Persistence(), Reconstruction(3)):
            with pytest.raises(ForecastError, match="starts from 0 to 48, horizons from 1"):
                forecaster.forecast(run, starts, horizons)
    other = TIPL(model.network, replace(model.config, every=64))
    with pytest.raises(ModelError, match="another cadence"):
        other.forecast(run, [1], [1])
    other = TIPL(model.network, replace(model.config, parameters=7))
    with pytest.raises(ModelError, match=r"another structure(.|\n)*of 7 parameters(.|\n)*122"):
        other.forecast(run, [1], [1])
