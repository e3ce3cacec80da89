"""The results page says what the rows in the repository say."""

from __future__ import annotations

import importlib
import shlex
from pathlib import Path
from types import ModuleType

import pytest

from tipl.evaluation.rows import read_rows

HERE = Path(__file__).parents[1] / "docs/results"


@pytest.fixture
def make_results(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(HERE))
    return importlib.import_module("make_results")


def test_the_page_says_what_the_rows_say(make_results: ModuleType) -> None:
    for path in (make_results.PAGE, make_results.README):
        page = path.read_text()
        assert make_results.insert(page) == page, "stale: run python docs/results/make_results.py"
    page = make_results.PAGE.read_text()
    assert make_results.insert(page.replace("| AR(20)", "| 0.99")) == page
    assert sum(any(map(str.isalnum, word)) for word in page.split()) <= 1_500


def test_every_forecaster_of_the_tables_is_in_the_plan(make_results: ModuleType) -> None:
    """Its rows come from the commands that the page states."""
    commands = [command for step in make_results.plan() for command in step.commands]
    evaluated = {
        Path(word).name.partition("@")[0]
        for command in commands
        if command.startswith("tipl evaluate")
        for word in shlex.split(command)[2:]
    }
    rows = [row for file in make_results.ROWS.glob("*.csv") for row in read_rows(file)]
    names = {row.forecaster.partition("@")[0] for row in rows if not row.oracle}
    assert names - evaluated <= {"persistence"}
    for name in ("tipl-gate", make_results.RIVAL, make_results.SIMPLE):
        assert name in names


def test_the_cost_is_said_before_anything_runs(
    make_results: ModuleType, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["make_results.py", "--plan"])
    make_results.main()
    said = capsys.readouterr().out
    assert said.index("CPU minutes") < said.index("tipl train gate")
