"""``tipl evaluate``, ``tipl check`` and ``tipl report``."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from textwrap import wrap
from typing import Annotated

import tyro
from rich import box
from rich.markup import escape
from rich.table import Table

import weighttraj as wt
from tipl.checks.model import check_model
from tipl.commands.live import live_report
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.results import Results, read_results, write_document
from tipl.evaluation.rows import trained_on
from tipl.live.results import is_live
from tipl.registry import folder_of, load
from tipl.report import tables
from tipl.report.markdown import insert_markdown
from tipl.report.page import evaluate as evaluate_all
from tipl.report.page import write_report
from tipl.report.sentences import sentences
from tipl.report.tables import cell, compact, headline, label
from weighttraj.errors import WeightTrajError
from weighttraj.remote.address import here, new_path
from weighttraj.terminal import Output, say

NO_BREAK = "\N{NO-BREAK SPACE}"
WIDE = 150
"""Number of characters that a table with intervals needs."""


@dataclass(frozen=True, kw_only=True)
class EvaluateCommand(EvaluateConfig):
    """Evaluate forecasters on held-out runs beside persistence, and write a report.

    Several data sets are evaluated one after another, each in a folder of its id below ``--out``.
    The command ``tipl leaderboard`` compares forecasters over all of them.

    Example: tipl evaluate tipl-gate --data hopper-v4-ppo-16x16-v1 --out data/report --quick
    """

    forecasters: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[FORECASTER ...]")
    ] = ()
    """Names of released models (``tipl zoo``) or of baselines that need no fit (``ema-0.95``).
    Folders of trained models or of fitted baselines. Classes, as ``module:Class``.
    In a name ``{data}`` stands for the id of the data set: ``data/results/{data}/gate``."""
    data: Annotated[tuple[str, ...], tyro.conf.arg(metavar="DATA ...")]  # type: ignore[assignment]
    """Data sets: paths or ids."""
    quick: bool = False
    """Minutes instead of hours: at most 300 starts in each run, 50 of them for divergences of
    policies, 2 in the learning phase and 1 after it for returns, return horizons 1, 10 and 50, and
    5 episodes."""
    workers: int = 1
    """Number of processes; each has one thread and takes a run at a time."""
    scheduler: str | None = None
    """Address of a Dask cluster, tcp://host:port, or `local` for --workers processes here."""
    imports: Annotated[tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE ...")] = ()
    """Modules that register environments (my_envs for my_envs.py); each worker imports them."""


def evaluate(args: EvaluateCommand) -> None:
    """Evaluate forecasters on held-out runs beside persistence, and write a report."""
    new_path(args.out)
    if len(args.data) == 1:
        faults = _evaluate_on(args, args.data[0], args.out)
    else:
        faults = []
        for data in args.data:
            try:
                faults += _evaluate_on(args, data, args.out / wt.open_dataset(data).info.id)
            except (WeightTrajError, FileNotFoundError) as error:
                faults.append(f"{data}: {error}")
    for fault in faults:
        Output(stderr=True).print(f"not evaluated: {escape(fault)}", soft_wrap=True)
    if faults:
        sys.exit(1)


def _evaluate_on(args: EvaluateCommand, data: str, out: Path) -> list[str]:
    """Evaluate on one data set, and return what could not be evaluated and why."""
    console = Output()
    dataset = wt.open_dataset(data)
    names = [name.replace("{data}", dataset.info.id) for name in args.forecasters]
    forecasters = [load(name) for name in names]
    settings = {field.name: getattr(args, field.name) for field in fields(EvaluateConfig)}
    config = EvaluateConfig(**settings | {"data": data, "out": out})
    results = evaluate_all(
        forecasters,
        config,
        workers=args.workers,
        scheduler=args.scheduler,
        imports=args.imports,
        console=console,
        trained_on={
            forecaster.name: trained_on(folder_of(name), dataset)
            for name, forecaster in zip(names, forecasters, strict=True)
        },
    )
    console.print(_table(results, console))
    for sentence in sentences(results):
        say(_wrapped(sentence, console.width))
    say(f"report: {out / 'report.html'}")
    faults = {f"run {run}": why for run, why in results.left_out.items()} | results.failed
    return [f"{results.data}: {what}: {why}" for what, why in faults.items()]


def _wrapped(sentence: str, width: int) -> str:
    """Return a sentence as an item of a list; figures such as ``h = 10`` are not broken."""
    kept = re.sub(r"h = |, (?=-?[\d.]+\])|\d (?=[%\[])", _unbroken, sentence)
    lines = wrap(kept, width, initial_indent="- ", subsequent_indent="  ")
    return "\n".join(lines).replace(NO_BREAK, " ")


def _unbroken(match: re.Match[str]) -> str:
    return match[0].replace(" ", NO_BREAK)


def check(
    model: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="MODEL", help="a folder, a released model, or a baseline"),
    ],
    data: Annotated[str, tyro.conf.arg(help="a data set; its first test run is used")],
    out: Annotated[Path, tyro.conf.arg(help="a JSON file")],
    horizons: Annotated[tuple[int, ...], tyro.conf.arg(help="numbers of snapshots ahead")] = (
        1,
        2,
        5,
        10,
    ),
    null_batches: Annotated[
        int, tyro.conf.arg(help="number of batches of the training on random walks")
    ] = 2_000,
    null_walks: Annotated[
        int,
        tyro.conf.arg(help="number of random walks: two are forecast, the others are trained on"),
    ] = 12,
    seed: Annotated[
        int, tyro.conf.arg(help="seed of the walks, the symmetries and the training")
    ] = 0,
) -> None:
    """Run six checks that a causal forecaster should pass, and write what they measured.

    The checks show whether it has skill on random walks, whether it uses the future, whether it
    follows permuted hidden units, flipped hidden units and longer steps, and whether it continues a
    straight line.
    """
    if new_path(out).is_dir():
        raise IsADirectoryError(f"--out {out} is a folder: name a JSON file")
    found = check_model(
        load(model),
        data,
        horizons=horizons,
        batches=null_batches,
        walks=null_walks,
        seed=seed,
    )
    write_document(out, found)
    for name, passed in found.passed.items():
        say(f"{name}: {'passes' if passed else 'fails'}, {getattr(found, name)}")


def report(
    results: Annotated[
        tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS", help="a results.json")
    ],
    into: Annotated[
        Path | None, tyro.conf.arg(help="rewrite the sections of these results in a Markdown page")
    ] = None,
) -> None:
    """Write the page and figures of a result file again, or its sections in a Markdown page.

    Results of ``tipl live`` have no page; they go into a Markdown page only.
    """
    if is_live(here(results)):
        live_report(results, into)
        return
    document = read_results(here(results))
    if into is not None:
        insert_markdown(document, results, into)
        say(f"results in {into}")
    else:
        say(f"report: {write_report(document, results.parent)}")


def _table(results: Results, console: Output) -> Table:
    """Return the overview; where there is no room, without intervals, and with fewer columns."""
    table = _overview(results, headline(results), interval=console.width >= WIDE)
    anything = console.options.update_width(1_000)  # else it measures what the console has
    if console.measure(table, options=anything).maximum > console.width:
        table = _overview(results, compact(results), interval=False)
        table.caption = "the report has more columns, and intervals"
    return table


def _overview(results: Results, overview: tables.Table, *, interval: bool) -> Table:
    many = f"{len(results.runs)} runs" if len(results.runs) != 1 else "1 run"
    title = f"{results.data}: {many} of the {results.split} split"
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("forecaster", no_wrap=True, vertical="bottom")
    for column in overview.columns:
        table.add_column(column.replace(", ", "\n"), justify="right", no_wrap=True)
    for name, cells in overview.rows:
        texts = (cell(row, interval=interval) for row in cells)
        table.add_row(label(name), *(escape(text) for text in texts))
    return table
