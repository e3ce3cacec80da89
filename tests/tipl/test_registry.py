"""Kinds from outside, classes by name, and runs that cannot be used."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

import tipl
import weighttraj as wt
from tipl import registry
from tipl.cli import main
from tipl.errors import ForecastError, LeftOutWarning, TrainError
from tipl.evaluation.results import read_results
from tipl.models.baselines.train import BaselinesConfig, train_baselines
from tipl.models.gate import GateTrainConfig, train_gate
from weighttraj import writer
from weighttraj.format.schema import Cadence, DatasetInfo, RunEntry
from weighttraj.store.catalog import write_dataset_info

OWN = '''
import numpy as np
import tipl
from tipl.runs import weights_of


class Halfway(tipl.Forecaster):
    """Half of the last step, whatever the horizon."""

    name = "halfway"

    def forecast(self, run, starts, horizons):
        weights = weights_of(run)
        now, before = (weights[np.maximum(np.array(starts) - k, 0)] for k in (0, 1))
        return np.repeat((now + (now - before) / 2)[:, None], len(horizons), axis=1)


class Nothing:
    pass
'''
FEW = ["--learning-starts", "0", "--function-starts", "0", "--bootstrap", "10"]


def dataset(path: Path, *runs: tuple[str, np.ndarray]) -> Path:
    """A data set of runs, each a split and its weights."""
    entries = []
    for i, (split, weights) in enumerate(runs):
        layout = wt.ParamLayout.of({"w": ((weights.shape[1],), "other", ("fixed",))})
        info = wt.RunInfo(run_id=f"r{i}", layout=layout, cadence=Cadence(every=2), block=8)
        with (
            mock.patch.object(writer, "check_finite", lambda _, row: row),  # it refuses NaN
            wt.RunWriter(path / f"runs/r{i}.zarr", info) as out,
        ):
            for t, row in enumerate(weights):
                out.append(row, num_timesteps=t, phase=(t - 1) % 4 if t else -1)
        entries.append(RunEntry(id=f"r{i}", path=f"runs/r{i}.zarr", split=split))  # type: ignore[arg-type]
    write_dataset_info(path, DatasetInfo(id="toy", runs=tuple(entries), status="complete"))
    return path


def walk(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 6)).cumsum(0).astype(np.float32)


def with_nan(n: int) -> np.ndarray:
    weights = walk(n, 9)
    weights[n // 2, 1] = np.nan
    return weights


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module in the current folder."""
    (tmp_path / "own_forecaster.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    yield "own_forecaster"
    sys.modules.pop("own_forecaster", None)
    sys.path[:] = [place for place in sys.path if place != str(tmp_path)]


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["tipl", *map(str, arguments)])
    main()


def test_a_class_is_evaluated_by_its_name(
    own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = dataset(tmp_path / "data", ("test", walk(40)), ("test", walk(40, 1)))
    options = ["--data", data, "--out", "out", "--horizons", 1, 5, *FEW]
    call(monkeypatch, "evaluate", f"{own}:Halfway", *options)
    said = capsys.readouterr().out
    assert "halfway" in said
    assert "h = 5" in said.replace("\n", " ")
    assert "h = 10" not in said
    found = read_results(tmp_path / "out/results.json").forecasters["halfway"]
    assert (found.kind, found.causal, found.is_oracle) == ("other", True, False)


@pytest.mark.parametrize("name", ["{own}:Nothing", "{own}:Missing", "no_such_module:X", "a:b:c"])
def test_a_class_that_is_no_forecaster_is_refused(own: str, name: str) -> None:
    with pytest.raises(ForecastError):
        tipl.load(name.format(own=own))


def test_a_kind_from_outside_is_saved_loaded_and_listed(
    own: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "_KINDS", dict(registry._KINDS))
    tipl.register(tipl.Kind(name="halfway", forecaster=f"{own}:Halfway", is_model=True))
    (tmp_path / "model").mkdir()
    (tmp_path / "model/config.json").write_text('{"kind": "halfway"}')
    sys.path.insert(0, str(tmp_path))
    assert tipl.load(tmp_path / "model").name == "halfway"
    assert registry.is_model("halfway")


def test_the_package_is_a_command_with_a_version() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tipl", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("tipl, of weighttraj ")


@pytest.mark.parametrize(
    ("words", "advice"),
    [
        (["evalute"], "did you mean: tipl evaluate"),
        (["train-gate"], "it is now called: tipl train gate"),
        (["fit"], "it is now called: tipl train baselines"),
        (["train", "gata"], "did you mean: tipl train gate"),
        (["poem"], "tipl --help lists all commands"),
    ],
)
def test_an_unknown_command_gets_advice(
    words: list[str],
    advice: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        call(monkeypatch, *words)
    assert end.value.code == 2
    assert advice in " ".join(capsys.readouterr().err.split())


# Runs that cannot be used

ODD = {
    "2 snapshots": walk(2),
    "never change": np.ones((60, 6), np.float32),
    "a weight beyond": walk(60) * np.float32(1e20),
    "NaN or infinity in snapshot 30": with_nan(60),
}


@pytest.mark.parametrize("split", ["train", "validation"])
@pytest.mark.parametrize("why", ODD)
def test_an_odd_run_is_named_and_left_out_of_a_training(
    why: str, split: str, tmp_path: Path
) -> None:
    runs = [("train", walk(60)), ("train", walk(60, 1)), ("validation", walk(60, 2))]
    data = dataset(tmp_path / "data", *runs, (split, ODD[why]))
    config = tipl.change(
        GateTrainConfig(data=(data,), out=tmp_path / "model"),
        horizons=(1, 2), n_batches=2, save_every=1, starts=9, width=4, experts=2,
    )  # fmt: skip
    with pytest.warns(LeftOutWarning, match=rf"run r3 is left out: .*{why}"):
        model = train_gate(config)
    assert np.isfinite(model.forecast(wt.open(data).runs[0], [5], [1])).all()


@pytest.mark.parametrize("why", ODD)
def test_where_every_run_is_odd_each_is_named(why: str, tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", ("train", ODD[why]), ("train", ODD[why]))
    config = tipl.change(GateTrainConfig(data=(data,), out=tmp_path / "model"), horizons=(1,))
    with (
        pytest.warns(LeftOutWarning),
        pytest.raises(TrainError, match=rf"none of the runs(.|\n)*r0: .*{why}(.|\n)*r1: .*{why}"),
    ):
        train_gate(config)


def test_odd_runs_are_left_out_of_baselines(tmp_path: Path) -> None:
    data = dataset(
        tmp_path / "data", ("train", walk(60)), ("train", with_nan(60)), ("validation", walk(2))
    )
    config = BaselinesConfig(data=data, out=tmp_path / "out", horizons=(1,), steps=4)
    with pytest.warns(LeftOutWarning, match="run r1 is left out: NaN"):
        fitted = train_baselines(config)
    run = wt.open(data).runs[0]
    assert all(np.isfinite(one.forecast(run, [5], [1])).all() for one in fitted)


@pytest.mark.filterwarnings("default::tipl.errors.LeftOutWarning")
def test_a_run_with_nan_is_named_and_the_others_are_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = dataset(
        tmp_path / "data", ("test", walk(60)), ("test", with_nan(60)), ("test", walk(60, 3))
    )
    options = ["--data", data, "--out", tmp_path / "out", "--horizons", 1, *FEW]
    with pytest.raises(SystemExit) as end:
        call(monkeypatch, "evaluate", "last-step", *options)
    assert end.value.code == 1
    assert "not evaluated: toy: run r1: NaN or infinity in snapshot 30" in capsys.readouterr().err
    results = read_results(tmp_path / "out/results.json")
    assert results.runs == ("r0", "r2")
    assert results.left_out == {"r1": "NaN or infinity in snapshot 30"}
    (row,) = results.forecasters["last-step"].skill["ratio_of_sums"]["all"]
    assert row.value is not None
    assert "r1" in (tmp_path / "out/report.html").read_text()
    assert json.loads((tmp_path / "out/results.json").read_text())["format"] == 1
