from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import weighttraj as wt
from tests.small import SMALL_RECIPE
from tipl import (
    EvaluateConfig,
    Persistence,
    Reconstruction,
    TrainConfig,
    change,
    evaluate,
    load,
    train,
)
from tipl.checks.copies import run_like
from tipl.cli import main
from tipl.errors import EvaluateError
from tipl.evaluation import measure
from tipl.evaluation.leaderboard import leaderboard
from tipl.evaluation.parts import Parts
from tipl.evaluation.rows import read_rows
from tipl.evaluation.starts import (
    Starts,
    _sample,
    at_boundary,
    learning_phase,
    shares,
    starts_of,
)
from tipl.evaluation.statistics import Bootstrap, interquartile_mean, mean, ratio_of_sums
from tipl.evaluation.summary import Summary
from tipl.evaluation.weights import squared_errors
from tipl.saved import fingerprint
from weighttraj.collect import collect
from weighttraj.collect.settings import Seeds
from weighttraj.format import DatasetInfo, RunEntry
from weighttraj.policies import ReturnsConfig, fill_returns
from weighttraj.policies import evaluate as play
from weighttraj.store.catalog import read_dataset_info, write_dataset_info

ROOT = Path(__file__).parents[2]
SMALL = {
    "horizons": (1, 2, 3),
    "return_horizons": (1, 3),
    "learning_starts": 2,
    "plateau_starts": 1,
    "episodes": 3,
    "bootstrap": 200,
}


@pytest.fixture(scope="module")
def data(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs with returns."""
    path = tmp_path_factory.mktemp("evaluate") / "data"
    shutil.copytree(small_dataset, path)
    fill_returns(path, ReturnsConfig(episodes=2, every=6))
    return path


@pytest.fixture(scope="module")
def model(data: Path) -> Path:
    """A model trained for a moment."""
    out = data.with_name("tipl")
    sizes = {"rank": 8, "block_size": 5, "n_layer": 1, "n_embd": 16}
    train(change(TrainConfig(data=data, out=out), n_batches=20, warmup=5, **sizes))
    return out


@pytest.fixture(scope="module")
def config(data: Path) -> EvaluateConfig:
    return EvaluateConfig(data=data, out=data.with_name("results"), **SMALL)


@pytest.fixture(scope="module")
def results(model: Path, config: EvaluateConfig) -> dict[str, Any]:
    """Its evaluation."""
    evaluate([load(model)], config)
    document: dict[str, Any] = json.loads((config.out / "results.json").read_text())
    return document


def unseen(data: Path) -> wt.Run:
    return wt.open(data).split("test").runs[0]


# Weights


def test_skill_is_computed_as_it_says(results: dict[str, Any], data: Path) -> None:
    skills = results["forecasters"]["reconstruction-8"]["skill"]
    sums, ratios, of_tensors = np.zeros((2, 2)), [], []
    for run in wt.open(data).split("test"):
        weights = run.weights[:].astype(np.float64)
        starts = np.arange(49 - 3)
        floor = Reconstruction(8).forecast(run, starts.tolist(), [2])[:, 0]
        error = (floor - weights[starts + 2]) ** 2
        copy = (weights[starts] - weights[starts + 2]) ** 2
        crosses = run.iteration[starts + 1] != run.iteration[starts]
        for row, chosen in enumerate((np.ones(46, bool), crosses)):
            sums[row] += error[chosen].sum(), copy[chosen].sum()
        ratios.append((1 - error.sum(1) / copy.sum(1)).mean())
        of_tensors.append(
            [(error[:, p.slice].sum(), copy[:, p.slice].sum()) for p in run.layout.params]
        )
    by_tensor = np.sum(of_tensors, axis=0)
    expected = {
        ("ratio_of_sums", "all"): 1 - sums[0, 0] / sums[0, 1],
        ("ratio_of_sums", "boundary"): 1 - sums[1, 0] / sums[1, 1],
        ("mean_of_ratios", "all"): np.mean(ratios),
        ("tensors_equal", "all"): (1 - by_tensor[:, 0] / by_tensor[:, 1]).mean(),
    }
    for (aggregate, kind), value in expected.items():
        row = skills[aggregate][kind][1]
        assert row["h"] == 2
        assert row["value"] == pytest.approx(value, rel=1e-3), (aggregate, kind)
        assert row["low"] <= row["value"] <= row["high"]


def test_persistence_is_the_zero_of_every_skill(results: dict[str, Any], data: Path) -> None:
    scores = results["forecasters"]["persistence"]
    for rows in (*_lists(scores["skill"]), *_lists(scores["function_skill"])):
        assert [row["value"] for row in rows] == [0, 0, 0]
    errors = []
    for run in wt.open(data).split("test"):
        weights = run.weights[:].astype(np.float64)
        starts = np.arange(49 - 3)
        errors.append(((weights[starts + 2] - weights[starts]) ** 2).mean())
    assert scores["wpe"][1]["value"] == pytest.approx(np.mean(errors), rel=1e-6)


def _lists(found: Any) -> list[list[dict[str, Any]]]:
    return [found] if isinstance(found, list) else [x for y in found.values() for x in _lists(y)]


def test_chunks_do_not_move_the_errors(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = (Reconstruction(4), unseen(data), np.arange(40), [1, 3])
    whole = squared_errors(*arguments, lambda _: None)["squared"]
    monkeypatch.setattr("tipl.evaluation.weights.MAX_BYTES", 122 * 2 * 4 * 7)
    done: list[int] = []
    parts = squared_errors(*arguments, done.append)["squared"]
    assert done == [7] * 5 + [5]
    np.testing.assert_array_equal(parts, whole)
    assert whole.shape == (40, 2, 7)


def test_divergence_is_that_of_the_distributions(data: Path, tmp_path: Path) -> None:
    """Against each policy's own distribution, one by one."""
    run = unseen(data)
    task = measure.Task(
        path=run.path,
        forecasters=(Persistence(),),
        config=EvaluateConfig(data=data, out=data, **SMALL),
    )
    found = measure.measure(task, lambda *_: None)
    for start in (0, 17):
        for i, h in enumerate((1, 2, 3)):
            inputs = torch.from_numpy(
                run["probe/observations"][max(0, run.iteration[start + h] - 1)]
            )
            true, copy = (run.load_policy(t).distribution(inputs) for t in (start + h, start))
            expected = torch.distributions.kl_divergence(true, copy).sum(-1).mean()
            kl = found.functions["persistence"]["kl"][start, i]
            assert kl == pytest.approx(float(expected), rel=1e-3, abs=1e-9)


# Starts


def test_boundaries_are_where_new_data_arrive(data: Path) -> None:
    run = unseen(data)
    crossing = np.flatnonzero(at_boundary(run, np.arange(48)))
    assert crossing.tolist() == list(range(0, 48, 4))  # 4 snapshots an iteration


def test_the_learning_phase_ends_when_most_is_learned(data: Path) -> None:
    run = unseen(data)
    mean_return = run.mean_return(deterministic=False)
    rows = np.flatnonzero(np.isfinite(mean_return))
    end = learning_phase(run)
    assert end in rows
    final = np.median(mean_return[rows[-2:]])
    before = mean_return[rows[rows < end]] - mean_return[0]
    assert (before < 0.95 * (final - mean_return[0])).all()


def test_starts_leave_room_for_every_horizon(data: Path) -> None:
    config = EvaluateConfig(data=data, out=data, horizons=(1, 20), return_horizons=(1, 5))
    starts = starts_of(unseen(data), config)
    assert starts.weights.tolist() == list(range(49 - 20))
    assert starts.learning.max() < starts.plateau.min()
    assert starts.plateau.max() == 48 - 5
    few = starts_of(unseen(data), replace(config, starts=3, learning_starts=0))
    assert few.weights.tolist() == [0, 14, 28]
    assert not len(few.learning)
    some = starts_of(unseen(data), replace(config, starts=12, learning_starts=0))
    assert some.weights.tolist() == [0, 1, 2, 3, 6, 9, 12, 16, 19, 22, 25, 28]


def test_few_starts_stand_for_all() -> None:
    """Each for the moments around it, so that sums over starts are of the same size."""
    assert shares(np.array([0, 1, 2, 6])).tolist() == [1, 1, 2.5, 2.5]
    assert shares(np.arange(9)).tolist() == [1] * 9
    moments = np.arange(1700)
    error = 1e-3 + np.exp(-moments / 20)  # long steps at the start
    for count, near in ((60, 0.15), (300, 0.001)):
        starts = _sample(1699, count)
        assert len(np.unique(starts)) == count
        assert shares(starts).sum() == 1700
        estimate = (shares(starts) * error[starts]).sum()
        assert estimate == pytest.approx(error.sum(), rel=near)


# Statistics


def test_intervals_resample_runs() -> None:
    bootstrap = Bootstrap(resamples=1000, seed=0)
    one = bootstrap.interval(ratio_of_sums, np.array([[1.0]]), np.array([[4.0]]))
    assert one == [{"value": 0.25, "low": None, "high": None}]
    two = bootstrap.interval(ratio_of_sums, np.array([[1.0], [6.0]]), np.array([[4.0], [4.0]]))
    assert two == [{"value": 7 / 8, "low": 0.25, "high": 1.5}]
    (row,) = bootstrap.interval(mean, np.array([[1.0], [np.nan], [3.0]]))
    assert row["value"] == 2


def test_a_known_interval_is_covered_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for i in range(200):
        sample = rng.normal(1.0, 1.0, size=(30, 1))
        (row,) = Bootstrap(resamples=200, seed=i).interval(mean, sample)
        hits += row["low"] <= 1.0 <= row["high"]  # type: ignore[operator]
    assert 0.88 <= hits / 200 <= 0.98


def test_the_interquartile_mean_is_the_middle_half() -> None:
    values = np.arange(8.0)
    assert interquartile_mean(values) == np.mean([2, 3, 4, 5])
    # 5 values: the middle 2.5, those at the edges by a part
    assert interquartile_mean(np.arange(5.0)) == pytest.approx((0.75 * 1 + 2 + 0.75 * 3) / 2.5)


# Returns


def test_returns_are_of_the_right_policies(results: dict[str, Any], config: EvaluateConfig) -> None:
    run = unseen(config.data)
    starts = starts_of(run, config)
    at = [*starts.learning.tolist(), *starts.plateau.tolist()]
    copy = results["forecasters"]["persistence"]
    for mode in ("deterministic", "sampled"):
        found = copy["scatter"][mode][0]
        expected = {
            t: play(run.load_policy(t), run, episodes=3, deterministic=mode == "deterministic")
            for t in {*at, *(t + h for t in at for h in (1, 3))}
        }
        values = {t: round(float(e.returns.mean()), 1) for t, e in expected.items()}
        assert found["true"] == pytest.approx([values[t + h] for t in at for h in (1, 3)], abs=0.11)
        assert found["forecast"] == pytest.approx([values[t] for t in at for h in (1, 3)], abs=0.11)


def test_gain_is_zero_for_the_copy_and_one_for_the_truth(results: dict[str, Any]) -> None:
    for mode in ("sampled", "held", "deterministic"):
        for row in results["forecasters"]["persistence"]["gain"][mode]:
            assert row["value"] in (0, None)
            assert row["forecast"] == row["now"]
        floor = results["forecasters"]["reconstruction-8"]["gain"][mode]
        assert [row["h"] for row in floor] == [1, 3]


def test_repw_is_compared_with_the_copys_run_by_run(data: Path) -> None:
    """Errors 1.5 times that of persistence in each run, up to h = 10 and while it learns."""
    gaps = np.array([1.0, 7.0, 40.0])[:, None, None, None] * np.ones((3, 3, 3, 3))
    factor = np.full((3, 3, 3), 1.5)  # mode, start, horizon
    factor[:, 2] = factor[..., 2] = 100  # the plateau; h = 20
    measured = [
        measure.Measured(
            run=str(i),
            starts=Starts(weights=np.arange(4), learning=np.array([1, 2]), plateau=np.array([3])),
            boundary=np.zeros(4, bool),
            function_starts=np.zeros(0, int),
            function_boundary=np.zeros(0, bool),
            tensors=np.array([2]),
            weights={name: {"squared": np.ones((4, 2, 1))} for name in ("copy", "model")},
            functions={},
            true={"now": np.zeros((3, 3)), "later": gap, "fresh": gap[..., :1]},
            returns={"copy": {"forecast": 0 * gap}, "model": {"forecast": gap * (1 + factor)}},
        )
        for i, gap in enumerate(gaps)
    ]
    config = EvaluateConfig(data=data, out=data, horizons=(1, 2), return_horizons=(1, 3, 20))
    found = Summary(measured, config, "copy")._repw_ratio("model")
    for mode in ("sampled", "held", "deterministic"):
        row = found[mode]
        assert [row.value, row.low, row.high] == pytest.approx([1.5] * 3)
    still = Summary(measured, config, "model")._repw_ratio("copy")["sampled"]
    assert still.value == pytest.approx(1 / 1.5)


def test_results_say_which_bytes_were_judged(results: dict[str, Any], model: Path) -> None:
    marks = {name: scores["fingerprint"] for name, scores in results["forecasters"].items()}
    assert marks["tipl"] == fingerprint(load(model))
    assert len(set(marks.values())) == len(marks)


def test_held_noise_is_that_of_the_start(data: Path) -> None:
    from tipl.evaluation.returns import hold_log_std

    run = unseen(data)
    held = hold_log_std(run, run.weights[30:33], np.array([3, 4, 5]))
    place = run.layout["log_std"].slice
    assert np.array_equal(held[:, place], run.weights[3:6][:, place])
    rest = np.delete(np.arange(122), place)
    assert np.array_equal(held[:, rest], run.weights[30:33][:, rest])


# What is kept


def test_nothing_is_measured_twice(
    results: dict[str, Any], model: Path, config: EvaluateConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    real = Parts.get

    def get(self: Parts, name: str, source: Any, function: Any) -> Any:
        return real(self, name, source, lambda: made.append(name) or function())

    monkeypatch.setattr(Parts, "get", get)
    evaluate([load(model)], config)
    assert made == []
    assert json.loads((config.out / "results.json").read_text()) == results
    victim = config.out / "parts/weights/persistence/seed0002.npz"
    victim.write_bytes(victim.read_bytes()[:200])  # as a full disk leaves it
    evaluate([load(model)], config)
    assert json.loads((config.out / "results.json").read_text()) == results
    assert made == ["weights/persistence/seed0002"]


@pytest.mark.parametrize("scheduler", [None, "local"], ids=["processes", "cluster"])
def test_processes_and_clusters_find_the_same(
    scheduler: str | None,
    results: dict[str, Any],
    model: Path,
    config: EvaluateConfig,
    tmp_path: Path,
) -> None:
    evaluate([load(model)], replace(config, out=tmp_path), workers=2, scheduler=scheduler)
    assert json.loads((tmp_path / "results.json").read_text()) == results


# Pages


def test_the_page_stands_alone_and_says_who_wins(
    results: dict[str, Any], config: EvaluateConfig
) -> None:
    page = (config.out / "report.html").read_text()
    assert page.count("<svg") == 5
    assert "TIPL, which uses the future of the run, has" in page
    for outside in ('src="http', 'href="http', "<script", "@import"):
        assert outside not in page
    pictures = list(config.out.glob("*.png"))
    assert len(pictures) == 5
    assert all(picture.stat().st_size > 10_000 for picture in pictures)


# Bad input


def test_runs_that_are_too_short_are_refused(data: Path, tmp_path: Path) -> None:
    config = EvaluateConfig(data=data, out=tmp_path, **SMALL | {"horizons": (49,)})
    with pytest.raises(EvaluateError, match="--horizons of at most 24"):
        evaluate([], config)


def test_horizons_beyond_half_a_run_are_left_out(data: Path, tmp_path: Path) -> None:
    small = SMALL | {"horizons": (1, 24, 25), "learning_starts": 0, "function_starts": 0}
    found = evaluate([], EvaluateConfig(data=data, out=tmp_path, **small))
    assert found.horizons == (1, 24)
    assert not found.forecasters["persistence"].gain


def test_runs_of_different_lengths_are_judged_together(data: Path, tmp_path: Path) -> None:
    run = unseen(data)
    shorter = run_like(run, run.weights[:40], tmp_path / "data/runs")
    longer = run_like(run, run.weights[:], tmp_path / "data/runs")
    entries = [
        RunEntry(id=one.id, path=f"runs/{one.path.name}", split="test") for one in (shorter, longer)
    ]
    info = DatasetInfo(id="uneven", runs=tuple(entries), status="complete")
    write_dataset_info(tmp_path / "data", info)
    few = SMALL | {"learning_starts": 0, "function_starts": 0}
    trend = load("trend-5")
    found = evaluate([trend], EvaluateConfig(data=tmp_path / "data", out=tmp_path, **few))
    error, copy = np.zeros(3), np.zeros(3)
    for one in (shorter, longer):
        starts = np.arange(len(one) - 3)
        true = one.weights[:].astype(np.float64)[starts[:, None] + np.array([1, 2, 3])]
        error += ((trend.forecast(one, starts.tolist(), [1, 2, 3]) - true) ** 2).sum((0, 2))
        copy += ((one.weights[:][starts][:, None] - true) ** 2).sum((0, 2))
    rows = found.forecasters["trend-5"].skill["ratio_of_sums"]["all"]
    np.testing.assert_allclose([row.value for row in rows], 1 - error / copy, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizons": ()}, "horizons empty"),
        ({"horizons": (0,)}, "horizons 0"),
        ({"starts": 0}, "starts of at least 1"),
        ({"bootstrap": 0}, "bootstrap 0"),
        ({"return_horizons": (5000,)}, "--return-horizons of at most 24"),
    ],
)
def test_impossible_settings_are_refused_before_anything_is_measured(
    data: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    config = EvaluateConfig(data=data, out=tmp_path / "out", **SMALL | change)
    with pytest.raises(EvaluateError, match=message):
        evaluate([], config)
    assert not config.out.exists()


def test_a_quick_look_keeps_a_horizon() -> None:
    config = EvaluateConfig(data="", out=Path(), quick=True, return_horizons=(20,))
    assert config.bounded().return_horizons == (20,)


def test_runs_without_returns_are_refused(small_dataset: Path, tmp_path: Path) -> None:
    config = EvaluateConfig(data=small_dataset, out=tmp_path / "out", **SMALL)
    with pytest.raises(EvaluateError, match=r"(?s)no returns.*--learning-starts 0"):
        evaluate([], config)
    assert not (tmp_path / "out").exists()


def test_runs_without_observations_are_refused(tmp_path: Path) -> None:
    recipe = replace(SMALL_RECIPE, store=replace(SMALL_RECIPE.store, probe_observations=0))
    collect(replace(recipe, seeds=Seeds(train=[0], test=[1])), tmp_path / "data")
    small = SMALL | {"learning_starts": 0}
    config = EvaluateConfig(data=tmp_path / "data", out=tmp_path / "out", **small)
    with pytest.raises(EvaluateError, match=r"(?s)no stored observations.*--function-starts 0"):
        evaluate([], config)


def test_runs_of_other_policies_are_refused(small_dataset: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(small_dataset, data)
    other = replace(
        SMALL_RECIPE,
        ppo=replace(SMALL_RECIPE.ppo, net_arch=(4,)),
        seeds=Seeds(train=[7], test=[8]),
    )
    collect(other, tmp_path / "other")
    (entry,) = (run for run in read_dataset_info(tmp_path / "other").runs if run.seed == 8)
    shutil.copy(tmp_path / "other" / entry.path, data / entry.path)
    info = read_dataset_info(data)
    write_dataset_info(data, replace(info, runs=(*info.runs, entry)))
    config = EvaluateConfig(data=data, out=tmp_path / "out", **SMALL)
    with pytest.raises(EvaluateError, match=r"(?s)different structure.*122 parameters.*26 param"):
        evaluate([], config)


def test_equal_names_are_refused(model: Path, config: EvaluateConfig) -> None:
    with pytest.raises(EvaluateError, match="the same name"):
        evaluate([load(model), load(model)], config)


# Forecasters of strangers


class Stranger(Persistence):
    """A forecaster that does something odd."""

    def __init__(self, name: str, forecast: Callable[[np.ndarray], Any]) -> None:
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "_change", forecast)

    def forecast(self, run: wt.Run, starts: Sequence[int], horizons: Sequence[int]) -> Any:
        return self._change(super().forecast(run, starts, horizons))  # type: ignore[attr-defined]


def _raise(_: np.ndarray) -> None:
    raise ZeroDivisionError("nothing to divide by")


ODD: dict[str, tuple[Callable[[np.ndarray], Any], str]] = {
    "raises": (_raise, "ZeroDivisionError: nothing to divide by"),
    "nan": (lambda found: found * np.nan, "NaN from"),
    "shape": (lambda found: found[:, :1], "float32 (start, horizon, param)"),
    "nothing": (lambda found: None, "object"),
}


def test_a_forecaster_that_fails_is_named_and_the_others_go_on(
    config: EvaluateConfig, tmp_path: Path
) -> None:
    odd = [Stranger(name, change) for name, (change, _) in ODD.items()]
    config = replace(config, out=tmp_path / "out")
    results = evaluate([*odd, load("trend-5")], config)
    assert set(results.forecasters) == {"persistence", "trend-5"}
    assert set(results.failed) == set(ODD)
    for name, (_, what) in ODD.items():
        assert what in results.failed[name]
    rows = read_rows(config.out / "rows.csv")
    assert {row.forecaster for row in rows} == {"persistence", "trend-5"}
    with pytest.raises(EvaluateError, match="no forecaster could be evaluated"):
        evaluate(odd[:1], replace(config, out=tmp_path / "other"))


def test_rows_give_the_figures_of_the_results(
    results: dict[str, Any], config: EvaluateConfig
) -> None:
    board = leaderboard(read_rows(config.out / "rows.csv"), resamples=10)
    known = results["forecasters"]["tipl"]
    figures = {
        "skill": known["skill"]["ratio_of_sums"]["all"],
        "function skill": known["function_skill"]["all"],
        "gain": known["gain"]["held"],
    }
    scores = {(s.measure, s.horizon, s.forecaster): s.score.value for s in board.scores}
    for kind, rows in figures.items():
        for row in rows:
            expected = row["value"]
            if expected is not None:  # some gain: no training earned anything
                expected = pytest.approx(expected, rel=1e-6)
            assert scores.get((kind, row["h"], "tipl")) == expected
    oracles = {row.forecaster for row in read_rows(config.out / "rows.csv") if row.oracle}
    assert oracles == {"reconstruction-8"}


def test_several_data_sets_become_one_leaderboard(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    shutil.copytree(data, other)
    write_dataset_info(other, replace(read_dataset_info(other), id="other-v1"))
    options = "--horizons 1 2 --learning-starts 0 --function-starts 0 --bootstrap 50"
    call = ["tipl", "evaluate", "trend-5", "last-iteration", "--data", str(data), str(other)]
    monkeypatch.setattr("sys.argv", [*call, *options.split(), "--out", str(tmp_path / "all")])
    main()
    board = ["tipl", "leaderboard", str(tmp_path / "all"), "--out", str(tmp_path / "board")]
    monkeypatch.setattr("sys.argv", [*board, "--rival", "trend-5", "--bootstrap", "50"])
    main()
    assert "leaderboard: " in capsys.readouterr().out
    text = (tmp_path / "board/leaderboard.md").read_text()
    assert "| trend-5 | 2 | " in text
    assert text.count("| persistence | 2 | 0.00 [0.00, 0.00] |") == 2
