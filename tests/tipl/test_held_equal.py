"""Forecasts of released models and of baselines are what they have always been.

``reference.json`` was written before the models moved into rooms of their own: seven parameters of
forecasts on a released run. They are held within 1e-6, or 1e-5 of their size where that is more.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import tipl
import weighttraj as wt
from tipl.models.baselines import WNN, NinoMLP, Reconstruction, Regression
from tipl.models.baselines.nowcaster import Nowcaster, NowcasterConfig
from tipl.models.baselines.train import FEATURES
from tipl.models.stretched import Stretched
from tipl.registry import unfitted

REFERENCE = json.loads(Path(__file__).with_name("reference.json").read_text())
STARTS, HORIZONS = [0, 1, 7, 33, 640, 1500], [1, 2, 10, 50]
PARAMETERS = [0, 5, 30, 60, 100, 119, 121]
ZOO = [name for name in REFERENCE if name in tipl.registry.names()]


@pytest.fixture(scope="module")
def dataset() -> wt.Dataset:
    return wt.open("inverted-pendulum-v4-ppo-v1")


@pytest.fixture(scope="module")
def run(dataset: wt.Dataset) -> wt.Run:
    return dataset.split("test").runs[0]


def assert_held(name: str, forecast: np.ndarray) -> None:
    assert forecast.dtype == np.float32
    chosen = forecast[:, ::2][..., PARAMETERS]
    np.testing.assert_allclose(chosen.ravel(), REFERENCE[name], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ZOO)
def test_released_models(name: str, run: wt.Run) -> None:
    assert_held(name, tipl.load(name).forecast(run, STARTS, HORIZONS))


def test_the_released_transformer_of_large_policies() -> None:
    model = tipl.load("tipl-half-cheetah-v4")
    assert isinstance(model, tipl.TIPL)
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(60, model.config.gpt.rank)) * 0.02
    rolled = model.roll_out(coefficients, np.array([0, 5, 40]), 10)[:, ::2, :7]
    expected = REFERENCE["roll-out tipl-half-cheetah-v4"]
    np.testing.assert_allclose(rolled.ravel(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", [name for name in unfitted() if f"fit:{name}" in REFERENCE])
def test_baselines_without_a_fit(name: str, run: wt.Run) -> None:
    assert_held(f"fit:{name}", tipl.load(name).forecast(run, STARTS, HORIZONS))


@pytest.mark.parametrize("place", [0, 3, 4, 5, 8])
def test_regressions(place: int, dataset: wt.Dataset, run: wt.Run) -> None:
    features, by_phase = FEATURES[place]
    train = dataset.split("train").runs[:2]
    model = Regression.fit(train, features, by_phase=by_phase, horizons=HORIZONS)
    assert_held(f"fit:{model.name}", model.forecast(run, STARTS, HORIZONS))


@pytest.mark.parametrize("kind", [WNN, NinoMLP])
def test_small_networks(kind: type[Nowcaster], run: wt.Run) -> None:
    config = NowcasterConfig(horizons=tuple(HORIZONS))
    torch.manual_seed(0)
    network = kind.build(config)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    model = kind(network, config)
    assert_held(f"drawn {model.name}", model.forecast(run, STARTS, HORIZONS))


def test_stretched_forecasts_and_the_oracle(run: wt.Run) -> None:
    stretched = Stretched(tipl.load("ema-0.9"), {1: 2.0, 50: 0.5})
    assert_held("stretched ema-0.9", stretched.forecast(run, STARTS, HORIZONS))
    assert_held("reconstruction-32", Reconstruction(32).forecast(run, STARTS, HORIZONS))
