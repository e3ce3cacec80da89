"""The tables of the results page."""

from __future__ import annotations

import json

from board import PAPER, PAPER_SPLITS, RIVAL, SIMPLE, TASKS, VARIANTS, Board, ablation_tasks

from tipl.evaluation.results import Interval


def weights_table(board: Board) -> str:
    """Return the best forecasters by skill at h = 10, and the bound."""
    names = [name for name in board.names("skill", 10) if name != "gate-timed"]  # equals tipl-gate
    chosen = [*names[:7], *(name for name in names if "oracle" in name)][:10]
    lines = [
        "| forecaster | skill, h = 1 | h = 10 | h = 50 | h = 200 | share of tasks won, h = 10 | "
        "mean rank, h = 10 |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name in chosen:
        entries = [board.entry(name, "skill", h) for h in (1, 10, 50, 200)]
        ten = entries[1]
        cells = [cell(e and e.score) for e in entries]
        lines.append(
            f"| {_shown(name)} | {' | '.join(cells)} | {cell(ten and ten.wins_over, False)} | "
            f"{cell(ten and ten.rank, False)} |"
        )
    return "\n".join(lines)


def returns_table(board: Board) -> str:
    """Return the ten best forecasters by gain at h = 50, without persistence, whose gain is 0."""
    lines = [
        f"| forecaster | gain, h = 50 | gain, h = 100 | skill, h = 50 | leads {SIMPLE}, h = 50 |",
        "|---|---:|---:|---:|---:|",
    ]
    for name in [name for name in board.names("gain", 50) if name != "persistence"][:10]:
        gains = [board.entry(name, "gain", h) for h in (50, 100)]
        skill = board.entry(name, "skill", 50)
        _, clear, tasks = board.wins(name, "gain", 50)
        cells = [cell(e and e.score) for e in (*gains, skill)]
        lines.append(f"| {_shown(name)} | {' | '.join(cells)} | {clear} of {tasks} tasks |")
    return "\n".join(lines)


def transfer_table(board: Board) -> str:
    """Return the skill at h = 10 of gates that saw the task, and of those that did not."""
    lines = [
        "| task | AR(20) of the task | gate, all tasks | gate, other tasks |",
        "|---|---:|---:|---:|",
    ]
    for task, called in TASKS.items():
        cells = []
        for name in (RIVAL, "tipl-gate", "gate-elsewhere"):
            score = board.score(task, name, "skill", 10)
            cells.append(cell(score and score.score))
        lines.append(f"| {called} | {' | '.join(cells)} |")
    return "\n".join(lines)


def ablation_table(board: Board) -> str:
    """Return the skill of each variant on the tasks of the ablation, over runs and trainings."""
    tasks = ablation_tasks(board)
    heads = [f"{TASKS[task]}, h = {h}" for task in tasks for h in (1, 10)]
    lines = [
        "| model | trainings | " + " | ".join(heads) + " |",
        "|---|---:" + "|---:" * len(heads),
    ]
    lines[1] += "|"
    for name, told in VARIANTS.items():
        scores = [board.score(task, name, "skill", h) for task in tasks for h in (1, 10)]
        if not any(scores):
            continue
        count = max(score.trainings for score in scores if score)
        cells = [cell(score and score.score) for score in scores]
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


def _shown(name: str) -> str:
    return f"{name} (bound)" if "oracle" in name else name


def cell(figure: Interval | None, interval: bool = True) -> str:
    """Return a figure as text, with its interval or without."""
    if figure is None or figure.value is None:
        return "-"

    def text(value: float) -> str:
        return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"

    if not interval or figure.low is None or figure.high is None:
        return text(figure.value)
    return f"{text(figure.value)} [{text(figure.low)}, {text(figure.high)}]"
