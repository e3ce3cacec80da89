"""Every way to forecast policy weights, on seven tasks: trains, evaluates, writes docs/results.md.

python docs/results/arbiter.py --plan      # the commands, and what they cost
python docs/results/arbiter.py --run       # run them; stopped, the same command goes on
python docs/results/arbiter.py             # write the page from the rows in docs/results/rows

Each command is one of `tipl`, so any of them can be run alone. Models and measurements go to
data/arbiter; the rows of all evaluations, which are all that the page is made of, to
docs/results/rows. A CSV file that somebody adds there joins the tables.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from tipl.evaluation.leaderboard import Entry, Leaderboard, leaderboard
from tipl.evaluation.results import Interval, Row, TaskScore, read_results
from tipl.evaluation.rows import TaskRow, read_rows
from tipl.report.figures import svg
from tipl.report.leaderboard import write_page
from weighttraj.terminal import say
from weighttraj.text import between

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PAGE, README = HERE.parent / "results.md", ROOT / "README.md"
ROWS, COST, PAPER = HERE / "rows", HERE / "cost.json", HERE / "paper.json"
OUT = Path("data/arbiter")

LADDER = ("HalfCheetah", "Hopper", "InvertedPendulum")
TASKS = {
    "half-cheetah-v4-ppo-16x16-v1": "HalfCheetah",
    "hopper-v4-ppo-16x16-v1": "Hopper",
    "inverted-double-pendulum-v4-ppo-16x16-v1": "InvertedDoublePendulum",
    "reacher-v4-ppo-16x16-v1": "Reacher",
    "swimmer-v4-ppo-16x16-v1": "Swimmer",
    "walker2d-v4-ppo-16x16-v1": "Walker2d",
    "inverted-pendulum-v4-ppo-v1": "InvertedPendulum",
}
"""Data sets of this repository."""
LADDER_TASKS = tuple(task for task in TASKS if TASKS[task] in LADDER)
"""Tasks of the ladder from TIPL to tipl-gate."""
SEEDS, LADDER_SEEDS = (0, 1, 2), (0,)
"""Seeds of the trainings."""
TUNED = ("last-iteration", "ema-0.9", "tipl-gate", "trend-20", "ar-20-phase")
"""Forecasts that are stretched by what the returns of validation runs say, all with one grid."""
AMPLITUDES = "0.125 0.25 0.5 1 2 4"
LEARNED = (
    "tipl-gate",
    "tipl-gate-tuned",
    "gate-elsewhere",
    "ar-20-phase",
    "ar-20-phase-tuned",
)
"""Forecasters that are trained, and evaluated by returns."""
SIMPLE = "last-iteration-tuned"
"""What a learned forecast has to beat in return."""
RIVAL = "ar-20-phase"
"""What a learned forecast has to beat in weights."""
PUBLISHED, PAPER_DATA = "tipl-inverted-pendulum-v4", "inverted-pendulum-v4-ppo-v1"
PAPER_SPLITS = {"train": "training runs, as in the paper", "test": "test runs"}
"""The paper names no held-out runs: TIPL is evaluated on the runs it was trained on as well."""
RUNGS = {
    "tipl-published": "TIPL as published",
    "tipl-decayed": "+ learning rate falls, average of the weights",
    "tipl-residual": "+ predicts the step, not the position",
    "causal-first": "+ basis of the path so far, a head for each horizon",
    "causal": "+ measured in the steps around the start",
    "gate-own": "one small network for all parameters (tipl-gate)",
    "tipl-gate": "+ trained on all seven tasks",
}
"""The ladder: each line changes one thing."""


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
                f"tipl train baselines --data {task} --out {OUT}/{task}/ladder" for task in TASKS
            ),
        ),
        Step(name="gates", commands=tuple(gates)),
        Step(name="from TIPL to tipl-gate", commands=tuple(_ladder())),
        Step(name="stretched forecasts", commands=tuple(_tuned())),
        Step(
            name="evaluation",
            commands=(
                _evaluation("weights", _in_weights()),
                _evaluation("ladder", _on_ladder(), LADDER_TASKS),
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


def _ladder() -> Iterator[str]:
    batches = "--n-batches 1000"
    tipl = f"{batches} --warmup 100 --save-every 250"
    better = f"{tipl} --schedule cosine --ema 0.99"
    for seed in LADDER_SEEDS:
        for task in LADDER_TASKS:
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


def _tuned() -> Iterator[str]:
    for name in TUNED:
        for task in TASKS:
            along = {"tipl-gate": f"{OUT}/all/tipl-gate@0", RIVAL: f"{OUT}/{task}/ladder/{RIVAL}"}
            yield (
                f"tipl train scaled --along {along.get(name, name)} --data {task} "
                f"--out {OUT}/{task}/{name}-tuned --horizons 50 100 --amplitudes {AMPLITUDES} "
                "--starts 6 --episodes 10"
            )


def _in_weights() -> list[str]:
    fitted = ("ar-20", RIVAL, "ar-20-svd", "cmd", "lfd-2", "ema-0.9-shrunk", "wnn", "nino-mlp")
    simple = ("last-step", "last-iteration", "ema-0.9", "trend-20", "dmd")
    rivals = ("lines-50", "relex-50", "pptb-4")
    return [
        *simple,
        *rivals,
        *(f"{OUT}/{{data}}/ladder/{name}" for name in fitted),
        *(f"{OUT}/all/tipl-gate@{seed}" for seed in SEEDS),
        f"{OUT}/all/gate-timed@0",
        f"{OUT}/{{data}}/gate-elsewhere@0",
        "tipl.models.baselines.reconstruction:PathOracle",
    ]


def _in_returns() -> list[str]:
    return [
        *(f"{OUT}/{{data}}/{name}-tuned" for name in TUNED),
        f"{OUT}/all/tipl-gate@0",
        f"{OUT}/{{data}}/gate-elsewhere@0",
        f"{OUT}/{{data}}/ladder/{RIVAL}",
    ]


def _on_ladder() -> list[str]:
    names = [name for name in RUNGS if name != "tipl-gate"]
    return [f"{OUT}/{{data}}/{name}@{seed}" for name in names for seed in LADDER_SEEDS]


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
    """Copy the rows of all evaluations into the repository, each once."""
    shutil.rmtree(ROWS, ignore_errors=True)
    ROWS.mkdir()
    for task in TASKS:
        seen: dict[tuple[str, ...], dict[str, str]] = {}
        for file in sorted((ROOT / OUT).glob(f"*/{task}/rows.csv")):
            with file.open(newline="") as stream:
                for row in csv.DictReader(stream):
                    key = tuple(row[k] for k in ("measure", "horizon", "run", "forecaster"))
                    seen.setdefault(key, row)
        with (ROWS / f"{task}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(next(iter(seen.values()))), lineterminator="\n")
            writer.writeheader()
            writer.writerows(seen.values())


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


# The page


class Board:
    """Scores of all forecasters, looked up by name."""

    def __init__(self, rows: Sequence[TaskRow], rival: str) -> None:
        self.board: Leaderboard = leaderboard(rows, rival=rival)
        self._entries = {(e.forecaster, e.measure, e.horizon): e for e in self.board.entries}
        self._scores = {(s.task, s.forecaster, s.measure, s.horizon): s for s in self.board.scores}

    def entry(self, name: str, measure: str, horizon: int) -> Entry | None:
        """Return the line of a forecaster; None: not evaluated."""
        return self._entries.get((name, measure, horizon))

    def score(self, task: str, name: str, measure: str, horizon: int) -> TaskScore | None:
        """Return the score on one task; None: not evaluated."""
        return self._scores.get((task, name, measure, horizon))

    def wins(self, name: str, measure: str, horizon: int) -> tuple[int, int, int]:
        """Return on how many tasks it leads the rival, with an interval above 0, of how many."""
        found = [self.score(task, name, measure, horizon) for task in TASKS]
        leads = [s.lead for s in found if s is not None and s.lead.value is not None]
        return (
            sum((lead.value or 0) > 0 for lead in leads),
            sum((lead.low or 0) > 0 for lead in leads),
            len(leads),
        )

    def names(self, measure: str, horizon: int) -> list[str]:
        """Return the forecasters of all tasks, best first, bounds last."""
        found = [e for e in self.board.entries if (e.measure, e.horizon) == (measure, horizon)]
        most = max((e.tasks for e in found), default=0)
        return [e.forecaster for e in found if e.tasks == most]


def read() -> list[TaskRow]:
    """Return the rows of all files."""
    return [row for file in sorted(ROWS.glob("*.csv")) for row in read_rows(file)]


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
        "ladder": ladder_table(weights),
        "commands": "\n".join(["```text", *cost_lines(plan()), "```"]),
    }


def answers(rows: Sequence[TaskRow], weights: Board, returns: Board) -> str:
    """Return the answers to the page's questions, a line each."""
    ahead, clear, tasks = weights.wins("tipl-gate", "skill", 10)
    first, first_clear, _ = weights.wins("tipl-gate", "skill", 1)
    lines = [
        "1. **Does something learned beat the last iteration, stretched, in return?** "
        + _beaten(returns),
        "2. **Does what helps in weight error help in return?** " + _agreement(weights),
        "3. **What transfers?** " + _transfer(weights),
        "4. **What is wrong with the paper's model?** " + _paper(weights),
        f"5. **One gate for all tasks:** it beats AR(20) by phase, fitted to each task, on "
        f"{first} of {tasks} tasks at h = 1 ({first_clear} with an interval above 0) and on "
        f"{ahead} at h = 10 ({clear}). Its skill differs by at most {_spread(rows):.3f} between "
        f"{len(SEEDS)} training seeds (h = 1 and 10, each task).",
    ]
    return "\n".join(lines)


def findings(weights: Board, returns: Board) -> str:
    """Return the same in short sentences, for the README."""
    ahead, clear, tasks = weights.wins("tipl-gate", "skill", 10)
    others, _, _ = weights.wins("gate-elsewhere", "skill", 10)
    _, gains, _ = returns.wins("tipl-gate-tuned", "gain", 50)
    best, simple = (returns.entry(name, "gain", 50) for name in ("tipl-gate-tuned", SIMPLE))
    return "\n".join(
        [
            f"- In weight error at h = 10, `tipl-gate` beats AR(20) by phase on {ahead} of {tasks} "
            f"tasks ({clear} with an interval above 0); gates that never saw the task, on "
            f"{others}.",
            "- In return at h = 50, stretched by validation returns, it beats the stretched last "
            f"iteration on {gains} of {tasks} tasks; mean gains are {_cell(best and best.score)} "
            f"and {_cell(simple and simple.score)}.",
            "- " + _agreement(weights).partition(". Best")[0] + ".",
            "- TIPL as published: " + _paper(weights)[0].lower() + _paper(weights)[1:],
        ]
    )


def _beaten(returns: Board) -> str:
    found = []
    for name in LEARNED:
        if (entry := returns.entry(name, "gain", 50)) is None:
            continue
        _, clear, tasks = returns.wins(name, "gain", 50)
        found.append((clear, entry.score.value or 0, f"{name} on {clear} of {tasks} tasks"))
    best = sorted(found, reverse=True)[:3]
    simple = returns.entry(SIMPLE, "gain", 50)
    verdict = "Yes" if best[0][0] >= 2 else "Hardly" if best[0][0] else "No"
    return (
        f"{verdict}: with an interval above 0 at h = 50, {'; '.join(text for *_, text in best)}. "
        f"The mean gain of {SIMPLE} is {_cell(simple and simple.score)}."
    )


def _agreement(weights: Board) -> str:
    found = {
        name: (skill.score.value, gain.score.value)
        for name in weights.names("gain", 50)
        if (skill := weights.entry(name, "skill", 50)) is not None
        and (gain := weights.entry(name, "gain", 50)) is not None
        and not skill.oracle
    }
    x, y = np.array(list(found.values()), float).T
    rank = float(np.corrcoef(x.argsort().argsort(), y.argsort().argsort())[0, 1])
    in_weights, in_return = (max(found, key=lambda name: found[name][i]) for i in (0, 1))
    return (
        f"The rank correlation between mean skill and mean gain at h = 50 over {len(found)} "
        f"forecasters is {rank:.2f}. Best in weights is {in_weights}, best in return is "
        f"{in_return}."
    )


def _transfer(weights: Board) -> str:
    better = sum(
        (score.score.low or 0) > 0
        for task in TASKS
        if (score := weights.score(task, "gate-elsewhere", "skill", 10)) is not None
    )
    ahead, clear, tasks = weights.wins("gate-elsewhere", "skill", 10)
    return (
        f"A gate that never saw the task is better than persistence on {better} of {tasks} tasks "
        f"at h = 10, and better than AR(20) fitted to the task itself on {ahead} ({clear} with an "
        "interval above 0)."
    )


def _paper(weights: Board) -> str:
    skills = {
        name: [
            s.score.value
            for task in ladder_tasks(weights)
            if (s := weights.score(task, name, "skill", 1)) is not None
            and s.score.value is not None
        ]
        for name in RUNGS
    }
    means = {name: float(np.mean(values)) for name, values in skills.items() if values}
    order = [name for name in RUNGS if name in means]
    tasks = len(skills[order[0]])
    jumps = {b: means[b] - means[a] for a, b in pairwise(order)}
    largest = max(jumps, key=lambda name: jumps[name])
    crossed = next((name for name in order if means[name] > 0), None)
    text = (
        f"Its skill at h = 1 is {means[order[0]]:,.0f} on average over {tasks} tasks. "
        f"The largest single change is “{RUNGS[largest].lstrip('+ ')}”."
    )
    if crossed:
        text += f" Better than persistence from “{RUNGS[crossed].lstrip('+ ')}” on."
    return text


def _spread(rows: Sequence[TaskRow]) -> float:
    """Return the largest difference of skill between trainings of the gate."""
    spreads = []
    for task in TASKS:
        for h in (1, 10):
            skills = []
            for seed in SEEDS:
                mine = [
                    row
                    for row in rows
                    if (row.task, row.measure, row.horizon, row.forecaster)
                    == (task, "skill", h, f"tipl-gate@{seed}")
                ]
                if mine:
                    skills.append(1 - sum(r.error for r in mine) / sum(r.reference for r in mine))
            spreads.append(max(skills) - min(skills))
    return max(spreads)


def weights_table(board: Board) -> str:
    """Return the ten best forecasters by skill at h = 10, and the bound."""
    names = board.names("skill", 10)
    chosen = [*names[:9], *(name for name in names if "oracle" in name)][:10]
    lines = [
        "| forecaster | skill, h = 1 | h = 10 | h = 50 | h = 200 | wins over AR(20), h = 10 | "
        "rank, h = 10 |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name in chosen:
        entries = [board.entry(name, "skill", h) for h in (1, 10, 50, 200)]
        ten = entries[1]
        cells = [_cell(e and e.score) for e in entries]
        lines.append(
            f"| {_shown(name)} | {' | '.join(cells)} | {_cell(ten and ten.wins_over, False)} | "
            f"{_cell(ten and ten.rank, False)} |"
        )
    return "\n".join(lines)


def returns_table(board: Board) -> str:
    """Return the ten best forecasters by gain at h = 50."""
    lines = [
        f"| forecaster | gain, h = 50 | gain, h = 100 | skill, h = 50 | leads {SIMPLE}, h = 50 |",
        "|---|---:|---:|---:|---:|",
    ]
    for name in board.names("gain", 50)[:10]:
        gains = [board.entry(name, "gain", h) for h in (50, 100)]
        skill = board.entry(name, "skill", 50)
        _, clear, tasks = board.wins(name, "gain", 50)
        cells = [_cell(e and e.score) for e in (*gains, skill)]
        lines.append(f"| {_shown(name)} | {' | '.join(cells)} | {clear} of {tasks} tasks |")
    return "\n".join(lines)


def transfer_table(board: Board) -> str:
    """Return the skill of gates that saw the task, and of those that did not, on each task."""
    lines = [
        "| task | AR(20) of the task, h = 1 | gate, all tasks | gate, other tasks | "
        "AR(20), h = 10 | gate, all tasks | gate, other tasks |",
        "|---|" + "---:|" * 6,
    ]
    for task, called in TASKS.items():
        cells = []
        for h in (1, 10):
            for name in (RIVAL, "tipl-gate", "gate-elsewhere"):
                score = board.score(task, name, "skill", h)
                cells.append(_cell(score and score.score, name != RIVAL))
        lines.append(f"| {called} | {' | '.join(cells)} |")
    return "\n".join(lines)


def ladder_table(board: Board) -> str:
    """Return the skill of each rung on the tasks of the ladder."""
    tasks = ladder_tasks(board)
    heads = [f"{TASKS[task]}, h = {h}" for task in tasks for h in (1, 10)]
    lines = [
        "| model | trainings | " + " | ".join(heads) + " |",
        "|---|---:" + "|---:" * len(heads),
    ]
    lines[1] += "|"
    for name, told in RUNGS.items():
        scores = [board.score(task, name, "skill", h) for task in tasks for h in (1, 10)]
        if not any(scores):
            continue
        count = max(score.trainings for score in scores if score)
        cells = [_cell(score and score.score, False) for score in scores]
        lines.append(f"| {told} | {count} | {' | '.join(cells)} |")
    return "\n".join(lines)


def paper_table() -> str:
    """Return WPE and REPW of the released TIPL on the runs it was trained on, and on others."""
    known = json.loads(PAPER.read_text())
    heads = [f"{measure}, h = {h}" for measure in known["test"]["persistence"] for h in (1, 10)]
    lines = [
        "| evaluated on | forecaster | " + " | ".join(heads) + " |",
        "|---|---|" + "---:|" * len(heads),
    ]
    for split, told in PAPER_SPLITS.items():
        for name, measures in known[split].items():
            cells = [f"{value:.3g}" for values in measures.values() for value in values]
            lines.append(f"| {told} | {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def keep_paper() -> None:
    """Copy the figures of the paper's setting into the repository."""
    found = {}
    for split in PAPER_SPLITS:
        results = read_results(ROOT / OUT / "paper" / split / "results.json")
        found[split] = {
            name: {
                "WPE": [_at(results.forecasters[name].wpe, h) for h in (1, 10)],
                "REPW while learning": [
                    _at(results.forecasters[name].repw["sampled"]["learning"], h) for h in (1, 10)
                ],
                "REPW after it": [
                    _at(results.forecasters[name].repw["sampled"]["plateau"], h) for h in (1, 10)
                ],
            }
            for name in ("persistence", PUBLISHED)
        }
    PAPER.write_text(json.dumps(found, indent=1) + "\n")


def _at(rows: Sequence[Row], h: int) -> float | None:
    return next(row.value for row in rows if row.h == h)


def ladder_tasks(board: Board) -> list[str]:
    """Return the tasks of the ladder on which its first rung was evaluated."""
    first = next(iter(RUNGS))
    return [task for task in LADDER_TASKS if board.score(task, first, "skill", 1)]


def _shown(name: str) -> str:
    return f"{name} (bound)" if "oracle" in name else name


def _cell(figure: Interval | None, interval: bool = True) -> str:
    if figure is None or figure.value is None:
        return "-"

    def text(value: float) -> str:
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"

    if not interval or figure.low is None or figure.high is None:
        return text(figure.value)
    return f"{text(figure.value)} [{text(figure.low)}, {text(figure.high)}]"


# Figures


def figures(rows: Sequence[TaskRow]) -> dict[str, Figure]:
    """Return the three figures of the page, by file name."""
    weights, returns = Board(rows, RIVAL), Board(rows, SIMPLE)
    return {
        "lead-over-ar.svg": lead_figure(weights),
        "skill-and-gain.svg": agreement_figure(weights),
        "gain-by-task.svg": gain_figure(returns),
    }


def lead_figure(board: Board) -> Figure:
    """Draw the lead of both gates over AR(20) on each task."""
    fig = Figure(figsize=(8, 3.4), layout="constrained")
    for axes, h in zip(fig.subplots(1, 2, sharey=True), (1, 10), strict=True):
        for shift, (name, label, color) in enumerate(
            (("tipl-gate", "saw the task", "#c0392b"), ("gate-elsewhere", "did not", "#2471a3"))
        ):
            for place, task in enumerate(TASKS):
                score = board.score(task, name, "skill", h)
                if score is None or score.lead.value is None:
                    continue
                y = -place - 0.25 * shift
                axes.plot([score.lead.low, score.lead.high], [y, y], color=color, lw=2)
                axes.plot(score.lead.value, y, "o", color=color, label=label if not place else None)
        axes.axvline(0, color="#1c1c1c", lw=1)
        axes.set_title(f"h = {h}", fontsize=10)
        axes.set_xlabel("skill minus that of AR(20) of the task")
        axes.set_yticks([-place for place in range(len(TASKS))], list(TASKS.values()))
        axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return fig


def agreement_figure(board: Board) -> Figure:
    """Draw gain against skill, a point for each forecaster."""
    fig = Figure(figsize=(6, 4), layout="constrained")
    axes = fig.subplots()
    for name in board.names("gain", 50):
        skill, gain = (board.entry(name, measure, 50) for measure in ("skill", "gain"))
        if skill is None or gain is None or skill.score.value is None or gain.score.value is None:
            continue
        color = "#7f8c8d" if skill.oracle else "#c0392b" if name in LEARNED else "#2471a3"
        axes.plot(skill.score.value, gain.score.value, "o", color=color)
        axes.annotate(
            name,
            (skill.score.value, gain.score.value),
            xytext=(4, 3),
            textcoords="offset points",
            fontsize=7,
        )
    axes.axhline(0, color="#1c1c1c", lw=0.8)
    axes.axvline(0, color="#1c1c1c", lw=0.8)
    axes.set_xlabel("mean skill at h = 50 (weights)")
    axes.set_ylabel("mean gain at h = 50 (return)")
    axes.spines[["top", "right"]].set_visible(False)
    return fig


def gain_figure(board: Board) -> Figure:
    """Draw the gain at h = 50 on each task, of the best learned forecast and of simple ones."""
    fig = Figure(figsize=(8, 3.6), layout="constrained")
    axes = fig.subplots()
    shown = [("tipl-gate-tuned", "#c0392b"), ("tipl-gate", "#e67e22"), ("ema-0.9-tuned", "#17a589")]
    for shift, (name, color) in enumerate([*shown, (SIMPLE, "#2471a3")]):
        for place, task in enumerate(TASKS):
            score = board.score(task, name, "gain", 50)
            if score is None or score.score.value is None:
                continue
            x = place + 0.18 * (shift - 1.5)
            low, value, high = (
                None if part is None else float(np.clip(part, -1, 1.5))
                for part in (score.score.low, score.score.value, score.score.high)
            )
            if low is not None and high is not None:
                axes.plot([x, x], [low, high], color=color, lw=2)
            axes.plot(x, value, "o", color=color, label=None if place else name)
    axes.axhline(0, color="#1c1c1c", lw=0.8)
    axes.set_ylim(-1.05, 1.55)
    axes.set_xticks(range(len(TASKS)), list(TASKS.values()), rotation=20, fontsize=8)
    axes.set_ylabel("gain at h = 50, cut at -1 and 1.5")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return fig


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
            text, f"<!-- {name}: written by arbiter.py -->", f"<!-- end of {name} -->", content
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
    write_page(leaderboard(rows, rival=RIVAL), HERE)
    for path in (PAGE, README):
        path.write_text(insert(path.read_text()))


if __name__ == "__main__":
    main()
