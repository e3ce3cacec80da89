from __future__ import annotations

import io
import time

import pytest
from rich.console import Console

from weighttraj.progress import LoggedProgress


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LoggedProgress, "FIRST", 0.01)


def test_a_log_hears_of_work_before_it_ends() -> None:
    log = io.StringIO()
    with LoggedProgress(console=Console(file=log)) as progress:
        task = progress.add_task("seed 7", total=4)
        progress.advance(task)
        end = time.monotonic() + 20
        while "25%" not in log.getvalue() and time.monotonic() < end:
            time.sleep(0.01)
        assert "seed 7" in log.getvalue()
        assert "25%" in log.getvalue()
        progress.advance(task, 3)
    assert log.getvalue().rstrip().splitlines()[-1].count("100%") == 1


@pytest.mark.parametrize("how", ["terminal", "quiet", "disabled"])
def test_elsewhere_it_is_as_rich_has_it(how: str) -> None:
    log = io.StringIO()
    console = Console(file=log, force_terminal=how == "terminal", quiet=how == "quiet")
    with LoggedProgress(console=console, disable=how == "disabled") as progress:
        progress.add_task("seed 7", total=4)
        assert not hasattr(progress, "_printer")
        time.sleep(0.05)
    assert ("seed 7" in log.getvalue()) == (how == "terminal")
