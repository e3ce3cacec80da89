"""Every way to forecast policy weights, on seven tasks: trains, evaluates, writes docs/results.md.

python docs/results/make_results.py --plan      # the commands, and what they cost
python docs/results/make_results.py --run       # run them; stopped, the same command goes on
python docs/results/make_results.py             # write the page from the rows in docs/results/rows

Each command is one of `tipl`, so any of them can be run alone. Models and measurements go to
data/results; the rows of all evaluations, which are all that the page is made of, to
docs/results/rows. A CSV file that somebody adds there joins the tables.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from answers import answers, findings
from board import (
    ABLATION_BATCHES,
    ABLATION_SEEDS,
    ABLATION_TASKS,
    HERE,
    PAPER,
    PAPER_SPLITS,
    RIVAL,
    ROWS,
    SEEDS,
    SIMPLE,
    TASKS,
    VARIANTS,
    Board,
    read,
)
from result_figures import figures
from result_tables import (
    ablation_table,
    paper_table,
    returns_table,
    transfer_table,
    weights_table,
)

from tipl.evaluation.leaderboard import leaderboard
from tipl.evaluation.results import Row, read_results
from tipl.evaluation.rows import TaskRow
from tipl.report.figures import svg
from tipl.report.leaderboard import write_page
from weighttraj.terminal import say
from weighttraj.text import between

ROOT = HERE.parents[1]
PAGE, README = HERE.parent / "results.md", ROOT / "README.md"
COST = HERE / "cost.json"
OUT = Path("data/results")

STRETCHED = ("last-iteration", "ema-0.9", "tipl-gate", "trend-20", "ar-20-phase", "relex-50")
"""Forecasts that are stretched by what the returns of validation runs say, all with one grid."""
AMPLITUDES = "0.125 0.25 0.5 1 2 4"
ABOUT = {
    "NAME-stretched": "The forecast NAME, its displacement multiplied at each horizon by the "
    "factor with the highest gain on validation runs.",
    "gate-elsewhere": "tipl-gate trained on the six other tasks.",
    "gate-timed": "tipl-gate that also reads the number of the snapshot.",
    **{
        name: f"Line {i} of the ablation: {text.replace('+', 'the line before, changed:', 1)}."
        for i, (name, text) in enumerate(VARIANTS.items(), 1)
    },
    "tipl-gate": "One small network for all parameters, trained on all seven tasks.",
    "Others": "Baselines, which the page “Train” describes.",
}
"""What the leaderboard says of its forecasters."""
PUBLISHED, PAPER_DATA = "tipl-inverted-pendulum-v4", "inverted-pendulum-v4-ppo-v1"


@dataclass(frozen=True, kw_only=True)
class Step:
    """Some commands that belong together."""

    name: str
    commands: tuple[str, ...]


def plan() -> list[Step]:
    """Return all commands in order."""
    everything = " ".join(TASKS)
    every_task = f"tipl train gate --without time --data {everything}"
    gates = [f"{every_task} --out {OUT}/all/tipl-gate@{s} --seed {s}" for s in SEEDS]
    gates += [
        f"tipl train gate --data {everything} --out {OUT}/all/gate-timed@0 --seed 0",
        *(
            "tipl train gate --without time --data "
            f"{' '.join(other for other in TASKS if other != task)} "
            f"--out {OUT}/{task}/gate-elsewhere@0 --seed 0"
            for task in TASKS
        ),
    ]
    return [
        Step(
            name="baselines",
            commands=tuple(
                f"tipl train baselines --data {task} --out {OUT}/{task}/baselines" for task in TASKS
            ),
        ),
        Step(name="gates", commands=tuple(gates)),
        Step(name="from TIPL to tipl-gate", commands=tuple(_ablation())),
        Step(name="stretched forecasts", commands=tuple(_stretched())),
        Step(
            name="evaluation",
            commands=(
                _evaluation("weights", _in_weights()),
                _evaluation("ablation", _on_ablation(), ABLATION_TASKS),
                _evaluation("returns", _in_returns()),
            ),
        ),
        Step(
            name="the paper's setting",
            commands=tuple(
                f"tipl evaluate {PUBLISHED} --data {PAPER_DATA} --split {split} "
                f"--out {OUT}/paper/{split} --horizons 1 10 --starts 100 --function-starts 0 "
                "--return-horizons 1 10 --learning-starts 2 --plateau-starts 1 --episodes 5"
                for split in PAPER_SPLITS
            ),
        ),
    ]


def _ablation() -> Iterator[str]:
    batches = f"--n-batches {ABLATION_BATCHES}"
    tipl = f"{batches} --warmup 100 --save-every 250"
    better = f"{tipl} --schedule cosine --ema 0.99"
    for seed in ABLATION_SEEDS:
        for task in ABLATION_TASKS:
            for name, kind, options in (
                ("tipl-published", "tipl", tipl),
                ("tipl-decayed", "tipl", better),
                ("tipl-residual", "tipl", f"{better} --residual"),
                ("causal-first", "causal", f"{batches} --unit first"),
                ("causal", "causal", batches),
                ("gate-own", "gate", "--without time"),
            ):
                out = f"{OUT}/{task}/{name}@{seed}"
                yield f"tipl train {kind} --data {task} --out {out} --seed {seed} {options}"


def _stretched() -> Iterator[str]:
    for name in STRETCHED:
        for task in TASKS:
            along = {
                "tipl-gate": f"{OUT}/all/tipl-gate@0",
                RIVAL: f"{OUT}/{task}/baselines/{RIVAL}",
            }
            yield (
                f"tipl train stretched --along {along.get(name, name)} --data {task} "
                f"--out {OUT}/{task}/{name}-stretched --horizons 50 100 --amplitudes {AMPLITUDES} "
                "--starts 6 --episodes 10"
            )


def _in_weights() -> list[str]:
    fitted = ("ar-20", RIVAL, "ar-20-svd", "cmd", "lfd-2", "ema-0.9-shrunk", "wnn", "nino-mlp")
    simple = ("last-step", "last-iteration", "ema-0.9", "trend-20", "dmd")
    rivals = ("lines-50", "relex-50", "pptb-4")
    return [
        *simple,
        *rivals,
        *(f"{OUT}/{{data}}/baselines/{name}" for name in fitted),
        *(f"{OUT}/all/tipl-gate@{seed}" for seed in SEEDS),
        f"{OUT}/all/gate-timed@0",
        f"{OUT}/{{data}}/gate-elsewhere@0",
        "tipl.models.baselines.reconstruction:PathOracle",
    ]


def _in_returns() -> list[str]:
    return [
        *(f"{OUT}/{{data}}/{name}-stretched" for name in STRETCHED),
        f"{OUT}/all/tipl-gate@0",
        f"{OUT}/{{data}}/gate-elsewhere@0",
        f"{OUT}/{{data}}/baselines/{RIVAL}",
    ]


def _on_ablation() -> list[str]:
    names = [name for name in VARIANTS if name != "tipl-gate"]
    return [f"{OUT}/{{data}}/{name}@{seed}" for name in names for seed in ABLATION_SEEDS]


def _evaluation(name: str, forecasters: Sequence[str], tasks: Sequence[str] = tuple(TASKS)) -> str:
    returns = "--learning-starts 0"
    if name == "returns":
        returns = "--learning-starts 4 --plateau-starts 0 --return-horizons 10 50 100 --episodes 10"
    return (
        f"tipl evaluate {' '.join(forecasters)} --data {' '.join(tasks)} --out {OUT}/{name} "
        f"--horizons 1 10 50 200 --starts 300 --function-starts 50 {returns}"
    )


def run(steps: Sequence[Step]) -> None:
    """Run the commands, one after another; note what each step cost."""
    costs = json.loads(COST.read_text()) if COST.exists() else {}
    threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    for step in steps:
        for command in step.commands:
            say(f"$ {command}")
            before = _cpu_seconds()
            words = [sys.executable, "-m", *shlex.split(command)]
            ended = subprocess.run(  # noqa: S603  one of the commands above
                words, cwd=ROOT, env=os.environ | threads, check=False
            )
            if ended.returncode not in (0, 1):  # 1: something was left out, and named
                raise SystemExit(ended.returncode)
            spent = _cpu_seconds() - before
            if spent > costs.get(command, 0):  # a finished command that is given again is cheap
                costs[command] = round(spent, 1)
                COST.write_text(json.dumps(costs, indent=1) + "\n")
    keep_rows()
    keep_paper()


def keep_rows() -> None:
    """Copy the rows of all evaluations into the repository, each once.

    Rows that are there and were not evaluated again stay.
    """
    ROWS.mkdir(exist_ok=True)
    for task in TASKS:
        kept = ROWS / f"{task}.csv"
        rows = _rows_of([kept] if kept.exists() else [])
        rows |= _rows_of(sorted((ROOT / OUT).glob(f"*/{task}/rows.csv")))
        with kept.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(next(iter(rows.values()))), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows.values())


def _rows_of(files: Sequence[Path]) -> dict[tuple[str, ...], dict[str, str]]:
    """Return the rows of some files; the first of two alike counts."""
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for file in files:
        with file.open(newline="") as stream:
            for row in csv.DictReader(stream):
                key = tuple(row[name] for name in ("measure", "horizon", "run", "forecaster"))
                found.setdefault(key, row)
    return found


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def cost_lines(steps: Sequence[Step]) -> list[str]:
    """Return what each step costs in CPU minutes, as it was measured."""
    costs = json.loads(COST.read_text()) if COST.exists() else {}
    lines = []
    for step in steps:
        known = [costs[command] for command in step.commands if command in costs]
        minutes = f"{sum(known) / 60:.0f} CPU minutes" if known else "not measured"
        if 0 < len(known) < len(step.commands):
            minutes += f" for {len(known)} of them"
        lines.append(f"{step.name}: {len(step.commands)} commands, {minutes}")
    return lines


def page(rows: Sequence[TaskRow]) -> dict[str, str]:
    """Return the parts of the page that are written by this program."""
    weights, returns = Board(rows, RIVAL), Board(rows, SIMPLE)
    return {
        "answers": answers(rows, weights, returns),
        "findings": findings(weights, returns),
        "weights": weights_table(weights),
        "returns": returns_table(returns),
        "transfer": transfer_table(weights),
        **({"paper": paper_table()} if PAPER.exists() else {}),
        "ablation": ablation_table(weights),
    }


def keep_paper() -> None:
    """Copy the figures of the paper's setting into the repository."""
    found = {}
    for split in PAPER_SPLITS:
        results = read_results(ROOT / OUT / "paper" / split / "results.json")
        found[split] = {
            name: {
                "WPE": [_at(results.forecasters[name].wpe, h) for h in (1, 10)],
                "REPW": [
                    _at(results.forecasters[name].repw["sampled"]["learning"], h) for h in (1, 10)
                ],
            }
            for name in ("persistence", PUBLISHED)
        }
    PAPER.write_text(json.dumps(found, indent=1) + "\n")


def _at(rows: Sequence[Row], h: int) -> float | None:
    return next(row.value for row in rows if row.h == h)


@cache
def parts() -> dict[str, str]:
    """Return the parts of the page that the rows in the repository give; computed once."""
    return page(read())


def insert(text: str) -> str:
    """Return a page with what the rows say, in each place that it has."""
    for name, content in parts().items():
        if f"<!-- {name}: " not in text:
            continue
        text = between(
            text, f"<!-- {name}: written by make_results.py -->", f"<!-- end of {name} -->", content
        )
    return text


def main() -> None:
    """Plan, run, or write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plan", action="store_true", help="print the commands and their cost")
    parser.add_argument("--run", action="store_true", help="train and evaluate first")
    options = parser.parse_args()
    steps = plan()
    if options.plan or options.run:
        say("\n".join(cost_lines(steps)))
    if options.plan:
        say("\n".join(command for step in steps for command in step.commands))
        return
    if options.run:
        run(steps)
    rows = read()
    for name, figure in figures(rows).items():
        (HERE / name).write_text(svg(figure))
    write_page(leaderboard(rows, rival=RIVAL), HERE, ABOUT)
    for path in (PAGE, README):
        path.write_text(insert(path.read_text()))


if __name__ == "__main__":
    main()
