"""Results as tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tipl.evaluation.results import Interval, Measure, Results, Row
from tipl.report.scores import (
    GAIN,
    REPW,
    SKILL,
    function_skill,
    gain,
    repw,
    row_at,
    skill,
)

LABELS = {"tipl": "TIPL"}
SHOWN = (1, 2, 5, 10, 50, 100, 200)
"""Horizons in tables, where these were measured."""
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


def tables(results: Results) -> list[Table]:
    """Return all tables of a page."""
    boundary = skill(starts="boundary")
    found = [
        _by_horizon(results, "Skill: ratio of sums, all starts", SKILL, main=True),
        _by_horizon(results, "Skill: mean of the ratios", skill("mean_of_ratios")),
        _by_horizon(results, "Skill: mean over tensors", skill("tensors_equal")),
        _by_horizon(results, "Skill: next step within the iteration", skill(starts="within")),
        _by_horizon(results, "Skill: next step in a new iteration", boundary),
        _by_horizon(results, "Function skill: divergence of policies", function_skill, main=True),
    ]
    for mode in results.modes:
        name, main = MODE_NAMES[mode], mode == "held"
        found.append(_by_horizon(results, f"Inference gain, {name}", gain(mode), main=main))
        for phase in ("learning", "plateau"):
            title = f"REPW, {name}, {'learning phase' if phase == 'learning' else 'after it'}"
            found.append(_by_horizon(results, title, repw(mode, phase), digits=1))
    return [table for table in found if table.rows]


def _by_horizon(
    results: Results, title: str, measure: Measure, *, digits: int = 2, main: bool = False
) -> Table:
    rows = []
    for name, scores in results.forecasters.items():
        by_h = {row.h: row for row in measure(scores)}
        if by_h:
            rows.append((name, by_h))
    horizons = _shown(list(rows[0][1])) if rows else []
    return Table(
        title=title,
        columns=tuple(f"h = {h}" for h in horizons),
        rows=[(name, [by_h.get(h) for h in horizons]) for name, by_h in rows],
        digits=digits,
        main=main,
    )


def _shown(measured: Sequence[int]) -> list[int]:
    """Return the horizons that a table shows: the usual ones, or else all that were measured."""
    usual = [h for h in SHOWN if h in measured]
    return usual if len(measured) > len(SHOWN) else list(measured)


def label(name: str) -> str:
    """Return what a forecaster is called in text."""
    return LABELS.get(name, name.replace("reconstruction-", "reconstruction (oracle), rank "))


def cell(row: Row | Interval | None, digits: int = 2, *, interval: bool = True) -> str:
    """Return a value as text, with its interval."""
    if row is None or row.value is None:
        return "-"
    text = _number(row.value, digits)
    if interval and row.low is not None and row.high is not None and row.low != row.high:
        text += f" [{_number(row.low, digits)}, {_number(row.high, digits)}]"
    return text


def _number(value: float, digits: int) -> str:
    """Return a number with at least three digits: 0.12, 12.34, 123, 12300."""
    return f"{float(f'{value:.3g}'):.0f}" if abs(value) >= 100 else f"{value:.{digits}f}"


COLUMNS: tuple[tuple[str, Measure, tuple[int, ...]], ...] = (
    ("skill", SKILL, (1, 10, 50)),
    ("function skill", function_skill, (10,)),
    ("REPW while learning", REPW, (10,)),
    ("gain", GAIN, (10, 50)),
)
"""Figures of the overview, and the horizons at which it shows them."""
FEW = 3
"""Up to so many horizons, the overview shows the skill at each."""


def headline(results: Results) -> Table:
    """Return the overview: the few columns that a page of many results shows."""
    columns = [
        (f"{what}, h = {h}", measure, h)
        for what, measure, usual in COLUMNS
        for h in _horizons(results, measure, usual)
    ]
    rows = [
        (name, [row_at(scores, measure, h) for _, measure, h in columns])
        for name, scores in results.forecasters.items()
    ]
    return Table(title="Overview", columns=tuple(title for title, _, _ in columns), rows=rows)


def compact(results: Results) -> Table:
    """Return the columns of the overview that fit a narrow page: skill and gain."""
    overview = headline(results)
    chosen = [i for i, title in enumerate(overview.columns) if title.startswith(("skill", "gain"))]
    return Table(
        title=overview.title,
        columns=tuple(overview.columns[i] for i in chosen),
        rows=[(name, [cells[i] for i in chosen]) for name, cells in overview.rows],
    )


def _horizons(results: Results, measure: Measure, usual: Sequence[int]) -> list[int]:
    """Return the horizons of a figure in the overview: the usual ones, or those there are."""
    each = ([row.h for row in measure(scores)] for scores in results.forecasters.values())
    measured = max(each, key=len, default=[])
    if measure is SKILL and len(measured) <= FEW:
        return measured
    return [h for h in usual if h in measured] or measured[-1:]
