"""``tipl leaderboard``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from rich.markup import escape
from rich.table import Table

from tipl.evaluation.leaderboard import Leaderboard
from tipl.evaluation.leaderboard import leaderboard as compute
from tipl.evaluation.rows import read_rows
from tipl.report.leaderboard import COLUMNS, cells, write_page
from weighttraj.remote.address import new_path
from weighttraj.terminal import Output, say

WIDE = 110
"""Number of characters that a table with all columns needs."""
NARROW = (1, 4, 5)
"""Columns of a narrower one: score, wins over the rival, rank."""


def leaderboard(
    results: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(
            metavar="[RESULTS ...]",
            help="folders of `tipl evaluate`, searched for rows.csv, or CSV files",
        ),
    ],
    out: Annotated[Path, tyro.conf.arg(help="folder of leaderboard.html, .md and .csv")],
    rival: Annotated[str, tyro.conf.arg(help="forecaster that wins are counted against")] = (
        "ar-20-phase"
    ),
    bootstrap: Annotated[int, tyro.conf.arg(help="draws for intervals")] = 2_000,
    seed: Annotated[int, tyro.conf.arg(help="seed of the draws")] = 0,
) -> None:
    """Compare forecasters over all tasks of several evaluations.

    Prints, for each measure and horizon, mean scores over tasks with 95 % intervals that draw runs,
    trainings and tasks, and writes them as a page that can be sorted, as Markdown and as CSV. A CSV
    file of somebody else, with the columns of rows.csv, joins as it is.
    """
    new_path(out)
    files = [file for path in results for file in _files(path)]
    rows = [row for file in files for row in read_rows(file)]
    board = compute(rows, rival=rival, resamples=bootstrap, seed=seed)
    page = write_page(board, out)
    console = Output()
    for measure, horizon in dict.fromkeys((e.measure, e.horizon) for e in board.entries):
        console.print(_table(board, measure, horizon, console))
    say(f"leaderboard: {page}")


def _files(path: Path) -> list[Path]:
    """Return the CSV files at a path.

    Raises:
        FileNotFoundError: there are none.
    """
    files = [path] if path.is_file() else sorted(path.glob("**/rows.csv"))
    if not files:
        raise FileNotFoundError(
            f"no rows.csv in {path}; `tipl evaluate FORECASTER... --data DATASET --out {path}` "
            "writes one"
        )
    return files


def _table(board: Leaderboard, measure: str, horizon: int, console: Output) -> Table:
    """Return the lines of one measure and horizon; few columns where there is no room for all."""
    shown = range(len(COLUMNS)) if console.width >= WIDE else NARROW
    table = Table(title=f"{measure}, {horizon} snapshots ahead")
    table.add_column("forecaster", overflow="fold")
    for i in shown:
        table.add_column(COLUMNS[i], justify="right", no_wrap=True)
    for entry in board.entries:
        if (entry.measure, entry.horizon) == (measure, horizon):
            name = f"{entry.forecaster} (bound)" if entry.oracle else entry.forecaster
            texts = cells(entry, interval=False)
            table.add_row(escape(name), *(texts[i] for i in shown))
    return table
