from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from rich.console import Console
from stable_baselines3 import PPO

import weighttraj as wt
from tipl.checks.copies import run_like
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.engine import Tell
from weighttraj.errors import EngineError, FormatError, PolicyError, StoreLockedError
from weighttraj.format import RunEntry
from weighttraj.learning import learning_phase
from weighttraj.policies import EpisodeReturns, ReturnsConfig, evaluate, fill_returns, returns
from weighttraj.policies.returns import play_rows
from weighttraj.registry import create, select
from weighttraj.store.catalog import read_dataset_info, write_dataset_info
from weighttraj.tools.lint import lint_returns

CONFIG = ReturnsConfig(episodes=2, every=20, first=3)
ROWS = [0, 1, 2, 20, 40, 48]


@pytest.fixture(scope="module")
def pair(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of 49 snapshots. Do not write to it."""
    return Path(select(small_dataset, tmp_path_factory.mktemp("pair") / "small", seeds=[0, 1]).path)


@pytest.fixture
def dataset(pair: Path, tmp_path: Path) -> Path:
    """A copy that may be written to."""
    return Path(shutil.copytree(pair, tmp_path / "small"))


def stored(path: Path) -> dict[str, tuple[list[float], list[int]]]:
    """What the runs of a data set hold, in a form that can be compared."""
    return {
        run.id: (
            np.nan_to_num(run["eval/returns"][:], nan=-1).tolist(),
            run["eval/lengths"][:].tolist(),
        )
        for run in wt.open(path)
    }


def test_returns_of_every_kth_snapshot_are_stored(dataset: Path) -> None:
    before = {run.id: run.weights[:] for run in wt.open(dataset)}
    filled = fill_returns(dataset, CONFIG)
    for run in filled:
        lengths, evaluation = run["eval/lengths"][:], run.evaluation
        assert np.flatnonzero((lengths != -1).any(1)).tolist() == ROWS
        assert evaluation is not None
        assert evaluation.seeds == (0, 1, 0, 1)
        assert evaluation.deterministic == (True, True, False, False)
        assert (evaluation.every, evaluation.first) == (20, 3)
        assert evaluation.simulator == "mujoco.batch"
        assert evaluation.packages.keys() == {"gymnasium", "mujoco", "numpy", "torch"}
        for t in (1, 40):
            played = [
                evaluate(run.load_policy(t), run, episodes=2, deterministic=m)
                for m in (True, False)
            ]
            assert run.returns[t].tolist() == [*played[0].returns, *played[1].returns]
            assert lengths[t].tolist() == [*played[0].lengths, *played[1].lengths]
        assert np.array_equal(run.weights[:], before[run.id])
    assert wt.verify(dataset, deep=True) == []
    assert not (dataset / ".returns").exists()


def test_a_run_that_was_replaced_says_so(dataset: Path) -> None:
    before = wt.open(dataset).runs[0]
    assert before.weights.shape == (49, 122)
    fill_returns(dataset, CONFIG)
    with pytest.raises(FormatError, match=r"(?s)replaced after it was opened.*open it again"):
        before.weights[:]


def test_what_is_stored_is_not_played_again(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill_returns(dataset, CONFIG)
    objects = {p: p.read_bytes() for p in dataset.rglob("*") if p.is_file()}
    played = []
    monkeypatch.setattr(returns, "play_rows", lambda task, _: played.append(task))
    fill_returns(dataset, CONFIG)
    assert played == []
    assert {p: p.read_bytes() for p in dataset.rglob("*") if p.is_file()} == objects


def test_more_snapshots_of_the_same_episodes_are_added(dataset: Path) -> None:
    fill_returns(dataset, CONFIG)
    fill_returns(dataset, ReturnsConfig(episodes=2, every=16))
    run = wt.open(dataset).runs[0]
    assert np.flatnonzero(run["eval/lengths"][:, 0] != -1).tolist() == [0, 1, 2, 16, 20, 32, 40, 48]
    fresh = evaluate(run.load_policy(20), run, episodes=2)
    assert run.returns[20, :2].tolist() == fresh.returns.tolist()


def test_two_processes_give_what_one_gives(
    dataset: Path, pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(returns, "BLOCK", 2)
    fill_returns(dataset, CONFIG, workers=2)
    other = Path(shutil.copytree(pair, tmp_path / "other" / "small"))
    monkeypatch.setattr(returns, "BLOCK", 5)
    fill_returns(other, CONFIG)
    assert stored(dataset) == stored(other)
    assert _bytes(dataset) == _bytes(other)


def _bytes(path: Path) -> dict[str, bytes]:
    files = sorted(p for p in path.rglob("*") if p.is_file() and not p.name.endswith(".lock"))
    return {p.relative_to(path).as_posix(): p.read_bytes() for p in files}


COMMAND = """
import sys, weighttraj.policies.returns as returns
returns.BLOCK = 1
config = returns.ReturnsConfig(episodes=20, every=2)
if __name__ == "__main__":
    returns.fill_returns(sys.argv[1], config, workers=int(sys.argv[2]))
"""


@pytest.mark.parametrize(("workers", "kind"), [(1, signal.SIGKILL), (2, signal.SIGINT)])
def test_killed_it_goes_on(
    dataset: Path, pair: Path, tmp_path: Path, workers: int, kind: int
) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, str(dataset), str(workers)],
        start_new_session=True,
    )
    journals, lines = dataset / ".returns", 0
    while lines < 3:  # the header and two snapshots
        assert process.poll() is None
        time.sleep(0.01)
        lines = max((p.read_text().count("\n") for p in journals.glob("*.jsonl")), default=0)
    os.killpg(process.pid, kind)
    assert process.wait(timeout=30) != 0
    left = sum(p.read_text().count("\n") for p in journals.glob("*.jsonl"))
    assert left >= 3
    assert wt.open(dataset).runs[0].weights.shape == (49, 122)
    assert any("manifest" in problem for problem in wt.verify(dataset))
    config = ReturnsConfig(episodes=20, every=2)
    fill_returns(dataset, config)
    other = Path(shutil.copytree(pair, tmp_path / "other" / "small"))
    fill_returns(other, config)
    assert _bytes(dataset) == _bytes(other)
    assert wt.verify(dataset, deep=True) == []


def test_a_journal_that_was_cut_short_is_used_as_far_as_it_goes(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(returns, "BLOCK", 2)
    _stop_after(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        fill_returns(dataset, CONFIG)
    journal = dataset / ".returns" / "seed0000.jsonl"
    lines = [line.partition(" ")[2] for line in journal.read_text().split("\n")]
    assert [json.loads(line)["t"] for line in lines[1:5]] == ROWS[:4]
    journal.write_bytes(journal.read_bytes()[:-3])
    played = _count(monkeypatch)
    fill_returns(dataset, CONFIG)
    assert played[:2] == [ROWS[3:5], ROWS[5:]]
    assert wt.verify(dataset) == []


@pytest.mark.parametrize("damage", [('"returns": [', '"returns": [9'), ('"t"', '"u"'), ("1", "2")])
def test_a_damaged_journal_never_becomes_a_return(
    dataset: Path, monkeypatch: pytest.MonkeyPatch, damage: tuple[str, str]
) -> None:
    straight = stored(fill_returns(dataset, CONFIG).path)
    fill_returns(dataset, replace(CONFIG, seed=7), replace=True)  # so that there is all to do again
    monkeypatch.setattr(returns, "BLOCK", 2)
    _stop_after(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        fill_returns(dataset, CONFIG, replace=True)
    journal = dataset / ".returns" / "seed0000.jsonl"
    header, first, second, *rest = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join([header, first, second.replace(*damage, 1), *rest]))
    _count(monkeypatch)  # and does not stop it any more
    fill_returns(dataset, CONFIG, replace=True)
    assert stored(dataset) == straight


def test_returns_of_a_folder_are_refused_before_anything_is_played(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run, *_) = wt.open(dataset).runs
    made = run_like(run, run.weights[:], dataset / "runs")
    folder, info = Path(made.path), read_dataset_info(dataset)
    entry = RunEntry(id=made.id, path=f"runs/{folder.name}", split="train")
    (dataset / "MANIFEST.sha256").unlink()
    write_dataset_info(dataset, replace(info, runs=(entry,), status="collecting"))
    fill_returns(dataset, CONFIG)
    played = _count(monkeypatch)
    more = replace(CONFIG, every=10)
    with pytest.raises(PolicyError, match=r"(?s)those of a folder are not replaced.*remove its"):
        fill_returns(dataset, more)
    assert not played
    wt.pack(folder)  # as it says
    screen = io.StringIO()
    fill_returns(dataset, more, console=Console(file=screen, width=200))
    assert f"their folders are still there, so left for later: {made.id}" in screen.getvalue()
    shutil.rmtree(folder)
    fill_returns(dataset, more)
    assert np.isfinite(wt.open(dataset).runs[0]["eval/returns"][10]).all()


def test_a_journal_of_other_settings_is_not_used(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(returns, "BLOCK", 5)
    _stop_after(monkeypatch, 1)
    with pytest.raises(KeyboardInterrupt):
        fill_returns(dataset, CONFIG)
    played = _count(monkeypatch)
    fill_returns(dataset, ReturnsConfig(episodes=2, every=20, first=3, seed=7))
    assert played == [ROWS[:5], ROWS[5:]] * 2
    assert wt.open(dataset).runs[0].evaluation.seeds == (7, 8, 7, 8)  # type: ignore[union-attr]


def _count(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The snapshots of each block that is played from now on."""
    played: list[list[int]] = []

    def play(task: returns._Task, tell: Tell) -> EpisodeReturns:
        played.append(task.rows)
        return play_rows(task, tell)

    monkeypatch.setattr(returns, "play_rows", play)
    return played


def _stop_after(monkeypatch: pytest.MonkeyPatch, blocks: int) -> None:
    """Ctrl-C when so many blocks have been played."""
    played = _count(monkeypatch)
    count = returns.play_rows

    def play(task: returns._Task, tell: Tell) -> EpisodeReturns:
        if len(played) == blocks:
            raise KeyboardInterrupt
        return count(task, tell)

    monkeypatch.setattr(returns, "play_rows", play)


def test_another_evaluation_is_refused_or_replaces(dataset: Path) -> None:
    fill_returns(dataset, CONFIG)
    other = ReturnsConfig(episodes=2, every=40, modes=("sampled",))
    with pytest.raises(
        PolicyError, match=r"(?s)returns of another evaluation.*deterministic.*--replace"
    ):
        fill_returns(dataset, other)
    assert wt.verify(dataset) == []
    run = fill_returns(dataset, other, replace=True).runs[0]
    assert run.returns.shape == (49, 2)
    assert np.flatnonzero(run["eval/lengths"][:, 0] != -1).tolist() == [0, 40, 48]
    assert wt.verify(dataset, deep=True) == []


def test_returns_of_other_physics_are_not_mixed(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill_returns(dataset, CONFIG)
    real = returns.importlib.metadata.version
    monkeypatch.setattr(
        returns.importlib.metadata,
        "version",
        lambda name: "9.9" if name == "mujoco" else real(name),
    )
    with pytest.raises(PolicyError, match=r"(?s)another evaluation.*another mujoco"):
        fill_returns(dataset, ReturnsConfig(episodes=2, every=7))


def test_the_current_folder_can_be_a_data_set(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(dataset)
    assert fill_returns(".", CONFIG).runs[0].evaluation is not None


def test_where_there_is_no_data_set_nothing_is_left(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no data set at"):
        fill_returns(tmp_path / "no" / "where", CONFIG)
    assert list(tmp_path.iterdir()) == []


def test_only_one_at_a_time(dataset: Path) -> None:
    with (
        FileLock(dataset.parent / ".small.lock"),
        pytest.raises(StoreLockedError, match="another process is changing"),
    ):
        fill_returns(dataset, CONFIG)


def test_runs_that_are_about_to_change_are_left_for_later(dataset: Path) -> None:
    with zipfile.ZipFile(dataset / "runs/seed0001.zarr.zip") as archive:
        archive.extractall(dataset / "runs/seed0001.zarr")
    info = read_dataset_info(dataset)
    folder = replace(info.runs[1], path="runs/seed0001.zarr")
    runs = (info.runs[0], folder, *info.runs[2:])
    write_dataset_info(dataset, replace(info, runs=runs, status="collecting"))
    screen = io.StringIO()
    filled = fill_returns(dataset, CONFIG, console=Console(file=screen, width=200))
    assert "left for later: seed0001" in screen.getvalue()
    assert [run.evaluation is None for run in filled] == [False, True]


def test_settings_that_evaluate_nothing_are_refused(dataset: Path) -> None:
    for wrong in ({"episodes": 0}, {"every": 0}, {"first": -1}, {"modes": ()}, {"seed": -1}):
        with pytest.raises(PolicyError, match="evaluate nothing"):
            ReturnsConfig(**wrong)  # type: ignore[arg-type]
    with pytest.raises(EngineError, match="workers at least 1"):
        fill_returns(dataset, CONFIG, workers=0)


def test_every_kth_the_first_and_the_last() -> None:
    assert ReturnsConfig(every=10, first=4).rows(33) == [0, 1, 2, 3, 10, 20, 30, 32]
    assert ReturnsConfig(every=10, first=100).rows(3) == [0, 1, 2]
    assert ReturnsConfig(every=3).rows(0) == []


def test_the_learning_phase_of_each_run_is_evaluated_densely(dataset: Path) -> None:
    filled = fill_returns(dataset, replace(CONFIG, first=0, learning=2))
    for run in filled:
        rows = np.flatnonzero(np.isfinite(run.mean_return(deterministic=False)))
        coarse = sorted({*range(0, len(run), 20), len(run) - 1})
        sparse = np.full(len(run), np.nan)
        sparse[coarse] = run.mean_return(deterministic=False)[coarse]
        end = learning_phase(sparse)
        assert rows.tolist() == sorted({*coarse, *range(0, end + 1, 2)})
        assert run.evaluation is not None
        assert run.evaluation.learning == 2
    assert any(len(np.flatnonzero(np.isfinite(r.mean_return()))) > 3 for r in filled)
    before = stored(dataset)
    fill_returns(dataset, replace(CONFIG, first=0, learning=2))
    assert stored(dataset) == before


@pytest.mark.parametrize(("learning_rate", "found"), [(1e-7, ["returns"]), (0.03, [])])
def test_sampled_returns_that_tell_nothing_apart_are_found(
    learning_rate: float, found: list[str], tmp_path: Path
) -> None:
    model = PPO(
        "MlpPolicy",
        "CartPole-v1",
        learning_rate=learning_rate,
        n_steps=64,
        batch_size=32,
        n_epochs=2,
        seed=0,
        device="cpu",
    )
    path = tmp_path / "run.zarr"
    model.learn(128, callback=WeightTrajectoryCallback(path, every=2, probe_observations=0))
    create([path], tmp_path / "data")
    (run,) = fill_returns(tmp_path / "data", ReturnsConfig(episodes=5, every=1)).runs
    sampled = run.returns[:, 5:]
    assert (sampled == sampled[0]).all() == bool(found)
    assert [finding.check for finding in lint_returns(run)] == found
    assert ("returns" in {finding.check for finding in wt.lint(tmp_path / "data")}) == bool(found)


def test_one_run_gets_returns_as_a_data_set_does(dataset: Path, tmp_path: Path) -> None:
    alone = Path(shutil.copy(dataset / "runs/seed0000.zarr.zip", tmp_path / "mine.zarr.zip"))
    filled = fill_returns(alone, CONFIG)
    assert [run.path for run in filled] == [alone]
    assert sorted(p.name for p in tmp_path.iterdir() if not p.name.endswith(".lock")) == [
        "mine.zarr.zip",
        "small",
    ]
    inside = fill_returns(dataset / "runs/seed0000.zarr.zip", CONFIG)
    assert stored(alone) == stored(inside.path)  # type: ignore[arg-type]
    assert [r.evaluation is not None for r in wt.open(dataset)] == [True, False]
    assert wt.verify(dataset) == []


def test_an_hdf5_file_gets_no_returns(dataset: Path, tmp_path: Path) -> None:
    file = wt.export_hdf5(dataset, tmp_path / "small.h5")
    with pytest.raises(PolicyError, match=r"(?s)not stored in an HDF5 file.*weighttraj import"):
        fill_returns(file, CONFIG)
