"""The command ``tipl``."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from weighttraj.errors import WeightTrajError

try:
    import tipl
    from tipl import report
    from tipl.evaluate import EvaluateConfig
    from tipl.train import TrainConfig
except WeightTrajError as error:
    sys.exit(f"error: {error}")

app = tyro.extras.SubcommandApp()
console = Console()


@app.command(name="train")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _train(config: TrainConfig) -> None:
    """Train TIPL on the training runs of a data set, or go on where it stopped."""
    tipl.train(config, console=console)
    print(f"model in {config.out}")


@dataclass(frozen=True, kw_only=True)
class _Evaluate(EvaluateConfig):
    models: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of trained models."""


@app.command(name="evaluate")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _evaluate(config: _Evaluate) -> None:
    """Judge models on unseen runs beside a copy of the last weights; writes a report."""
    models = [tipl.TIPL.load(path) for path in config.models]
    results = tipl.evaluate(models, config, console=console)
    console.print(_table(results))
    print(report.verdict(results))
    print(f"report: {config.out / 'report.html'}")


@app.command(name="report")
def _report(
    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="a results.json")],
    into: Annotated[
        Path | None, tyro.conf.arg(help="rewrite the results' table in this Markdown page")
    ] = None,
) -> None:
    """Write the page and figures of a result file again, or its table into a Markdown page."""
    document = json.loads(results.read_text())
    if into is not None:
        report.insert_markdown(document, results, into)
        print(f"table in {into}")
    else:
        print(f"report: {report.write_report(document, results.parent)}")


def _table(results: dict[str, Any]) -> Table:
    modes = results["modes"]
    table = Table(title=f"{results['data']}, {results['split']} runs: {', '.join(results['runs'])}")
    for column in ("forecaster", "h", "WPE", "skill", *(f"REPW {mode}" for mode in modes)):
        table.add_column(column, justify="left" if column == "forecaster" else "right")
    for row in report.table(results):
        if row["h"] in report.SHOWN_HORIZONS:
            interval = "" if row["low"] is None else f" [{row['low']:.3g}, {row['high']:.3g}]"
            cells = [f"{row['wpe']:.3g}", f"{row['value']:.3g}{interval}"]
            cells += [f"{row['repw'][mode]:.1f}" for mode in modes]
            table.add_row(report.label(row["name"]), str(row["h"]), *cells)
    return table


def main() -> None:
    """Run the command line; errors of ours are printed without a traceback."""
    try:
        app.cli(prog="tipl", description="Forecasts of policy weights: train and judge models.")
    except (WeightTrajError, FileNotFoundError) as error:
        console.print(f"[red]error:[/red] {escape(str(error))}")
        sys.exit(1)
    except KeyboardInterrupt:
        console.print("stopped; give the same command again to go on")
        sys.exit(130)


if __name__ == "__main__":
    main()
