"""Do the commands on the cards make the models of the zoo again?

python docs/studies/trained_again.py --out FOLDER NAME [NAME ...]   # train, judge, render
python docs/studies/trained_again.py                                # render what was measured

Runs the commands of each card, judges what they made as the card's model was judged, and keeps both
in trained_again.json. Trainings that stopped go on. Writes the table in trained_again.md, beside
this file.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from page import insert as insert_into

import tipl
from tipl.evaluation.statistics import Interval
from tipl.zoo.metrics import read_metrics

HERE = Path(__file__)
RESULTS, PAGE = HERE.with_suffix(".json"), HERE.with_suffix(".md")
ROOT = HERE.parents[2]
ZOO = Path(tipl.__file__).parent / "zoo/models"
FIGURES = {
    "skill, h = 1": ("skill", "ratio_of_sums", "all", 1),
    "skill, h = 10": ("skill", "ratio_of_sums", "all", 10),
    "skill, h = 50": ("skill", "ratio_of_sums", "all", 50),
    "gain, h = 10": ("gain", "held", 10),
    "gain, h = 50": ("gain", "held", 50),
}
"""Where they stand in a result file."""
JUDGED = "--return-horizons 1 2 5 10 50 100 --learning-starts 4 --plateau-starts 1"
"""How the models of the zoo were."""


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


def measure(names: list[str], out: Path, workers: int) -> dict[str, Any]:
    """Figures of both, the card's and those of what was made again."""
    made = {name: make(name, out) for name in names}
    metrics = {name: read_metrics(ZOO / name) for name in names}
    (data,) = {one.results["data"] for one in metrics.values() if one is not None}
    options = f"--data {data} --out {out / 'report'} {JUDGED} --workers {workers}"
    run(["tipl", "evaluate", *map(str, made.values()), *shlex.split(options)])
    judged = json.loads((out / "report/results.json").read_text())["forecasters"]
    found: dict[str, Any] = {}
    for name, one in metrics.items():
        assert one is not None  # noqa: S101
        card = one.results["forecasters"][one.judged_as]
        found[name] = {
            figure: {"card": at(card, path), "again": at(judged[made[name].name], path)}
            for figure, path in FIGURES.items()
        }
    return found


def at(scores: dict[str, Any], path: tuple[Any, ...]) -> Interval:
    """One figure of a forecaster."""
    *keys, horizon = path
    rows: Any = scores
    for key in keys:
        rows = rows[key]
    return next(row for row in rows if row["h"] == horizon)


def table(results: dict[str, Any]) -> str:
    """The card's intervals, and what came out."""
    lines = [
        "| model | " + " | ".join(FIGURES) + " |",
        "|---|" + "---:|" * len(FIGURES),
    ]
    lines += [
        f"| {name} | " + " | ".join(_told(**figures[figure]) for figure in FIGURES) + " |"
        for name, figures in results.items()
    ]
    every = [cell for figures in results.values() for cell in figures.values()]
    inside = sum(_inside(**cell) for cell in every)
    told = (
        f"What was trained again, and behind it the card's interval. {inside} of {len(every)} "
        "figures lie in it; those that do not are bold."
    )
    return "\n".join([*lines, "", told])


def _inside(card: dict[str, float], again: dict[str, float]) -> bool:
    return card["low"] <= again["value"] <= card["high"]


def _told(card: dict[str, float], again: dict[str, float]) -> str:
    bold = "" if _inside(card, again) else "**"
    return f"{bold}{again['value']:.2f}{bold} [{card['low']:.2f}, {card['high']:.2f}]"


def insert(page: str) -> str:
    """The page with the table as the results have it."""
    return insert_into(page, HERE, table(json.loads(RESULTS.read_text())))


def main() -> None:
    """Train and measure, if models are named, and render."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="models of the zoo, judged on one data set")
    parser.add_argument("--out", type=Path, default=Path("data/results/again"))
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    if args.names:
        RESULTS.write_text(json.dumps(measure(args.names, args.out, args.workers)) + "\n")
    PAGE.write_text(insert(PAGE.read_text()))


if __name__ == "__main__":
    main()
