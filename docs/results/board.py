"""What the results page compares, and the scores of all forecasters by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tipl.evaluation.leaderboard import Entry, Leaderboard, leaderboard
from tipl.evaluation.results import TaskScore
from tipl.evaluation.rows import TaskRow, read_rows

HERE = Path(__file__).parent
ROWS, PAPER = HERE / "rows", HERE / "paper.json"

ABLATION = ("HalfCheetah", "Hopper", "InvertedPendulum")
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
ABLATION_TASKS = tuple(task for task in TASKS if TASKS[task] in ABLATION)
"""Tasks of the ablation from TIPL to tipl-gate."""
SEEDS, ABLATION_SEEDS = (0, 1, 2), (0, 1, 2)
"""Seeds of the trainings."""
ABLATION_BATCHES = 1000
"""Number of batches of TIPL and of tipl-causal on the ablation."""
LEARNED = (
    "tipl-gate",
    "tipl-gate-stretched",
    "gate-elsewhere",
    "ar-20-phase",
    "ar-20-phase-stretched",
)
"""Forecasters that are trained, and evaluated by returns."""
SIMPLE = "last-iteration-stretched"
"""What a learned forecast has to beat in return."""
RIVAL = "ar-20-phase"
"""What a learned forecast has to beat in weights."""
PAPER_SPLITS = {"train": "training runs", "test": "test runs"}
"""The paper names no held-out runs: TIPL is evaluated on the runs it was trained on as well."""
VARIANTS = {
    "tipl-published": "TIPL's design",
    "tipl-decayed": "+ learning rate falls, average of the weights",
    "tipl-residual": "+ predicts the step, not the position",
    "causal-first": "+ basis of the path so far, a head for each horizon",
    "causal": "+ sizes relative to the steps around the start",
    "gate-own": "one small network for all parameters (tipl-gate)",
    "tipl-gate": "+ trained on all seven tasks",
}
"""The ablation: each line changes one thing."""


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


def ablation_tasks(board: Board) -> list[str]:
    """Return the tasks of the ablation on which its first variant was evaluated."""
    first = next(iter(VARIANTS))
    return [task for task in ABLATION_TASKS if board.score(task, first, "skill", 1)]
