"""Variants of tipl-gate: trained on the same runs, and evaluated on the same starts of others."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

import weighttraj as wt
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.starts import starts_of
from tipl.evaluation.statistics import Bootstrap, Cell, quotient
from tipl.evaluation.weights import squared_errors
from tipl.forecaster import Forecaster
from tipl.models.baselines import Persistence
from tipl.models.gate import GateTrainConfig, train_gate
from weighttraj.engine import Tell, engine_of

HORIZONS = (1, 10, 50, 200)
BOOTSTRAP = Bootstrap(resamples=2000, seed=0)


def errors_of(forecaster: Forecaster, data: str | Path) -> np.ndarray:
    """Sums of squared errors, (run, horizon)."""
    starts = EvaluateConfig(data=data, out=Path(), learning_starts=0)
    return np.array(
        [
            squared_errors(
                forecaster, run, starts_of(run, starts).weights, HORIZONS, lambda _: None
            )["squared"].sum((0, 2))
            for run in wt.open(data).split("test").runs
        ]
    )


def train_and_evaluate(config: GateTrainConfig, tell: Tell) -> np.ndarray:
    """One variant."""
    return errors_of(train_gate(config), config.data[0])


def compare(variants: Mapping[str, GateTrainConfig], whole: str, workers: int) -> dict[str, Any]:
    """Skills, and differences from one of them, on the same starts.

    Args:
        variants: trainings by name, all on one data set.
        whole: name of the one that the others are compared with.
        workers: processes.
    """
    ((data,),) = {config.data for config in variants.values()}
    (n_batches,) = {config.training.n_batches for config in variants.values()}
    errors: dict[str, np.ndarray] = {}
    names = {config.out: name for name, config in variants.items()}
    with ExitStack() as stack:
        engine = stack.enter_context(engine_of(workers))
        progress = stack.enter_context(Progress())
        task = progress.add_task("networks", total=len(variants))
        for config, outcome in engine.run(
            train_and_evaluate, list(variants.values()), lambda *_: None
        ):
            if isinstance(outcome, Exception):
                raise outcome
            errors[names[config.out]] = outcome
            progress.advance(task)
    copy = errors_of(Persistence(), data)
    return {
        "data": wt.open(data).info.id,
        "n_batches": n_batches,
        "test_runs": len(copy),
        "horizons": HORIZONS,
        "skill": {name: BOOTSTRAP.interval(_skill, errors[name], copy) for name in variants},
        "difference": {
            name: BOOTSTRAP.interval(_more, errors[name], errors[whole], copy)
            for name in variants
            if name != whole
        },
    }


def _skill(error: np.ndarray, copy: np.ndarray) -> np.ndarray:
    return 1 - quotient(error.sum(0), copy.sum(0))


def _more(error: np.ndarray, other: np.ndarray, copy: np.ndarray) -> np.ndarray:
    return _skill(error, copy) - _skill(other, copy)


def table(result: dict[str, Any]) -> str:
    """Skill of the whole, and what is more or less with the others."""
    (whole,) = result["skill"].keys() - result["difference"].keys()
    horizons = " | ".join(f"h = {h}" for h in result["horizons"])
    lines = [
        f"| skill, or what it is more than that of {whole} | {horizons} |",
        "|---|" + "---:|" * len(result["horizons"]),
        f"| {whole} | {' | '.join(map(_told, result['skill'][whole]))} |",
    ]
    lines += [
        f"| {name} | " + " | ".join(map(partial(_told, sign="+"), cells)) + " |"
        for name, cells in result["difference"].items()
    ]
    return "\n".join(
        [
            *lines,
            "",
            f"`{result['data']}`, {result['test_runs']} test runs, all starts; "
            f"{result['n_batches']:,} batches each. 95 % intervals: bootstrap over runs, of the "
            "difference on the same starts.",
        ]
    )


def _told(cell: Cell, sign: str = "") -> str:
    value, low, high = (f"{cell[key]:{sign}.3f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]"
