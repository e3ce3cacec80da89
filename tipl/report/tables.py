"""Results in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tipl.report.scores import FUNCTION_SKILL, GAIN, REPW, SKILL, Row, row_at, rows_of

LABELS = {"tipl": "TIPL", "persistence": "copy"}
SHOWN = (1, 2, 5, 10, 50, 100, 200)
"""Horizons in tables."""
MODE_NAMES = {
    "sampled": "sampled actions",
    "held": "sampled actions, log_std of the start",
    "deterministic": "deterministic actions",
}


@dataclass(frozen=True, kw_only=True)
class Table:
    """A title, and for each forecaster a value with its interval for each column."""

    title: str
    """What is shown."""
    columns: tuple[str, ...]
    """Heads."""
    rows: list[tuple[str, list[Row | None]]]
    """Name of the forecaster, and its cells; None: not measured."""
    digits: int = 2
    """After the point."""
    main: bool = False
    """Whether it is among the few that a reader should see first."""


def tables(results: dict[str, Any]) -> list[Table]:
    """All tables of a page."""
    found = [
        _by_horizon(results, "Skill: ratio of sums, all starts", SKILL),
        _by_horizon(results, "Skill: mean of the ratios", ("skill", "mean_of_ratios", "all")),
        _by_horizon(results, "Skill: mean over tensors", ("skill", "tensors_equal", "all")),
        _by_horizon(
            results,
            "Skill: next step within the iteration",
            ("skill", "ratio_of_sums", "within"),
        ),
        _by_horizon(
            results, "Skill: next step in a new iteration", ("skill", "ratio_of_sums", "boundary")
        ),
        _by_horizon(results, "Function skill: divergence of policies", FUNCTION_SKILL),
    ]
    for mode in results["modes"]:
        name = MODE_NAMES[mode]
        found.append(_by_horizon(results, f"Inference gain, {name}", ("gain", mode)))
        for phase in ("learning", "plateau"):
            title = f"REPW, {name}, {'learning phase' if phase == 'learning' else 'after it'}"
            found.append(_by_horizon(results, title, ("repw", mode, phase), digits=1))
    return [table for table in found if table.rows]


def _by_horizon(
    results: dict[str, Any], title: str, path: tuple[str, ...], *, digits: int = 2
) -> Table:
    rows = []
    for name, scores in results["forecasters"].items():
        by_h = {row["h"]: row for row in rows_of(scores, path)}
        if by_h:
            rows.append((name, by_h))
    shown = [h for h in SHOWN if rows and h in rows[0][1]]
    return Table(
        title=title,
        columns=tuple(f"h = {h}" for h in shown),
        rows=[(name, [by_h.get(h) for h in shown]) for name, by_h in rows],
        digits=digits,
        main=path in (SKILL, FUNCTION_SKILL, GAIN),
    )


def label(name: str) -> str:
    """What a forecaster is called in text."""
    return LABELS.get(name, name.replace("reconstruction-", "floor, rank "))


def cell(row: Row | None, digits: int = 2, *, interval: bool = True) -> str:
    """A value, with its interval."""
    if row is None or row["value"] is None:
        return "-"
    text = _number(row["value"], digits)
    if interval and row["low"] is not None and row["low"] != row["high"]:
        text += f" [{_number(row['low'], digits)}, {_number(row['high'], digits)}]"
    return text


def _number(value: float, digits: int) -> str:
    """At least three digits: 0.12, 12.34, 123, 12300."""
    return f"{float(f'{value:.3g}'):.0f}" if abs(value) >= 100 else f"{value:.{digits}f}"


COLUMNS: dict[str, tuple[Sequence[str], int]] = {
    "skill, h = 1": (SKILL, 1),
    "skill, h = 10": (SKILL, 10),
    "skill, h = 50": (SKILL, 50),
    "function skill, h = 10": (FUNCTION_SKILL, 10),
    "REPW while learning, h = 10": (REPW, 10),
    "gain, h = 10": (GAIN, 10),
    "gain, h = 50": (GAIN, 50),
}
"""Of the overview: where the figure stands in the scores, and its horizon."""


def headline(results: dict[str, Any]) -> list[Table]:
    """The few columns that a page of many results shows."""
    rows = [
        (name, [row_at(scores, path, h) for path, h in COLUMNS.values()])
        for name, scores in results["forecasters"].items()
    ]
    kept = [i for i in range(len(COLUMNS)) if any(cells[i] for _, cells in rows)]
    return [
        Table(
            title="Overview",
            columns=tuple(list(COLUMNS)[i] for i in kept),
            rows=[(name, [cells[i] for i in kept]) for name, cells in rows],
        )
    ]


__all__ = ["MODE_NAMES", "Table", "cell", "headline", "label", "tables"]
