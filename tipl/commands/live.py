"""``tipl live``, and ``tipl report`` of its results."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from tipl.live.results import LiveResults, read_live
from tipl.live.study import LiveConfig, run_live
from tipl.report.live import arm_label, cells, insert_live, rows_of, shares_of, write_figures
from weighttraj.remote.address import here, new_path
from weighttraj.terminal import Output, say


@dataclass(frozen=True, kw_only=True)
class LiveCommand(LiveConfig):
    """Run one stage of a study: its arms on its tasks with its seeds, and compare them.

    Each population of seeds is a file; with the same command a study goes on where it stopped.

    Example: tipl live plan.toml --out data/study --stage tuning
    """

    plan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PLAN")]
    """The plan, a TOML file: see docs/jump-ahead.md."""


def live(args: LiveCommand) -> None:
    """Run one stage of a study: its arms on its tasks with its seeds, and compare them."""
    new_path(args.out)
    console = Output()
    command = shlex.join(["tipl", *sys.argv[1:]])
    results = run_live(args, command=command, console=console)
    folder = args.out / args.stage
    write_figures(results, folder)
    for task in results.thresholds:
        console.print(_table(results, task))
    say(f"results: {folder / 'results.json'}")


def live_report(results: Path, into: Path | None) -> None:
    """Draw the figures of a study again, or write its places in a Markdown page."""
    document = read_live(here(results))
    if into is None:
        write_figures(document, results.parent)
        say(f"figures in {results.parent}")
    else:
        insert_live(document, results, into)
        say(f"results in {into}")


def _table(results: LiveResults, task: str) -> Table:
    against = results.baseline
    table = Table(
        title=f"{task}, {results.stage} seeds, against {against}",
        caption=f"Ratios of environment steps to shares of {against}'s final return, differences "
        "of returns, and CPU time of the forecasts. results.json has intervals.",
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("arm")
    heads = [f"{share} %" for share in shares_of(results)]
    for head in (*heads, "final", "area", "worst", "CPU"):
        table.add_column(head, justify="right", no_wrap=True)
    for arm in rows_of(results, task, against):
        texts = cells(results, task, arm, against, short=True)
        table.add_row(escape(arm_label(results, task, arm)), *texts)
    return table
