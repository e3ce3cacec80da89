"""From forecasters and a data set to results."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

import weighttraj as wt
from tipl.errors import EvaluateError
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.measure import Measured, Task, function_starts, measure
from tipl.evaluation.results import Results, StartCounts, write_document
from tipl.evaluation.returns import MODES
from tipl.evaluation.rows import Seen, data_fingerprint, rows_of, write_rows
from tipl.evaluation.starts import starts_of
from tipl.evaluation.summary import Summary
from tipl.forecaster import Forecaster, check_forecaster
from tipl.registry import load
from tipl.runs import fault_of, weights_of, without_faults
from weighttraj.engine import Engine, engine_of
from weighttraj.progress import LoggedProgress


def evaluate_only(
    forecasters: Sequence[Forecaster],
    config: EvaluateConfig,
    workers: int,
    imports: Sequence[str],
    console: Console,
    trained_on: Mapping[str, Seen] | None = None,
    scheduler: str | None = None,
) -> Results:
    """Evaluate forecasters, and write ``results.json`` and ``rows.csv``.

    ``tipl.evaluate`` writes a page, too. ``trained_on`` says for names of forecasters what they
    were trained on.
    """
    config, everyone = config.bounded(), _everyone(forecasters)
    dataset = wt.open_dataset(config.data)
    runs, left_out = _whole_runs(dataset.split(config.split).runs, config)
    _check_runs(runs, config)
    config = replace(
        _within(config, min(len(run) for run in runs) // 2),
        out=config.out.absolute(),  # workers of a cluster run elsewhere
    )
    tasks = [Task(path=run.path.absolute(), forecasters=everyone, config=config) for run in runs]
    starts_of(runs[0], config)  # refuses too short runs, and runs without returns, before the work
    with engine_of(workers, scheduler, imports) as engine:
        measured = _measure(tasks, engine, console)
    everyone, failed = _without_failed(everyone, measured)
    summary = Summary(measured, config, everyone[0].name)
    results = Results(
        data=dataset.info.id,
        version=dataset.info.version,
        split=config.split,
        runs=tuple(run.id for run in runs),
        left_out=left_out,
        failed=failed,
        env_steps_per_snapshot=_env_steps_of(runs[0]),
        horizons=config.horizons,
        return_horizons=config.return_horizons if config.learning_starts else (),
        modes=MODES if config.learning_starts else (),
        episodes=config.episodes,
        seed=config.seed,
        quick=config.quick,
        starts=_start_counts(measured),
        noise_floor=summary.noise() if config.learning_starts else {},
        forecasters={forecaster.name: summary.of(forecaster) for forecaster in everyone},
        command=" ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    )
    rows = rows_of(
        measured,
        config,
        task=dataset.info.id,
        fingerprint=data_fingerprint(runs),
        persistence=everyone[0].name,
        failed=failed,
        trained_on=dict(trained_on or {}) | {everyone[0].name: "nothing"},
        oracles=[forecaster.name for forecaster in everyone if forecaster.is_oracle],
    )
    write_rows(config.out / "rows.csv", rows)
    write_document(config.out / "results.json", results)
    return results


def _start_counts(measured: Sequence[Measured]) -> StartCounts:
    """Return how many starts all runs have together."""
    return StartCounts(
        weights=sum(len(m.starts.weights) for m in measured),
        policies=sum(len(m.function_starts) for m in measured),
        learning=sum(len(m.starts.learning) for m in measured),
        plateau=sum(len(m.starts.plateau) for m in measured),
    )


def _everyone(forecasters: Sequence[Forecaster]) -> tuple[Forecaster, ...]:
    """Return what is evaluated: persistence, the forecasters, and their oracles."""
    for forecaster in forecasters:
        check_forecaster(forecaster)
    persistence = load("persistence")
    oracles = {o.name: o for f in forecasters for o in getattr(f, "oracles", ())}
    everyone = (
        persistence,
        *(f for f in forecasters if f.name != persistence.name),
        *(oracles[name] for name in sorted(oracles)),
    )
    names = [f.name for f in everyone]
    if len(set(names)) < len(names):
        raise EvaluateError(
            "two forecasters have the same name",
            got=names,
            do="a model is named after its folder: rename one",
        )
    return everyone


def _without_failed(
    everyone: Sequence[Forecaster], measured: Sequence[Measured]
) -> tuple[tuple[Forecaster, ...], dict[str, str]]:
    """Return the forecasters that gave a forecast of every run, and why the others did not."""
    failed = {name: why for m in reversed(measured) for name, why in m.failed.items()}
    kept = tuple(forecaster for forecaster in everyone if forecaster.name not in failed)
    if len(kept) == 1 < len(everyone):
        raise EvaluateError(
            "no forecaster could be evaluated",
            expected="at least one beside persistence",
            got="; ".join(failed.values()),
            do="mend the forecasters",
        )
    return kept, failed


def _whole_runs(
    runs: Sequence[wt.Run], config: EvaluateConfig
) -> tuple[list[wt.Run], dict[str, str]]:
    """Leave out runs that nothing can be evaluated on, and say why."""
    kept, faults = without_faults(runs, lambda run: fault_of(weights_of(run)))
    if not kept:
        raise EvaluateError(
            "none of the runs can be evaluated on",
            expected="runs with finite weights that change",
            got="; ".join(f"{run}: {why}" for run, why in faults.items()),
            where=f"{config.data}, split {config.split}",
            do="choose another --split, or collect other runs",
        )
    return kept, faults


def _within(config: EvaluateConfig, half: int) -> EvaluateConfig:
    """Return the config without horizons beyond half of the shortest run."""
    config = replace(config, horizons=_up_to(half, config.horizons, "--horizons"))
    if not config.learning_starts:
        return config
    return replace(
        config, return_horizons=_up_to(half, config.return_horizons, "--return-horizons")
    )


def _up_to(half: int, horizons: Sequence[int], option: str) -> tuple[int, ...]:
    found = tuple(h for h in horizons if h <= half)
    if not found:
        raise EvaluateError(
            "the runs are too short to be forecast so far",
            expected=f"{option} of at most {half}, half of the shortest run",
            got=" ".join(map(str, horizons)),
            do=f"choose smaller {option}, or collect longer runs",
        )
    return found


def _env_steps_of(run: wt.Run) -> float:
    """Return the mean number of environment steps from one snapshot to the next."""
    first, last = (int(run["index/num_timesteps"][i]) for i in (0, -1))
    return (last - first) / (len(run) - 1)


def _check_runs(runs: Sequence[wt.Run], config: EvaluateConfig) -> None:
    layouts = {run.layout for run in runs}
    if len(layouts) > 1:
        raise EvaluateError(
            "the runs have policies of different structure",
            expected="one layout of the parameters",
            got=sorted(f"{layout.size} parameters" for layout in layouts),
            where=f"{config.data}, split {config.split}",
            do="evaluate on one kind of policy at a time",
        )
    if config.function_starts and any(not run.info.probe_observations for run in runs):
        raise EvaluateError(
            "the runs have no stored observations to compare policies on",
            expected="probe observations",
            where=config.data,
            do="collect with probe_observations, or give --function-starts 0",
        )


def _measure(tasks: Sequence[Task], engine: Engine, console: Console) -> list[Measured]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    measured: dict[wt.Place, Measured] = {}
    with LoggedProgress(*columns, console=console) as progress:
        bars = {
            what: progress.add_task(what, total=total)
            for what, total in _totals(tasks).items()
            if total
        }

        def note(what: str, count: int) -> None:
            progress.advance(bars[what], count)

        for task, outcome in engine.run(measure, tasks, note, wait=False):
            if isinstance(outcome, Exception):
                raise outcome
            measured[task.path] = outcome
    return [measured[task.path] for task in tasks]


def _totals(tasks: Sequence[Task]) -> dict[str, int]:
    """Return how much there is to do: starts for weights and policies, policies for returns."""
    totals = {"weights": 0, "policies": 0, "returns": 0}
    for task in tasks:
        config, n = task.config, len(task.forecasters)
        starts = starts_of(wt.open_run(task.path), config)
        totals["weights"] += n * len(starts.weights)
        totals["policies"] += n * len(function_starts(starts, config))
        of_returns = len(starts.learning) + len(starts.plateau)
        forecasts = (1 + n) * len(config.return_horizons)
        totals["returns"] += len(MODES) * of_returns * (1 + forecasts)
    return totals
