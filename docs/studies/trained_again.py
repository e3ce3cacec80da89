"""Do the commands on the cards make the models of the zoo again?

python docs/studies/trained_again.py --out FOLDER NAME [NAME ...]   # train, judge, render
python docs/studies/trained_again.py                                # render what was measured

Runs the commands of each card, judges what they made as the card's model was judged, and keeps both
in trained_again.json. Trainings that stopped go on. HalfCheetah's runs have to be collected first,
and another CPU makes other runs under the same seeds: with --beside, the zoo's models are judged on
those that are here too. Writes the table in trained_again.md, beside
this file.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from study import Study, parser

import tipl
from tipl.evaluation.statistics import Interval
from tipl.zoo.metrics import read_metrics

ROOT = Path(__file__).parents[2]
ZOO = Path(tipl.__file__).parent / "zoo/models"


@dataclass(frozen=True)
class Judging:
    """How the models of one data set are judged again."""

    options: str
    """As the models of the zoo were."""
    figures: dict[str, tuple[Any, ...]]
    """Where they stand in a result file, the horizon last."""


SKILL = ("skill", "ratio_of_sums", "all")
GAIN = ("gain", "held")
JUDGED = {
    "inverted-pendulum-v4-ppo-v1": Judging(
        "--return-horizons 1 2 5 10 50 100 --learning-starts 4 --plateau-starts 1",
        {f"skill, h = {h}": (*SKILL, h) for h in (1, 10, 50)}
        | {f"gain, h = {h}": (*GAIN, h) for h in (10, 50)},
    ),
    "half-cheetah-v4-ppo-v1": Judging(
        "--starts 60 --function-starts 12 --learning-starts 0 --plateau-starts 0",
        {f"skill, h = {h}": (*SKILL, h) for h in (1, 10, 50, 200)}
        | {"function skill, h = 10": ("function_skill", "all", 10)},
    ),
}


def make(name: str, out: Path) -> Path:
    """Run the commands of a card; returns the folder of what they made."""
    card = (ROOT / f"cards/models/{name}.md").read_text()
    commands = re.findall(r"^tipl (?:train|fit).*$", card, re.MULTILINE)
    folders = {"GATE": out / f"{name}-gate", "FOLDER": out / name}
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


def measure(names: list[str], out: Path, beside: bool, workers: int) -> dict[str, Any]:
    """Figures of models of one data set: the zoo's, and those of what was made again."""
    made = {name: make(name, out) for name in names}
    metrics = {name: found for name in names if (found := read_metrics(ZOO / name))}
    (data,) = {one.results["data"] for one in metrics.values()}
    judging = JUDGED[data]
    results = judge(list(made.values()), data, judging, out / f"report-{data}", workers)
    if beside:
        zoo = [ZOO / name for name in names]
        known = judge(zoo, data, judging, out / f"report-{data}-zoo", workers)["forecasters"]
    else:
        known = {name: one.scores for name, one in metrics.items()}
    models = {
        name: {
            figure: {
                "zoo": at(known[name], path),
                "again": at(results["forecasters"][made[name].name], path),
            }
            for figure, path in judging.figures.items()
        }
        for name in names
    }
    return {data: {"runs": results["runs"], "beside": beside, "models": models}}


def judge(models: list[Path], data: str, judging: Judging, out: Path, workers: int) -> Any:
    """A result file."""
    options = f"--data {data} --out {out} {judging.options} --workers {workers}"
    run(["tipl", "evaluate", *map(str, models), *shlex.split(options)])
    return json.loads((out / "results.json").read_text())


def at(scores: dict[str, Any], path: tuple[Any, ...]) -> Interval:
    """One figure of a forecaster."""
    *keys, horizon = path
    rows: Any = scores
    for key in keys:
        rows = rows[key]
    row = next(row for row in rows if row["h"] == horizon)
    return Interval(value=row["value"], low=row["low"], high=row["high"])


def table(measured: dict[str, Any]) -> str:
    """The zoo's intervals, and what came out, a table for each data set."""
    return "\n\n".join(_table(data, **found) for data, found in measured.items())


def _table(data: str, runs: list[str], beside: bool, models: dict[str, Any]) -> str:
    figures = JUDGED[data].figures
    lines = [
        f"## {data}",
        "",
        "| model | " + " | ".join(figures) + " |",
        "|---|" + "---:|" * len(figures),
    ]
    lines += [
        f"| {name} | " + " | ".join(_told(**found[figure]) for figure in figures) + " |"
        for name, found in models.items()
    ]
    every = [cell for found in models.values() for cell in found.values()]
    inside = sum(_inside(**cell) for cell in every)
    known = "the interval of the zoo's model on the same runs" if beside else "the card's interval"
    told = (
        f"What was trained again, judged on {len(runs)} test runs, and behind it {known}. "
        f"{inside} of {len(every)} figures lie in it; those that do not are bold."
    )
    return "\n".join([*lines, "", told])


def _inside(zoo: Interval, again: Interval) -> bool:
    return zoo["low"] <= again["value"] <= zoo["high"]


def _told(zoo: Interval, again: Interval) -> str:
    bold = "" if _inside(zoo, again) else "**"
    return f"{bold}{again['value']:.2f}{bold} [{zoo['low']:.2f}, {zoo['high']:.2f}]"


STUDY = Study(__file__, table)


def main() -> None:
    """Train and measure, if models are named, and render."""
    options = parser(__doc__)
    options.add_argument("names", nargs="*", help="models of the zoo, judged on one data set")
    options.add_argument("--out", type=Path, default=Path("data/results/again"))
    options.add_argument(
        "--beside",
        action="store_true",
        help="judge the zoo's models too: the test runs here are not those of the cards",
    )
    options.add_argument("--workers", type=int, default=2)
    args = options.parse_args()
    if args.names:
        found = measure(args.names, args.out, args.beside, args.workers)
        STUDY.keep((STUDY.measured() or {}) | found)
    STUDY.render()


if __name__ == "__main__":
    main()
