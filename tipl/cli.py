"""The command ``tipl``."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import tyro
from rich.markup import escape
from rich.table import Table

import weighttraj as wt
from weighttraj.errors import WeightTrajError
from weighttraj.remote.address import here, new_path
from weighttraj.terminal import Output, say, while_read

try:
    import tipl
    from tipl import report
    from tipl.baselines import HORIZONS, TrainingConfig
    from tipl.causal import CausalTrainConfig, train_causal
    from tipl.distributed import rank_here
    from tipl.drift import DriftConfig, train_drift
    from tipl.evaluation import EvaluateConfig
    from tipl.gate import GateTrainConfig, train_gate
    from tipl.prepare import digest_of
    from tipl.refit import check_model
    from tipl.report import tables
    from tipl.report.scores import read_results
    from tipl.report.tables import cell, headline
    from tipl.train import TrainConfig
    from tipl.zoo.card import HEADLINE, listed, write_card
    from tipl.zoo.metrics import read_metrics
    from tipl.zoo.release import release
except WeightTrajError as error:
    sys.exit(f"error: {error}")

app = tyro.extras.SubcommandApp()
console = Output()
errors = Output(stderr=True)
_WIDE = 150
"""Characters that a table with intervals needs."""


@app.command(name="train")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _train(config: TrainConfig) -> None:
    """Train TIPL on the training runs of a data set, or go on where it stopped.

    In several processes: ``torchrun --nproc-per-node 2 -m tipl.cli train`` with the same options.
    """
    new_path(config.out)
    signal.signal(signal.SIGTERM, _stop)
    tipl.train(config, console=console)
    if rank_here() == 0:
        say(f"model in {config.out}")


@app.command(name="train-gate")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _train_gate(config: GateTrainConfig) -> None:
    """Train tipl-gate on the training runs of one or several data sets, or go on; minutes."""
    new_path(config.out)
    signal.signal(signal.SIGTERM, _stop)
    train_gate(config, console=console)
    say(f"model in {config.out}")


@app.command(name="train-drift")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _train_drift(config: DriftConfig) -> None:
    """Choose how far to go along a forecast, a tipl-gate's, say, by returns of validation runs."""
    new_path(config.out)
    signal.signal(signal.SIGTERM, _stop)
    drift = train_drift(config, console=console)
    say(f"model in {config.out}: {drift.amplitudes}")


@app.command(name="train-causal")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _train_causal(config: CausalTrainConfig) -> None:
    """Train tipl-causal on the training runs of one or several data sets, or go on."""
    new_path(config.out)
    signal.signal(signal.SIGTERM, _stop)
    train_causal(config, console=console)
    say(f"model in {config.out}")


@app.command(name="fit")
def _fit(
    data: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(help="a data set: path, id or address")
    ],
    out: Annotated[Path, tyro.conf.arg(help="a folder; each baseline gets its own in it")],
    seed: Annotated[int, tyro.conf.arg(help="of samples and of the small networks")] = 0,
    horizons: Annotated[tuple[int, ...], tyro.conf.arg(help="snapshots ahead")] = HORIZONS,
    steps: Annotated[int, tyro.conf.arg(help="gradient steps of each small network")] = 2000,
) -> None:
    """Fit the ladder of baselines to the training runs of a data set; minutes on one core."""
    new_path(out)
    dataset = wt.open_dataset(data)
    train = dataset.split("train").runs
    validation = [run for run in dataset if run.split == "validation"]
    with console.status("reading") as status:
        ladder = tipl.fit_ladder(
            train,
            validation,
            horizons=horizons,
            seed=seed,
            progress=status.update,
            training=TrainingConfig(steps=steps),
        )
    settings = {
        "data": data,
        "runs": {run.id: digest_of(run) for run in train},
        "seed": seed,
        "horizons": horizons,
        "steps": steps,
    }
    tipl.save_ladder(ladder, out, settings)
    say(f"{len(ladder)} baselines in {out}: {' '.join(f.name for f in ladder)}")


def _stop(*_: object) -> NoReturn:
    """`torchrun` and schedulers end a process with SIGTERM, some twice: to us that is Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt


@dataclass(frozen=True, kw_only=True)
class _Evaluate(EvaluateConfig):
    forecasters: tyro.conf.Positional[tuple[str, ...]] = ()
    """Folders of models and of fitted baselines, or names of baselines that need no fit:
    ``ema-0.95``, say."""
    workers: int = 1
    """Processes, each with one thread; each takes a run at a time."""
    imports: Annotated[tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE ...")] = ()
    """Modules that register environments (my_envs for my_envs.py); each worker imports them."""


@app.command(name="evaluate")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _evaluate(args: _Evaluate) -> None:
    """Judge forecasters on unseen runs beside a copy of the last weights; writes a report."""
    new_path(args.out)
    forecasters = [tipl.load(name) for name in args.forecasters]
    config = EvaluateConfig(
        **{field.name: getattr(args, field.name) for field in fields(EvaluateConfig)}
    )
    results = tipl.evaluate(
        forecasters, config, workers=args.workers, imports=args.imports, console=console
    )
    console.print(_table(results))
    say(report.verdict(results))
    say(f"report: {config.out / 'report.html'}")


@app.command(name="check")
def _check(
    model: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(help="a folder, a model of the zoo, or a baseline")
    ],
    data: Annotated[str, tyro.conf.arg(help="a data set; its first test run is used")],
    out: Annotated[Path, tyro.conf.arg(help="a JSON file")],
    horizons: Annotated[tuple[int, ...], tyro.conf.arg(help="snapshots ahead")] = (1, 2, 5, 10),
    null_batches: Annotated[int, tyro.conf.arg(help="of a training on random walks")] = 2_000,
    null_walks: Annotated[int, tyro.conf.arg(help="two are forecast, the others trained on")] = 12,
    seed: Annotated[int, tyro.conf.arg(help="of walks, symmetries and that training")] = 0,
) -> None:
    """Five tests that a causal forecaster should pass, as numbers.

    Whether it finds something in random walks, looks ahead, follows permuted and flipped units and
    longer steps, and goes on along a line.
    """
    if new_path(out).is_dir():
        raise IsADirectoryError(f"--out {out} is a folder: name a JSON file")
    found = check_model(
        tipl.load(model),
        data,
        horizons=horizons,
        batches=null_batches,
        walks=null_walks,
        seed=seed,
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(found, indent=1) + "\n")
    for name, passed in found["passed"].items():
        say(f"{name}: {'passes' if passed else 'fails'}, {found[name]}")


@app.command(name="zoo")
def _zoo() -> None:
    """List the released models."""
    table, wide = Table(), console.width >= _WIDE
    columns = {"name": True, "kind": wide, "causal": True, "data set": wide}
    columns |= dict.fromkeys(HEADLINE, True)
    for column, shown in columns.items():
        if shown:
            justify: Literal["left", "right"] = "right" if column in HEADLINE else "left"
            table.add_column(column, justify=justify, no_wrap=column == "name")
    for name in tipl.zoo.names():
        cells = zip(listed(name, interval=wide), columns.values(), strict=True)
        table.add_row(*(escape(text) for text, shown in cells if shown))
    console.print(table)


@app.command(name="release")
def _release(
    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="of a trained model")],
    name: Annotated[str, tyro.conf.arg(help="in the zoo")],
    results: Annotated[
        Path | None, tyro.conf.arg(help="results.json that judged the model of the zoo")
    ] = None,
    checks: Annotated[Path | None, tyro.conf.arg(help="what `tipl check` wrote of it")] = None,
    log: Annotated[bool, tyro.conf.arg(help="keep some lines of the training's log")] = True,
) -> None:
    """Put a model into the zoo: once as a draft, and with its results after it was judged there."""
    out = release(here(folder), name, results=results, checks=checks, log=log)
    say(f"model in {out}")
    if read_metrics(out) is None:
        say(f"a draft: judge it with `tipl evaluate {name} ...`, then give --results")


@app.command(name="card")
def _card(
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="a model of the zoo")],
    out: Annotated[Path, tyro.conf.arg(help="folder of the cards")] = Path("cards/models"),
) -> None:
    """Write the card of a model, or the figures of its metrics.json into the card that is there."""
    say(f"card in {write_card(name, new_path(out))}")


@app.command(name="push")
def _push(
    model: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(help="a folder, or a model of the zoo")
    ],
    address: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(help="hf://organisation/name, or s3://bucket/name")
    ],
    private: Annotated[
        bool, tyro.conf.arg(help="of a new repository: only its organisation sees it")
    ] = False,
    card: Annotated[
        Path | None, tyro.conf.arg(help="its card; one of the zoo brings its own")
    ] = None,
) -> None:
    """Publish a model with its card, on the Hugging Face hub or in an object store."""
    say(f"published: {tipl.push(model, address, private=private, card=card)}")


@app.command(name="report")
def _report(
    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="a results.json")],
    into: Annotated[
        Path | None, tyro.conf.arg(help="rewrite the places of these results in a Markdown page")
    ] = None,
) -> None:
    """Write the page and figures of a result file again, or its places in a Markdown page."""
    document = read_results(here(results))
    if into is not None:
        report.insert_markdown(document, results, into)
        say(f"results in {into}")
    else:
        say(f"report: {report.write_report(document, results.parent)}")


def _table(results: dict[str, Any]) -> Table:
    """The overview; where there is no room, without intervals, and with fewer columns."""
    (overview,) = headline(results)
    shown = range(len(overview.columns))
    table = _overview(results, overview, shown, interval=console.width >= _WIDE)
    anything = console.options.update_width(1_000)  # else it measures what the console has
    if console.measure(table, options=anything).minimum > console.width:
        few = [i for i in shown if overview.columns[i].startswith(("skill", "gain"))]
        table = _overview(results, overview, few, interval=False)
        table.caption = "the report has more columns, and intervals"
    return table


def _overview(
    results: dict[str, Any], overview: tables.Table, shown: Iterable[int], *, interval: bool
) -> Table:
    table = Table(title=f"{results['data']}, {results['split']} runs: {', '.join(results['runs'])}")
    table.add_column("forecaster", no_wrap=True)
    for i in shown:
        table.add_column(overview.columns[i], justify="right")
    for name, cells in overview.rows:
        texts = (cell(cells[i], interval=interval) for i in shown)
        table.add_row(report.label(name), *(escape(text) for text in texts))
    return table


def main() -> None:
    """Run the command line; errors of ours are printed without a traceback."""
    try:
        _run()
    except KeyboardInterrupt:  # while an error is printed, too
        errors.print("stopped; give the same command again to go on")
        sys.exit(130)


def _run() -> None:
    try:
        with while_read():
            app.cli(prog="tipl", description="Forecasts of policy weights: train and judge models.")
    except (WeightTrajError, OSError) as error:
        errors.print(f"[red]error:[/red] {escape(str(error))}")
        sys.exit(1)


if __name__ == "__main__":
    main()
