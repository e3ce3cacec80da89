"""Leaderboards from rows, with figures that are known."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from tipl.errors import EvaluateError
from tipl.evaluation.leaderboard import Entry, Leaderboard, leaderboard
from tipl.evaluation.rows import TaskRow, read_rows, write_rows
from tipl.report.leaderboard import markdown, write_page

TASKS = {"one": 0.5, "two": 0.8, "three": 1.2}
"""Error of ``model`` over persistence's."""


def row(task: str, name: str, error: float, run: int = 0, **more: object) -> TaskRow:
    fields = {
        "task": task,
        "fingerprint": f"print of {task}",
        "split": "test",
        "measure": "skill",
        "horizon": 1,
        "run": f"run{run}",
        "forecaster": name,
        "error": error,
        "reference": 1.0 + run,
    }
    return TaskRow(**fields | more)  # type: ignore[arg-type]


def made(runs: int = 3) -> list[TaskRow]:
    """Three tasks: ``model`` has the ratios of TASKS, ``rival`` 0.9 on each."""
    return [
        row(task, name, ratio * (1 + run), run)
        for task, own in TASKS.items()
        for name, ratio in {"persistence": 1.0, "model": own, "rival": 0.9}.items()
        for run in range(runs)
    ]


def line(board: Leaderboard, name: str) -> Entry:
    (found,) = [entry for entry in board.entries if entry.forecaster == name]
    return found


def test_the_cost_of_a_forecast_is_a_mean_over_tasks() -> None:
    costs = {("one", "model"): 0.001, ("two", "model"): 0.003}
    rows = [
        msgspec.structs.replace(each, cpu_seconds=costs.get((each.task, each.forecaster)))
        for each in made()
    ]
    board = leaderboard(rows, rival="rival", resamples=20)
    assert line(board, "model").cpu_ms == pytest.approx(2.0)
    assert line(board, "rival").cpu_ms is None


def test_figures_are_what_they_say() -> None:
    board = leaderboard(made(), rival="rival", resamples=200)
    model = line(board, "model")
    assert model.score.value == pytest.approx(np.mean([0.5, 0.2, -0.2]))
    assert model.ratio.value == pytest.approx(np.prod([0.5, 0.8, 1.2]) ** (1 / 3))
    assert model.wins.value == pytest.approx(2 / 3)
    assert model.wins_over.value == pytest.approx(2 / 3)
    assert model.rank.value == pytest.approx((1 + 1 + 3) / 3)
    leads = {score.task: score.lead.value for score in board.scores if score.forecaster == "model"}
    assert leads == pytest.approx({"one": 0.4, "two": 0.1, "three": -0.3})
    persistence = line(board, "persistence")
    assert (persistence.score.value, persistence.ratio.value) == (0.0, pytest.approx(1.0))
    assert persistence.wins.value == 0.5
    assert [entry.forecaster for entry in board.entries] == ["model", "rival", "persistence"]
    worse = [row("one", "worse", 2.0 * (1 + run), run) for run in range(3)]
    assert leaderboard([*made(), *worse]).entries[-1].forecaster == "worse"


def test_intervals_hold_the_differences_between_runs() -> None:
    rng = np.random.default_rng(0)
    rows = [row("one", "persistence", 1.0 + run, run) for run in range(20)]
    rows += [row("one", "model", (1 + run) * rng.uniform(0.2, 0.8), run) for run in range(20)]
    (score,) = [s for s in leaderboard(rows).scores if s.forecaster == "model"]
    assert score.score.low is not None
    assert score.score.value is not None
    assert score.score.high is not None
    assert 0.3 < score.score.low < score.score.value < score.score.high < 0.7
    (alone,) = leaderboard([row("one", "model", 0.5)]).scores
    assert (alone.score.value, alone.score.low) == (0.5, None)


def test_trainings_of_one_forecaster_are_drawn_too() -> None:
    rows = [
        row("one", f"model@{training}", 0.2 * training * (1 + run), run)
        for training in (1, 2, 3)
        for run in range(4)
    ]
    (score,) = leaderboard(rows, resamples=500).scores
    assert (score.forecaster, score.trainings) == ("model", 3)
    assert score.score.value == pytest.approx(0.6)
    assert score.score.low == pytest.approx(0.4, abs=0.05)  # all runs are alike: trainings alone
    assert score.score.high == pytest.approx(0.8, abs=0.05)


def test_a_bound_is_listed_last_and_shifts_no_rank() -> None:
    rows = made() + [
        row(task, "bound", 0.0, run, oracle=True) for task in TASKS for run in range(3)
    ]
    board = leaderboard(rows, rival="rival")
    assert board.entries[-1].forecaster == "bound"
    assert line(board, "model").rank.value == pytest.approx(5 / 3)
    assert line(board, "bound").rank.value == 1


def test_a_forecaster_of_some_tasks_is_compared_on_them() -> None:
    rows = [*made(), *(row("two", "guest", 0.4 * (1 + run), run) for run in range(3))]
    guest = line(leaderboard(rows, rival="rival"), "guest")
    assert (guest.tasks, guest.score.value) == (1, pytest.approx(0.6))
    assert guest.wins_over.value == 1


def test_rows_are_written_and_read(tmp_path: Path) -> None:
    rows = [*made(1), row("one", "bound", 1 / 3, oracle=True, trained_on="this")]
    write_rows(tmp_path / "rows.csv", rows)
    again = read_rows(tmp_path / "rows.csv")
    assert again[:-1] == rows[:-1]
    assert again[-1].error == pytest.approx(1 / 3, rel=1e-8)
    assert (again[-1].oracle, again[-1].trained_on) == (True, "this")


def test_a_strangers_rows_join_without_optional_columns(tmp_path: Path) -> None:
    file = tmp_path / "theirs.csv"
    file.write_text(
        "task,fingerprint,split,measure,horizon,run,forecaster,error,reference\n"
        "one,print of one,test,skill,1,run0,theirs,0.25,1\n"
    )
    board = leaderboard([*made(1), *read_rows(file)])
    assert line(board, "theirs").score.value == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "no rows"),
        ("a,b\n1,2\n", "line 2"),
        (
            "task,fingerprint,split,measure,horizon,run,forecaster,error,reference\n"
            "one,x,test,skill,soon,run0,theirs,0.25,1\n",
            "line 2",
        ),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, what: str) -> None:
    file = tmp_path / "other.csv"
    file.write_text(text)
    with pytest.raises(EvaluateError, match=what):
        read_rows(file)


@pytest.mark.parametrize(
    ("odd", "what"),
    [
        (row("one", "model", 0.1, fingerprint="other"), "different runs"),
        (row("one", "model", 0.1), "disagree"),
        (row("one", "model", 0.1, 7), "not evaluated on all runs"),
    ],
)
def test_rows_that_do_not_belong_together_are_refused(odd: TaskRow, what: str) -> None:
    with pytest.raises(EvaluateError, match=what):
        leaderboard([*made(), odd])


def test_pages_hold_every_line(tmp_path: Path) -> None:
    board = leaderboard(
        [*made(), row("one", "<b>|", 0.5), *(row("one", "<b>|", 1, r) for r in (1, 2))]
    )
    page = write_page(board, tmp_path / "out").read_text()
    assert "&lt;b&gt;|" in page
    assert "<b>|" not in page
    text = markdown(board)
    assert "| model | 3 | 0.17 " in text
    assert "| \\<b\\>\\| |" in text
    lines = (tmp_path / "out/leaderboard.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * len(board.scores) + 5 * len(board.entries)
