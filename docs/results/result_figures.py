"""The figures of the results page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from board import LEARNED, RIVAL, SIMPLE, TASKS, Board
from matplotlib.figure import Figure

from tipl.evaluation.rows import TaskRow


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
    shown = [
        ("tipl-gate-stretched", "#c0392b"),
        ("tipl-gate", "#e67e22"),
        ("ema-0.9-stretched", "#17a589"),
    ]
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
