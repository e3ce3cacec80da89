"""Results as one page that opens from disk: what ``tipl evaluate`` writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
from rich.console import Console

from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.evaluate import evaluate_only
from tipl.evaluation.results import Results
from tipl.evaluation.rows import Seen
from tipl.forecaster import Forecaster
from tipl.report.figures import figures, file_name, png, svg
from tipl.report.sentences import sentences
from tipl.report.tables import cell, compact, label, tables
from weighttraj.atomic import replace_file


def evaluate(
    forecasters: Sequence[Forecaster],
    config: EvaluateConfig,
    *,
    workers: int = 1,
    imports: Sequence[str] = (),
    console: Console | None = None,
    trained_on: Mapping[str, Seen] | None = None,
    scheduler: str | None = None,
) -> Results:
    """Evaluate forecasters beside persistence; write ``results.json``, a page and figures.

    Measurements are kept in ``config.out``: the same call goes on where it stopped, and further
    forecasters only cost their own measurements.

    Args:
        forecasters: what is evaluated; persistence is added, and the oracle of each TIPL's rank.
        config: on what, and how much.
        workers: number of processes; 1 means this one.
        imports: modules that register environments; every worker imports them.
        console: where progress is shown; None: nowhere.
        trained_on: what forecasters were trained on, by name: runs of this data set, of others,
            or nothing; it stands in ``rows.csv``.
        scheduler: address of a Dask scheduler whose workers do it instead, or ``local``; they must
            see the data and ``config.out`` at the same paths.

    Returns:
        What ``results.json`` holds.

    Raises:
        EvaluateError: the runs do not fit together, are too short, or have no returns, or two
            forecasters have one name.
        KeyboardInterrupt: it was stopped; the measurements stay.
    """
    results = evaluate_only(
        forecasters,
        config,
        workers,
        imports,
        console or Console(quiet=True),
        trained_on,
        scheduler,
    )
    write_report(results, config.out)
    return results


def write_report(results: Results, out: Path) -> Path:
    """Write the page and the figures beside ``results.json``; return the path of the page.

    Raises:
        FormatError: a link is in the place of one: the folder may be a stranger's.
    """
    drawn = figures(results)
    for title, figure in drawn.items():
        replace_file(out / file_name(title), png(figure, dpi=150), root=out)
    loader = jinja2.PackageLoader("tipl", "templates")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    page = environment.get_template("report.html").render(
        results=results,
        sentences=sentences(results),
        overview=compact(results),
        tables=tables(results),
        figures={title: svg(figure) for title, figure in drawn.items()},
        label=label,
        cell=cell,
    )
    path = out / "report.html"
    replace_file(path, page.encode(), root=out)
    return path
