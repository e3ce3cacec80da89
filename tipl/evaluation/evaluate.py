"""From forecasters and a data set to results."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

import weighttraj as wt
from tipl.baselines import Persistence, Reconstruction
from tipl.errors import EvaluateError
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.measure import Measured, Task, function_starts, measure
from tipl.evaluation.parts import fingerprint
from tipl.evaluation.returns import MODES, is_floor
from tipl.evaluation.starts import starts_of
from tipl.evaluation.summary import Summary
from tipl.forecast import TIPL, Forecaster
from tipl.report import write_report
from weighttraj.engine import Engine, engine_of
from weighttraj.progress import LoggedProgress


def evaluate(
    forecasters: Sequence[Forecaster],
    config: EvaluateConfig,
    *,
    workers: int = 1,
    imports: Sequence[str] = (),
    console: Console | None = None,
) -> dict[str, Any]:
    """Judge forecasters beside the copy of the last weights; writes results and a page.

    Writes ``results.json``, ``report.html`` and figures into ``config.out``, and keeps there what
    was measured: the same call goes on where it stopped, and more forecasters cost only their own.

    Args:
        forecasters: who is judged; the copy is added, and the floor of each TIPL's rank.
        config: on what, and how much.
        workers: processes; 1 means this one.
        imports: modules that register environments; every worker imports them.
        console: where progress is shown; None: nowhere.

    Returns:
        What ``results.json`` holds.

    Raises:
        EvaluateError: the runs do not fit together, are too short, or have no returns, or two
            forecasters have one name.
        KeyboardInterrupt: it was stopped; what was measured stays.
    """
    config = config.bounded()
    dataset = wt.open_dataset(config.data)
    runs = dataset.split(config.split).runs
    _check_runs(runs, config)
    half = min(len(run) for run in runs) // 2
    config = replace(config, horizons=_up_to(half, config.horizons, "--horizons"))
    if config.learning_starts:
        within = _up_to(half, config.return_horizons, "--return-horizons")
        config = replace(config, return_horizons=within)
    copy = Persistence()
    ranks = sorted({f.config.gpt.rank for f in forecasters if isinstance(f, TIPL)})
    floors = (Reconstruction(rank) for rank in ranks)
    everyone = (copy, *(f for f in forecasters if f.name != copy.name), *floors)
    _check_names(everyone)
    tasks = [Task(path=run.path.absolute(), forecasters=everyone, config=config) for run in runs]
    starts_of(runs[0], config)  # too short, or no returns: said before hours of work
    with engine_of(workers, imports=imports) as engine:
        measured = _measure(tasks, engine, console or Console(quiet=True))
    summary = Summary(measured, config, copy.name)
    results = {
        "data": dataset.info.id,
        "version": dataset.info.version,
        "split": config.split,
        "runs": [run.id for run in runs],
        "env_steps_per_snapshot": _env_steps_of(runs[0]),
        "horizons": list(config.horizons),
        "return_horizons": list(config.return_horizons) if config.learning_starts else [],
        "modes": list(MODES) if config.learning_starts else [],
        "episodes": config.episodes,
        "seed": config.seed,
        "quick": config.quick,
        "starts": {
            "weights": sum(len(m.starts.weights) for m in measured),
            "policies": sum(len(m.function_starts) for m in measured),
            "learning": sum(len(m.starts.learning) for m in measured),
            "plateau": sum(len(m.starts.plateau) for m in measured),
        },
        "noise_floor": summary.noise() if config.learning_starts else {},
        "forecasters": {
            f.name: {
                "kind": getattr(f, "kind", None),
                "causal": f.causal,
                "floor": is_floor(f),
                "fingerprint": fingerprint(f),
                **summary.of(f.name),
            }
            for f in everyone
        },
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    write_report(results, config.out)
    return results


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
    """Environment steps from one snapshot to the next, a mean over the run."""
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
            do="judge on one kind of policy at a time",
        )
    if config.function_starts and any(not run.info.probe_observations for run in runs):
        raise EvaluateError(
            "the runs have no stored observations to compare policies on",
            expected="probe observations",
            where=config.data,
            do="collect with probe_observations, or give --function-starts 0",
        )


def _check_names(forecasters: Sequence[Forecaster]) -> None:
    names = [f.name for f in forecasters]
    if len(set(names)) < len(names):
        raise EvaluateError(
            "two forecasters have the same name",
            got=names,
            do="a model is named after its folder: rename one",
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
    """How much there is to do: starts for weights and policies, policies for returns."""
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


__all__ = ["evaluate"]
