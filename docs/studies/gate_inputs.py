"""What is each input of tipl-gate worth? It is trained without each, and judged on test runs.

python docs/studies/gate_inputs.py --models data/results/gate-inputs   # train, measure, render
python docs/studies/gate_inputs.py                                     # render what was measured

Trainings that stopped go on. Writes gate_inputs.json and the table in gate_inputs.md, beside this
file.
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from page import insert as insert_into
from rich.progress import Progress

import weighttraj as wt
from tipl.baselines import Persistence
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.starts import starts_of
from tipl.evaluation.statistics import Bootstrap, Interval, quotient
from tipl.evaluation.weights import squared_errors
from tipl.forecast import Forecaster
from tipl.gate import GateTrainConfig, train_gate
from tipl.models.gate import Input
from weighttraj.engine import Tell, engine_of

HERE = Path(__file__)
RESULTS, PAGE = HERE.with_suffix(".json"), HERE.with_suffix(".md")
DATA = "inverted-pendulum-v4-ppo-v1"
HORIZONS = (1, 10, 50, 200)
WHOLE, AGAIN = "all inputs", "all inputs, another seed"
BOOTSTRAP = Bootstrap(resamples=2000, seed=0)


def configs(models: Path, n_batches: int) -> dict[str, GateTrainConfig]:
    """What is trained."""

    def config(name: str, seed: int, *without: Input) -> GateTrainConfig:
        out = models / name.replace(", ", "-").replace(" ", "-")
        return GateTrainConfig(
            data=(DATA,), out=out, n_batches=n_batches, seed=seed, without=without
        )

    found = {WHOLE: config(WHOLE, 0), AGAIN: config(AGAIN, 1)}
    for name in get_args(Input):
        found[f"without {name}"] = config(f"without {name}", 0, name)
    return found


def errors_of(forecaster: Forecaster) -> np.ndarray:
    """Sums of squared errors, (run, horizon)."""
    starts = EvaluateConfig(data=DATA, out=Path(), learning_starts=0)
    return np.array(
        [
            squared_errors(
                forecaster, run, starts_of(run, starts).weights, HORIZONS, lambda _: None
            )["squared"].sum((0, 2))
            for run in wt.open(DATA).split("test").runs
        ]
    )


def train_and_judge(config: GateTrainConfig, tell: Tell) -> np.ndarray:
    """One variant."""
    return errors_of(train_gate(config))


def measure(models: Path, n_batches: int, workers: int) -> dict[str, Any]:
    """Skills, and differences from the network that sees all, on the same starts."""
    wanted = configs(models, n_batches)
    with ExitStack() as stack:
        engine = stack.enter_context(engine_of(workers))
        progress = stack.enter_context(Progress())
        task = progress.add_task("networks", total=len(wanted))
        errors: dict[str, np.ndarray] = {}
        names = {config.out: name for name, config in wanted.items()}
        for config, outcome in engine.run(train_and_judge, list(wanted.values()), lambda *_: None):
            if isinstance(outcome, Exception):
                raise outcome
            errors[names[config.out]] = outcome
            progress.advance(task)
    copy = errors_of(Persistence())
    compare = partial(BOOTSTRAP.interval, _more)
    return {
        "data": DATA,
        "n_batches": n_batches,
        "test_runs": len(copy),
        "horizons": HORIZONS,
        "skill": {name: BOOTSTRAP.interval(_skill, errors[name], copy) for name in wanted},
        "difference": {
            name: compare(errors[name], errors[WHOLE], copy) for name in wanted if name != WHOLE
        },
    }


def _skill(error: np.ndarray, copy: np.ndarray) -> np.ndarray:
    return 1 - quotient(error.sum(0), copy.sum(0))


def _more(error: np.ndarray, other: np.ndarray, copy: np.ndarray) -> np.ndarray:
    return _skill(error, copy) - _skill(other, copy)


def table(result: dict[str, Any]) -> str:
    """Skills, and what each input adds to them."""
    horizons = " | ".join(f"h = {h}" for h in result["horizons"])
    whole = " | ".join(map(_told, result["skill"][WHOLE]))
    lines = [
        f"| skill, or what it is more than that of {WHOLE} | {horizons} |",
        "|---|" + "---:|" * len(result["horizons"]),
        f"| {WHOLE} | {whole} |",
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


def _told(cell: Interval, sign: str = "") -> str:
    value, low, high = (f"{cell[key]:{sign}.3f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]"


def insert(page: str) -> str:
    """The page with the table as the results have it."""
    return insert_into(page, HERE, table(json.loads(RESULTS.read_text())))


def main() -> None:
    """Measure, if a folder for the models is given, and render."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", type=Path, help="folder of the trained networks")
    parser.add_argument("--n-batches", type=int, default=4_000)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    if args.models:
        RESULTS.write_text(json.dumps(measure(args.models, args.n_batches, args.workers)) + "\n")
    PAGE.write_text(insert(PAGE.read_text()))


if __name__ == "__main__":
    main()
