from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from tipl import EvaluateConfig, Persistence, Reconstruction, TrainConfig, evaluate, train
from tipl.errors import EvaluateError
from tipl.evaluate import _Errors, skill_with_interval, squared_errors
from tipl.report import verdict
from weighttraj.policies import evaluate as play

HORIZONS = np.arange(1, 4)


@pytest.fixture(scope="module")
def results(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model trained for a moment, and its evaluation."""
    out = tmp_path_factory.mktemp("results")
    model = train(
        TrainConfig(
            data=small_dataset,
            out=out / "tipl",
            rank=8,
            n_batches=20,
            warmup=5,
            block_size=5,
            n_layer=1,
            n_embd=16,
        )
    )
    config = EvaluateConfig(
        data=small_dataset, out=out, max_horizon=3, return_starts=2, episodes=3, bootstrap=200
    )
    evaluate([model], config)
    return out


def load(results: Path) -> dict:
    return json.loads((results / "results.json").read_text())


def test_persistence_is_the_zero_of_skill(results: Path, small_dataset: Path) -> None:
    scores = load(results)["forecasters"]["persistence"]
    assert all(row["value"] == 0 for row in scores["skill"])
    errors = []
    for run in wt.open(small_dataset).split("test"):
        weights = run.weights[:].astype(np.float64)
        starts = np.arange(49 - 3)
        errors.append(((weights[starts + 2] - weights[starts]) ** 2).mean())
    assert scores["wpe"][1]["value"] == pytest.approx(np.mean(errors), rel=1e-6)


def test_errors_are_summed_over_every_start(
    small_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = wt.open(small_dataset).split("test").runs[0]
    weights = run.weights[:]
    whole = squared_errors(Reconstruction(4), run, weights, HORIZONS)
    monkeypatch.setattr(
        import_module("tipl.evaluate"), "MAX_BYTES", 122 * 3 * 4 * 7
    )  # chunks of 7 starts
    parts = squared_errors(Reconstruction(4), run, weights, HORIZONS)
    np.testing.assert_allclose(parts.forecast, whole.forecast)
    assert whole.count == parts.count == 46 * 122


def test_skill_and_interval_by_hand() -> None:
    def errors(forecast: float, copy: float) -> _Errors:
        return _Errors(np.array([float(forecast)]), np.array([float(copy)]), 1)

    one = skill_with_interval([errors(1, 4)], resamples=10, seed=0)
    assert one == [{"value": 0.75, "low": None, "high": None}]
    two = skill_with_interval([errors(1, 4), errors(6, 4)], resamples=1000, seed=0)
    assert two == [{"value": 1 - 7 / 8, "low": -0.5, "high": 0.75}]


def test_the_floor_is_below_the_model(results: Path) -> None:
    by_name = load(results)["forecasters"]
    assert by_name["reconstruction-8"]["skill"][0]["value"] > 0.5
    assert by_name["tipl"]["skill"][0]["value"] < by_name["reconstruction-8"]["skill"][0]["value"]
    assert by_name["tipl"]["causal"] is False
    interval = by_name["tipl"]["skill"][0]
    assert interval["low"] <= interval["value"] <= interval["high"]


def test_returns_are_of_the_right_policies(results: Path, small_dataset: Path) -> None:
    document, run = load(results), wt.open(small_dataset).split("test").runs[0]
    starts = [0, 49 - 1 - 3]
    for mode in ("deterministic", "sampled"):
        found = document["forecasters"]["persistence"]["returns"][mode][0]
        expected = [
            play(run.load_policy(t + h), run, episodes=3, deterministic=mode == "deterministic")
            for t in starts
            for h in HORIZONS.tolist()
        ]
        assert found["true"] == [e.returns.mean() for e in expected]
        copies = [
            play(run.load_policy(t), run, episodes=3, deterministic=mode == "deterministic")
            for t in starts
        ]
        assert found["forecast"] == [copies[i].returns.mean() for i in (0, 0, 0, 1, 1, 1)]
        repw = document["forecasters"]["persistence"]["repw"][mode]
        gaps = np.abs(np.subtract(found["true"], found["forecast"]))
        other = document["forecasters"]["persistence"]["returns"][mode][1]
        gaps = np.stack([gaps, np.abs(np.subtract(other["true"], other["forecast"]))])
        by_horizon = gaps.reshape(2, 2, 3).mean((0, 1))
        np.testing.assert_allclose([row["value"] for row in repw], by_horizon)


def test_the_page_stands_alone_and_says_who_wins(results: Path) -> None:
    page = (results / "report.html").read_text()
    assert page.count("<svg") == 2
    assert "TIPL loses to copying the last weights" in page
    for outside in ('src="http', 'href="http', "<script", "@import"):
        assert outside not in page
    assert (results / "figure-sampled.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("skills", "word"), [((0.1, 0.2), "beats"), ((-1, -2), "loses to"), ((0.1, -1), "splits with")]
)
def test_the_verdict_is_plain(skills: tuple[float, float], word: str) -> None:
    rows = [
        {"h": h, "value": v, "low": None, "high": None}
        for h, v in zip((1, 10), skills, strict=True)
    ]
    repw = {"sampled": [{"h": 1, "value": 3.0}]}
    copy = {"floor": False, "skill": rows, "repw": {"sampled": [{"h": 1, "value": 2.0}]}}
    said = verdict(
        {
            "forecasters": {
                "persistence": copy,
                "tipl": {"floor": False, "skill": rows, "repw": repw},
            }
        }
    )
    assert f"TIPL {word} copying the last weights" in said
    assert "larger (1.5 times the copy's)" in said


def test_runs_shorter_than_the_horizon_are_refused(small_dataset: Path, tmp_path: Path) -> None:
    config = EvaluateConfig(data=small_dataset, out=tmp_path, max_horizon=49)
    with pytest.raises(EvaluateError, match="more than 49 snapshots"):
        evaluate([], config)


def test_baselines_are_saved_and_loaded(tmp_path: Path) -> None:
    for forecaster in (Persistence(), Reconstruction(7)):
        forecaster.save(tmp_path / forecaster.name)
        assert type(forecaster).load(tmp_path / forecaster.name) == forecaster
