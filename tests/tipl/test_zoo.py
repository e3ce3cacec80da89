"""Forecasters by name and by folder, the command that fits the baselines, and what is released."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

import weighttraj as wt
from tipl import (
    TIPL,
    EvaluateConfig,
    Reconstruction,
    TrainConfig,
    change,
    cli,
    evaluate,
    load,
    train,
)
from tipl.checks.results import read_checks
from tipl.commands.zoo import listed
from tipl.errors import EvaluateError, ForecastError, ModelError
from tipl.evaluation.results import read_results
from tipl.models.baselines import Extrapolation, Slope
from tipl.models.gate import GateTrainConfig, train_gate
from tipl.models.stretched import Stretched
from tipl.models.tipl import TIPLConfig
from tipl.models.tipl.network import GPT, GPTConfig
from tipl.registry import MODELS, names, unfitted
from tipl.report.markdown import places
from tipl.report.scores import SKILL
from tipl.saved import fingerprint
from tipl.zoo.card import facts, metrics_of, ranges, refreshed, write_card
from tipl.zoo.metrics import read_metrics
from tipl.zoo.release import LINES, MOST, release, task_scores, thinned
from weighttraj.store.catalog import read_dataset_info, write_dataset_info

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", unfitted())
def test_what_needs_no_fit_is_loaded_by_name(name: str) -> None:
    assert load(name).name == name


def test_fitted_baselines_are_loaded_by_folder(
    small_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["tipl", "train", "baselines", "--data", str(small_dataset), "--out", str(tmp_path)]
    command += ["--steps", "20", "--horizons", "1", "5", "20"]
    monkeypatch.setattr(sys, "argv", command)
    before = signal.getsignal(signal.SIGTERM)
    cli.main()
    assert signal.getsignal(signal.SIGTERM) is before  # forked processes inherit it
    said = capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    assert {"persistence", "ar-20-phase", "wnn"} < names
    assert all(load(tmp_path / name).name == name for name in names)
    assert f"{len(names)} baselines in {tmp_path}" in said
    settings = json.loads((tmp_path / "wnn/train.json").read_text())
    assert (settings["horizons"], settings["steps"]) == ([1, 5, 20], 20)
    assert list(settings["runs"]) == [run.id for run in wt.open(small_dataset).split("train")]


def test_a_name_that_nobody_has_is_refused() -> None:
    with pytest.raises(ForecastError, match=r"there is no such forecaster(.|\n)*tipl train"):
        load("crystal-ball")


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"kind": "crystal ball"}')
    with pytest.raises(ModelError, match="crystal ball"):
        load(tmp_path)
    (tmp_path / "config.json").write_text("[]")
    with pytest.raises(ModelError, match="the folder holds no forecaster"):
        load(tmp_path)


def test_a_floor_is_saved_and_loaded(tmp_path: Path) -> None:
    Reconstruction(7).save(tmp_path)
    assert load(tmp_path) == Reconstruction(7)


# Releases


@pytest.fixture(scope="module")
def trained(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model trained for a moment, with a log."""
    out = tmp_path_factory.mktemp("trained") / "model"
    sizes = {"rank": 8, "block_size": 5, "n_layer": 1, "n_embd": 16}
    train(change(TrainConfig(data=small_dataset, out=out), n_batches=20, warmup=5, **sizes))
    return out


@pytest.fixture(scope="module")
def results(trained: Path, small_dataset: Path) -> Path:
    """What it is worth, in weights."""
    out = trained.with_name("results")
    few = {"horizons": (1, 10), "learning_starts": 0, "function_starts": 0, "bootstrap": 50}
    evaluate([load(trained), load("ema-0.9")], EvaluateConfig(data=small_dataset, out=out, **few))
    return out / "results.json"


@pytest.fixture(scope="module")
def checks(trained: Path, small_dataset: Path) -> Path:
    """What it passes, by the command."""
    file = trained.with_name("checks.json")
    command = ["tipl", "check", trained, "--data", small_dataset, "--out", file]
    command += ["--horizons", 1, 10, "--null-batches", 5, "--null-walks", 3]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(word) for word in command])
        cli.main()
    return file


@pytest.fixture
def zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty zoo in the place of the package's."""
    folder = tmp_path / "zoo"
    monkeypatch.setattr("tipl.registry.MODELS", folder)
    assert names() == []
    return folder


def test_a_released_model_is_loaded_by_name(trained: Path, zoo: Path, small_dataset: Path) -> None:
    release(trained, "tipl-small")
    assert names() == ["tipl-small"]
    model = load("tipl-small")
    assert model.name == "tipl-small"
    run = wt.open(small_dataset).split("test").runs[0]
    assert np.array_equal(
        model.forecast(run, [10, 20], [1, 5]), load(trained).forecast(run, [10, 20], [1, 5])
    )
    assert listed("tipl-small") == ("tipl-small", "tipl", "-", "-", "-", "-", "-")
    with pytest.raises(ModelError, match="no released model of this name with results"):
        metrics_of("tipl-small")


def test_a_folder_comes_before_the_zoo(
    trained: Path, zoo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release(trained, "tipl-small")
    Reconstruction(3).save(tmp_path / "tipl-small")
    monkeypatch.chdir(tmp_path)
    assert load("tipl-small") == Reconstruction(3)


def test_metrics_say_everything(trained: Path, zoo: Path, results: Path, checks: Path) -> None:
    out = release(trained, "tipl-small", results=results, checks=checks)
    assert {path.name for path in out.iterdir()} == {
        "config.json",
        "model.safetensors",
        "metrics.json",
    }
    found = read_metrics(out)
    assert found is not None
    assert (found.name, found.kind, found.causal) == ("tipl-small", "tipl", False)
    assert found.trained_on is not None
    (data,) = found.trained_on
    assert data.runs == ("seed0000", "seed0001")
    assert (data.data, data.every, data.environment) == ("small", 2, "InvertedPendulum-v4")
    assert found.results.runs == ("seed0002", "seed0003")
    evaluated = read_results(results).forecasters
    assert set(found.results.forecasters) == set(evaluated)
    assert SKILL(found.scores) == SKILL(evaluated["model"])
    assert found.settings["rank"] == 8
    assert not {"out", "data", "runs"} & set(found.settings)
    assert [line["batch"] for line in found.log] == [20]
    assert found.checks == read_checks(checks)
    assert str(trained) not in (out / "metrics.json").read_text().replace(found.checks.command, "")
    line = listed("tipl-small")
    assert line[:4] == ("tipl-small", "tipl", "no", "small")
    assert "[" in line[4]  # an interval


def test_results_of_other_bytes_are_refused(
    trained: Path, zoo: Path, results: Path, checks: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(trained, other)
    arrays = load_file(other / "model.safetensors")
    arrays["head.bias"][0] += 1e-6
    save_file(arrays, other / "model.safetensors")
    with pytest.raises(ModelError, match=r"not of this model(.|\n)*tipl evaluate other ..."):
        release(other, "other", results=results)
    release(trained, "tipl-small", results=results)
    document = json.loads(results.read_text())
    (tmp_path / "train.json").write_text(json.dumps(document | {"split": "train"}))
    with pytest.raises(ModelError, match="runs that it has not seen"):
        release(trained, "tipl-small", results=tmp_path / "train.json")
    wrong = json.loads(checks.read_text()) | {"fingerprint": "0"}
    (tmp_path / "checks.json").write_text(json.dumps(wrong))
    with pytest.raises(ModelError, match="the checks are not of this model"):
        release(trained, "tipl-small", results=results, checks=tmp_path / "checks.json")
    assert names() == ["tipl-small"]
    # What was refused changed nothing; a new draft of the same bytes keeps the figures, and one of
    # others has none.
    with pytest.raises(ModelError, match="not of this model"):
        release(other, "tipl-small", results=results)
    release(trained, "tipl-small")
    found = read_metrics(zoo / "tipl-small")
    assert found is not None
    release(other, "tipl-small")
    assert read_metrics(zoo / "tipl-small") is None


def test_what_lies_in_the_zoo_can_be_judged_anew(
    trained: Path, zoo: Path, results: Path, checks: Path, tmp_path: Path
) -> None:
    out = release(trained, "tipl-small", results=results, checks=checks)
    first = read_metrics(out)
    document = json.loads(results.read_text())
    anew = tmp_path / "anew.json"
    anew.write_text(json.dumps(document | {"runs": ["seed0003"]}))
    release(out, "tipl-small", results=anew)
    found = read_metrics(out)
    assert first is not None
    assert found == replace(
        first, results=msgspec.structs.replace(first.results, runs=("seed0003",))
    )


def test_what_goes_along_another_is_released_with_it(zoo: Path, tmp_path: Path) -> None:
    Stretched(Extrapolation(Slope(5)), {1: 2.0}).save(tmp_path / "further")
    release(tmp_path / "further", "trend-5-stretched")
    found = load("trend-5-stretched")
    assert isinstance(found, Stretched)
    assert (found.along, found.amplitudes) == (Extrapolation(Slope(5)), {1: 2.0})


def big(folder: Path, n_embd: int) -> TIPL:
    """An untrained model of some size, in a folder."""
    torch.manual_seed(0)
    gpt = GPTConfig(rank=8, max_timestep=100, block_size=5, n_embd=n_embd)
    model = TIPL(GPT(gpt), TIPLConfig(gpt=gpt, every=2))
    model.save(folder)
    return model


def test_a_large_model_is_rounded_and_is_float32_again(
    zoo: Path, tmp_path: Path, small_dataset: Path
) -> None:
    model = big(tmp_path / "big", 160)
    assert (tmp_path / "big/model.safetensors").stat().st_size > MOST
    out = release(tmp_path / "big", "big")
    stored = load_file(out / "model.safetensors")
    assert {str(array.dtype) for array in stored.values()} == {"float16", "float32"}
    assert all(array.dtype == np.float32 for array in stored.values() if array.ndim == 1)
    assert (out / "model.safetensors").stat().st_size < MOST
    loaded = load("big")
    assert isinstance(loaded, TIPL)
    assert {p.dtype for p in loaded.network.state_dict().values()} == {torch.float32}
    run = wt.open(small_dataset).split("test").runs[0]
    rounded, exact = (m.forecast(run, [10], [1, 5]) for m in (loaded, model))
    assert not np.array_equal(rounded, exact)
    np.testing.assert_allclose(rounded, exact, atol=0.02 * np.abs(exact).max())
    release(tmp_path / "big", "big")  # the same bytes
    assert all(
        np.array_equal(v, stored[k]) for k, v in load_file(out / "model.safetensors").items()
    )


def test_what_is_judged_before_it_is_rounded_is_refused(
    zoo: Path, tmp_path: Path, small_dataset: Path
) -> None:
    model = big(tmp_path / "big", 160)
    few = {"horizons": (1,), "learning_starts": 0, "function_starts": 0, "bootstrap": 10}

    def judged(forecaster: Any, out: Path) -> Path:
        evaluate([forecaster], EvaluateConfig(data=small_dataset, out=out, starts=5, **few))
        return out / "results.json"

    with pytest.raises(ModelError, match="not of this model"):
        release(tmp_path / "big", "big", results=judged(model, tmp_path / "early"))
    release(tmp_path / "big", "big")
    out = release(tmp_path / "big", "big", results=judged(load("big"), tmp_path / "late"))
    assert read_metrics(out) is not None


def test_a_model_that_is_too_large_is_refused(zoo: Path, tmp_path: Path) -> None:
    big(tmp_path / "big", 256)
    with pytest.raises(ModelError, match="too large for the zoo"):
        release(tmp_path / "big", "big")
    assert names() == []


@pytest.mark.parametrize("name", ["../up", "Upper", "ema-0.9", ""])
def test_bad_names_are_refused(name: str, trained: Path, zoo: Path) -> None:
    with pytest.raises(ModelError, match="cannot be called this"):
        release(trained, name)


def test_a_log_is_thinned_evenly_on_a_logarithmic_scale(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    lines = [{"batch": n, "wpe": 1 / n, "batches_per_s": 3.0} for n in range(1, 501)]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    found = thinned(log)
    batches = [line["batch"] for line in found]
    assert 50 < len(batches) <= LINES
    assert (batches[0], batches[-1]) == (1, 500)
    assert batches == sorted(set(batches))
    assert batches[len(batches) // 2] < 100
    assert found[0] == {"batch": 1, "wpe": 1.0}
    log.write_text("".join(json.dumps(line) + "\n" for line in lines[:7]))
    assert [line["batch"] for line in thinned(log)] == [1, 2, 3, 4, 5, 6, 7]  # short: all
    assert thinned(tmp_path / "nothing.jsonl") == []


# Cards


def test_a_card_keeps_its_prose(
    trained: Path, zoo: Path, results: Path, checks: Path, tmp_path: Path
) -> None:
    release(trained, "tipl-small", results=results, checks=checks)
    card = write_card("tipl-small", tmp_path / "cards")
    text = card.read_text()
    assert text.startswith("---\nlicense: mit\n")
    assert "## Our choices" in text
    assert 'datasets:\n- "small"\n' in text
    assert {place.section for place in places(text) if not place.empty} == {
        "summary",
        "baselines",
        "checks",
        "training",
        "commands",
    }
    assert (card.parent / "tipl-small.svg").read_text().count("<svg") == 1
    assert not [line for line in text.splitlines() if line.endswith("{{") or "{%" in line]
    headings = [line for line in text.split("\n\n") if line.startswith("#")]
    after = [text.split(f"{head}\n\n", 1)[1] for head in headings if "\n" not in head]
    assert not any(rest.startswith("#") for rest in after)
    mine = text.replace("## Limits", "Prose by hand.\n\n## Limits")
    stale = mine.replace("trained on: `small`", "trained on: `other`")
    assert stale != mine
    card.write_text(stale)
    write_card("tipl-small", tmp_path / "cards")
    assert card.read_text() == mine


def test_what_was_not_measured_leaves_no_heading(
    trained: Path, zoo: Path, results: Path, tmp_path: Path
) -> None:
    release(trained, "tipl-small", results=results, log=False)
    metrics = metrics_of("tipl-small")
    assert facts(metrics, "checks") == ""
    text = write_card("tipl-small", tmp_path / "cards").read_text()
    assert "Six checks" not in text
    assert not list((tmp_path / "cards").glob("*.svg"))
    assert "![" not in text


def test_the_card_of_amplitudes_shows_what_chose_them(
    trained: Path, zoo: Path, results: Path
) -> None:
    release(trained, "tipl-small", results=results)
    metrics = replace(
        metrics_of("tipl-small"),
        kind="drift",
        settings={"episodes": 3, "of_gate": {"width": 16, "horizons": [1, 5]}},
        log=[
            {"amplitude": 1.5, "gain_1": 0.25, "gain_5": 1.0},
            {"amplitude": 8, "gain_1": 2.0, "gain_5": -0.5},
        ],
    )
    training, commands = (facts(metrics, section) for section in ("training", "commands"))
    assert "| amplitude | h = 1 | h = 5 |" in training
    assert "| 1.5 | 0.25 | **1.00** |" in training
    assert "| 8 | **2.00** | -0.50 |" in training
    assert "Settings of the network: width 16" in training
    assert "![" not in training
    _, gate, drift, judged, _ = commands.splitlines()
    assert gate == "tipl train gate --data small --out GATE --width 16 --horizons 1 5"
    assert drift == "tipl train stretched --along GATE --data small --out FOLDER --episodes 3"
    assert judged == metrics.results.command


@pytest.mark.parametrize(
    ("runs", "told"),
    [
        ([f"seed{n:04}" for n in range(8, 12)], "seed0008 to seed0011"),
        (["seed0", "seed1", "seed3", "seed4", "seed5"], "seed0, seed1, seed3 to seed5"),
        (["a", "b", "seed1", "run2", "run3", "run5"], "a, b, seed1, run2, run3, run5"),
        ([], ""),
    ],
)
def test_successive_runs_are_told_as_ranges(runs: list[str], told: str) -> None:
    assert ranges(runs) == told


def test_the_commands_make_the_baselines_first(trained: Path, zoo: Path, results: Path) -> None:
    release(trained, "tipl-small", results=results)
    metrics = metrics_of("tipl-small")
    command = (
        "tipl evaluate tipl-small ema-0.9 a/persistence a/ema-0.9 b/ema-0.9-stretched --data small"
    )
    found = replace(metrics, results=msgspec.structs.replace(metrics.results, command=command))
    *_, first, second, judged, _ = facts(found, "commands").splitlines()
    assert first == "tipl train baselines --data small --out a"
    assert second == "tipl train stretched --along a/ema-0.9 --data small --out b/ema-0.9-stretched"
    assert judged == command


def test_cards_refuse_what_they_cannot_say(
    trained: Path, zoo: Path, results: Path, tmp_path: Path
) -> None:
    release(trained, "tipl-small", results=results)
    metrics = metrics_of("tipl-small")
    with pytest.raises(ModelError, match=r"no such section of a card(.|\n)*summary, baselines"):
        facts(metrics, "poem")
    with pytest.raises(EvaluateError, match="no place for these facts"):
        refreshed("# A card of something else\n", metrics)


def test_the_checks_of_tipl_show_its_look_ahead(checks: Path) -> None:
    found = json.loads(checks.read_text())
    assert (found["fitted_to_walks"], found["batches"], found["run"]) == (True, 5, "seed0002")
    assert list(found["null"]) == ["1", "10"]
    assert found["passed"]["causality"] is False
    assert found["drift"] is None  # a line has two directions, its basis eight
    assert found["passed"]["drift"] is False


def test_the_commands_go_all_the_way(
    trained: Path,
    checks: Path,
    zoo: Path,
    small_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def call(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["tipl", *map(str, arguments)])
        cli.main()
        return capsys.readouterr().out

    monkeypatch.chdir(tmp_path)
    assert "a draft: evaluate it with" in call("release", trained, "--name", "tipl-a")
    few = ["--learning-starts", "0", "--function-starts", "0", "--bootstrap", "10"]
    data = ["--data", small_dataset]
    call("evaluate", "tipl-a", *data, "--out", "judged", "--horizons", "1", "10", *few)
    files = ["--results", "judged/results.json", "--checks", checks]
    call("release", trained, "--name", "tipl-a", *files)
    assert "tipl-a" in call("zoo")
    assert "card in cards/models/tipl-a.md" in call("card", "tipl-a")
    text = Path("cards/models/tipl-a.md").read_text()
    assert "tipl evaluate tipl-a" in text
    assert "continues it | its basis needs more directions | no |" in text
    assert "the same forecast, bit for bit | other bits | no |" in text


def test_a_gate_is_released_with_its_data_sets(
    small_dataset: Path, zoo: Path, tmp_path: Path
) -> None:
    other = tmp_path / "data/other"
    shutil.copytree(small_dataset, other)
    info = read_dataset_info(other)
    write_dataset_info(other, replace(info, id="other"))
    out = tmp_path / "model"
    train_gate(
        change(
            GateTrainConfig(data=(small_dataset, other), out=out), horizons=(1, 5), starts=20,
            n_batches=4, batch_size=4, save_every=2, width=8, experts=2,
        )
    )  # fmt: skip
    few = {"horizons": (1, 5), "learning_starts": 0, "function_starts": 0, "bootstrap": 10}
    judged = EvaluateConfig(data=small_dataset, out=tmp_path / "judged", starts=9, **few)
    evaluate([load(out)], judged)
    rows = judged.out / "rows.csv"
    rows.write_text(rows.read_text().replace(",model,", ",tipl-gate-small@0,"))
    release(out, "tipl-gate-small", results=judged.out / "results.json", rows=[rows])
    text = write_card("tipl-gate-small", tmp_path / "cards").read_text()
    assert "| task | skill, h = 1 |\n|---|---:|\n| `small` | " in text
    with pytest.raises(ModelError, match="the rows hold no scores"):
        task_scores("tipl-gate", [rows])
    assert 'datasets:\n- "small"\n- "other"\n' in text
    assert text.count("- trained on: ") == 2
    assert text.count("- cadence: a snapshot every ") == 1
    assert "tipl train gate --data small other --out FOLDER --starts 20 --n-batches 4" in text
    assert " --horizons 1 5 " in text
    assert "None" not in text
    assert " --no-adam\n" in text
    assert "After 4 batches, the squared error over that of persistence" in text
    assert (tmp_path / "cards/tipl-gate-small.svg").exists()
    assert listed("tipl-gate-small")[1:3] == ("gate", "yes")


@pytest.mark.parametrize("name", names())
def test_every_judged_model_has_a_card_that_says_its_metrics(name: str) -> None:
    metrics = read_metrics(MODELS / name)
    assert metrics is not None, "a draft: judge it and release it again"
    assert metrics.fingerprint == fingerprint(load(name)), "not the bytes that were judged"
    card = ROOT / f"cards/models/{name}.md"
    assert card.exists(), f"run: tipl card {name}"
    text = card.read_text()
    assert refreshed(text, metrics_of(name)) == text, f"run: tipl card {name}"
