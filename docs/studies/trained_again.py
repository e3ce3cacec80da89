"""Do the commands on the cards make the released models again?

python docs/studies/trained_again.py --out FOLDER NAME [NAME ...]   # train, evaluate, render
python docs/studies/trained_again.py --seeds 1 2 --beside NAME ...  # with other seeds too
python docs/studies/trained_again.py                                # render what was measured

Runs the commands of each card, evaluates the new models as the released ones were, and keeps both
results in trained_again.json. The same command continues a stopped one. HalfCheetah's runs have to
be collected first, and another CPU makes other runs under the same seeds: with --beside, the
released models are evaluated on the runs that are here too. Writes the tables in trained_again.md,
beside this file.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from study import Study, parser

import tipl
from tipl.evaluation.results import Measure, Results, Scores, read_results
from tipl.evaluation.statistics import Cell
from tipl.report.scores import GAIN, SKILL, function_skill, row_at
from tipl.zoo.metrics import read_metrics

ROOT = Path(__file__).parents[2]
ZOO = Path(tipl.__file__).parent / "zoo/models"


@dataclass(frozen=True)
class Evaluation:
    """How the models of one data set are evaluated again."""

    options: str
    """As for the released models."""
    figures: dict[str, tuple[Measure, int]]
    """What is read of a result file, and at which horizon."""


EVALUATIONS = {
    "inverted-pendulum-v4-ppo-v1": Evaluation(
        "--return-horizons 1 2 5 10 50 100 --learning-starts 4 --plateau-starts 1",
        {f"skill, h = {h}": (SKILL, h) for h in (1, 10, 50)}
        | {f"gain, h = {h}": (GAIN, h) for h in (10, 50)},
    ),
    "half-cheetah-v4-ppo-v1": Evaluation(
        "--starts 60 --function-starts 12 --learning-starts 0 --plateau-starts 0",
        {f"skill, h = {h}": (SKILL, h) for h in (1, 10, 50, 200)}
        | {"function skill, h = 10": (function_skill, 10)},
    ),
}


def make(name: str, out: Path, seed: int | None = None) -> Path:
    """Run the commands of a card, with another seed if one is given; returns what they made."""
    card = (ROOT / f"cards/models/{name}.md").read_text()
    commands = re.findall(r"^tipl train.*$", card, re.MULTILINE)
    named = name
    if seed is not None:
        commands = [re.sub(r"--seed \d+", f"--seed {seed}", command) for command in commands]
        named = f"{name}-seed-{seed}"
    folders = {"GATE": out / f"{named}-gate", "FOLDER": out / named}
    for command in commands:
        words = [str(folders.get(word, word)) for word in shlex.split(command)]
        run(words)
    fitted = [path for path in folders["FOLDER"].glob("*/config.json") if path.parent.name in name]
    return max(
        (path.parent for path in fitted), default=folders["FOLDER"], key=lambda p: len(p.name)
    )


def run(words: list[str]) -> None:
    """A command, by the program beside this Python."""
    subprocess.run([Path(sys.executable).with_name(words[0]), *words[1:]], check=True)  # noqa: S603


def measure(
    names: list[str], out: Path, beside: bool, seeds: list[int], workers: int
) -> dict[str, Any]:
    """Figures of models of one data set: the released ones, and those that were made again."""
    again = {name: make(name, out) for name in names}
    seeded = {(name, seed): make(name, out, seed) for name in names for seed in seeds}
    metrics = {name: found for name in names if (found := read_metrics(ZOO / name))}
    (data,) = {one.results.data for one in metrics.values()}
    how = EVALUATIONS[data]
    results = evaluate(list(again.values()), data, how, out / f"report-{data}", workers)
    scores = dict(results.forecasters)
    if seeds:
        folder = out / f"report-{data}-seeds"
        scores |= evaluate(list(seeded.values()), data, how, folder, workers).forecasters
    if beside:
        zoo = [ZOO / name for name in names]
        known = evaluate(zoo, data, how, out / f"report-{data}-zoo", workers).forecasters
    else:
        known = {name: one.scores for name, one in metrics.items()}
    models = {
        name: {
            figure: {
                "zoo": at(known[name], path),
                "again": at(scores[again[name].name], path),
                "seeds": [at(scores[seeded[name, seed].name], path) for seed in seeds],
            }
            for figure, path in how.figures.items()
        }
        for name in names
    }
    return {
        data: {"runs": list(results.runs), "beside": beside, "seeds": seeds, "models": models},
    }


def evaluate(models: list[Path], data: str, how: Evaluation, out: Path, workers: int) -> Results:
    """A result file."""
    options = f"--data {data} --out {out} {how.options} --workers {workers}"
    run(["tipl", "evaluate", *map(str, models), *shlex.split(options)])
    return read_results(out / "results.json")


def at(scores: Scores, figure: tuple[Measure, int]) -> Cell:
    """One figure of a forecaster."""
    row = row_at(scores, *figure)
    if row is None:
        raise SystemExit("the evaluation has other horizons")
    return Cell(value=row.value, low=row.low, high=row.high)


def table(measured: dict[str, Any]) -> str:
    """Return the released models' intervals and the new figures, a table for each data set."""
    return "\n\n".join(_table(data, **found) for data, found in measured.items())


def _table(
    data: str, runs: list[str], beside: bool, seeds: list[int], models: dict[str, Any]
) -> str:
    figures = EVALUATIONS[data].figures
    lines = [
        f"## {data}",
        "",
        "| model | " + " | ".join(figures) + " |",
        "|---|" + "---:|" * len(figures),
    ]
    for name, found in models.items():
        cells = [found[figure] for figure in figures]
        lines.append(f"| {name} | " + " | ".join(map(_told, cells)) + " |")
        lines += [
            f"| with seed {seed} | "
            + " | ".join(f"{cell['seeds'][k]['value']:.{_digits(cell)}f}" for cell in cells)
            + " |"
            for k, seed in enumerate(seeds)
        ]
    every = [cell for found in models.values() for cell in found.values()]
    inside = sum(_inside(cell) for cell in every)
    known = (
        "the interval of the released model on the same runs" if beside else "the card's interval"
    )
    told = (
        f"Models that were trained again, on {len(runs)} test runs, and behind each figure "
        f"{known}. "
        f"{inside} of {len(every)} figures lie in it; those that do not are bold."
    )
    return "\n".join([*lines, "", told])


def _inside(cell: dict[str, Any]) -> bool:
    return bool(cell["zoo"]["low"] <= cell["again"]["value"] <= cell["zoo"]["high"])


def _digits(cell: dict[str, Any]) -> int:
    """Return as many digits as show how wide the released model's interval is."""
    return 2 if cell["zoo"]["high"] - cell["zoo"]["low"] > 0.01 else 3


def _told(cell: dict[str, Any]) -> str:
    bold, digits = "" if _inside(cell) else "**", _digits(cell)
    value, low, high = (
        f"{number:.{digits}f}"
        for number in (cell["again"]["value"], cell["zoo"]["low"], cell["zoo"]["high"])
    )
    return f"{bold}{value}{bold} [{low}, {high}]"


STUDY = Study(__file__, table)


def main() -> None:
    """Train and measure, if models are named, and render."""
    options = parser(__doc__)
    options.add_argument("names", nargs="*", help="released models, all evaluated on one data set")
    options.add_argument("--out", type=Path, default=Path("data/results/again"))
    options.add_argument(
        "--beside",
        action="store_true",
        help="evaluate the released models too: the test runs here are not those of the cards",
    )
    options.add_argument("--seeds", type=int, nargs="*", default=[], help="of further trainings")
    options.add_argument("--workers", type=int, default=2)
    args = options.parse_args()
    if args.names:
        found = measure(args.names, args.out, args.beside, args.seeds, args.workers)
        STUDY.keep((STUDY.measured() or {}) | found)
    STUDY.render()


if __name__ == "__main__":
    main()
