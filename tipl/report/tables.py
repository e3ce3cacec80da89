"""Results in words and numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tipl.errors import EvaluateError

LABELS = {"tipl": "TIPL", "persistence": "copy"}
SHOWN = (1, 2, 5, 10, 50, 200)
"""Horizons in tables."""
MODE_NAMES = {
    "sampled": "sampled actions",
    "held": "sampled actions, log_std of the start",
    "deterministic": "deterministic actions",
}

Row = dict[str, Any]


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


def tables(results: dict[str, Any]) -> list[Table]:
    """All tables of a page."""
    found = [
        _by_horizon(results, "Skill: ratio of sums, all starts", "skill", "ratio_of_sums", "all"),
        _by_horizon(results, "Skill: mean of the ratios", "skill", "mean_of_ratios", "all"),
        _by_horizon(results, "Skill: mean over tensors", "skill", "tensors_equal", "all"),
        _by_horizon(
            results, "Skill: next step within the iteration", "skill", "ratio_of_sums", "within"
        ),
        _by_horizon(
            results, "Skill: next step in a new iteration", "skill", "ratio_of_sums", "boundary"
        ),
        _by_horizon(results, "Function skill: divergence of policies", "function_skill", "all"),
    ]
    for mode in results["modes"]:
        name = MODE_NAMES[mode]
        found.append(_by_horizon(results, f"Inference gain, {name}", "gain", mode))
        for phase in ("learning", "plateau"):
            title = f"REPW, {name}, {'learning phase' if phase == 'learning' else 'after it'}"
            found.append(_by_horizon(results, title, "repw", mode, phase, digits=1))
    return [table for table in found if table.rows]


def _by_horizon(results: dict[str, Any], title: str, *path: str, digits: int = 2) -> Table:
    rows = []
    for name, scores in results["forecasters"].items():
        cells: Any = scores
        for key in path:
            cells = cells.get(key, {})
        if cells:
            by_h = {row["h"]: row for row in cells}
            rows.append((name, by_h))
    shown = [h for h in SHOWN if rows and h in rows[0][1]]
    return Table(
        title=title,
        columns=tuple(f"h = {h}" for h in shown),
        rows=[(name, [by_h.get(h) for h in shown]) for name, by_h in rows],
        digits=digits,
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
    return f"{value:.3g}" if abs(value) >= 100 else f"{value:.{digits}f}"


def headline(results: dict[str, Any]) -> list[Table]:
    """The few columns that a page of many results shows."""
    columns = [
        ("skill, h = 1", ("skill", "ratio_of_sums", "all"), 1),
        ("skill, h = 10", ("skill", "ratio_of_sums", "all"), 10),
        ("skill, h = 50", ("skill", "ratio_of_sums", "all"), 50),
        ("function skill, h = 10", ("function_skill", "all"), 10),
        ("REPW while learning, h = 10", ("repw", "sampled", "learning"), 10),
        ("gain, h = 10", ("gain", "held"), 10),
        ("gain, h = 50", ("gain", "held"), 50),
    ]
    rows = [
        (name, [_at(scores, path, h) for _, path, h in columns])
        for name, scores in results["forecasters"].items()
    ]
    kept = [i for i in range(len(columns)) if any(cells[i] for _, cells in rows)]
    return [
        Table(
            title="Overview",
            columns=tuple(columns[i][0] for i in kept),
            rows=[(name, [cells[i] for i in kept]) for name, cells in rows],
        )
    ]


def _at(scores: dict[str, Any], path: Sequence[str], h: int) -> Row | None:
    found: Any = scores
    for key in path:
        found = found.get(key, {})
    return next((row for row in found if row["h"] == h), None)


def markdown(results: dict[str, Any]) -> str:
    """Overview and verdict as Markdown."""
    (table,) = headline(results)
    lines = [
        "| forecaster | " + " | ".join(table.columns) + " |",
        "|---|" + "---:|" * len(table.columns),
    ]
    for name, cells in table.rows:
        shown = " | ".join(cell(row, table.digits) for row in cells)
        lines.append(f"| {label(name)} | {shown} |")
    return "\n".join([*lines, "", verdict(results)])


def verdict(results: dict[str, Any]) -> str:
    """In plain sentences: do the models beat a copy of the last weights, and who is best?"""
    models = [n for n, s in results["forecasters"].items() if n != "persistence" and not s["floor"]]
    told = [name for name in models if name.startswith("tipl")] or models[:3]
    sentences = [s for name in told for s in _sentences(results, name)]
    if len(models) > 1:
        for h in (1, 10):
            if best := _best(results, models, h):
                sentences.append(best)
    return " ".join(sentences)


def _sentences(results: dict[str, Any], name: str) -> Iterator[str]:
    scores, copy = (results["forecasters"][n] for n in (name, "persistence"))
    skills = scores["skill"]["ratio_of_sums"]["all"]
    verdicts = [_sign(row) for row in skills]
    relation = (
        "beats"
        if set(verdicts) == {1}
        else "loses to"
        if set(verdicts) == {-1}
        else "splits with"
        if {1, -1} <= set(verdicts)
        else "does not clearly differ from"
    )
    first, last = skills[0], skills[-1]
    yield (
        f"In weight error, {label(name)} {relation} copying the last weights: skill "
        f"{cell(first)} at h = {first['h']}, {cell(last)} at h = {last['h']}."
    )
    for mode in scores.get("repw", {}):
        if mode == "held":
            continue
        ours, theirs = (
            sum(r["value"] for r in each["repw"][mode]["learning"]) for each in (scores, copy)
        )
        ratio = f"{ours / theirs:.3g} times the copy's" if theirs else "the copy's is 0"
        yield (
            f"In return while learning ({MODE_NAMES[mode]}), its REPW over all horizons is {ratio}."
        )


def _sign(row: Row) -> int:
    """1: above 0, -1: below, 0: the interval holds 0."""
    low = row["value"] if row["low"] is None else row["low"]
    high = row["value"] if row["high"] is None else row["high"]
    return 1 if low > 0 else -1 if high < 0 else 0


def _best(results: dict[str, Any], models: list[str], h: int) -> str | None:
    causal = [name for name in models if results["forecasters"][name]["causal"]]
    found = {
        name: row
        for name in causal
        if (row := _at(results["forecasters"][name], ("skill", "ratio_of_sums", "all"), h))
        and row["value"] is not None
    }
    if len(found) < 2:
        return None
    name = max(found, key=lambda n: found[n]["value"])
    return f"Best causal forecaster in weight error at h = {h}: {label(name)}, {cell(found[name])}."


def insert_markdown(results: dict[str, Any], source: Path, page: Path) -> None:
    """Replace what stands between the markers of a result file in a Markdown page.

    The markers are comments that begin with ``results of <source>`` and ``end of results``.

    Raises:
        EvaluateError: the page has no such markers.
    """
    text = page.read_text()
    before, start, rest = text.partition(f"<!-- results of {source}")
    marker_end, close, rest = rest.partition("-->\n")
    _, end, after = rest.partition("<!-- end of results -->")
    if not (start and close and end):
        raise EvaluateError(
            "the page has no place for these results",
            expected=f"<!-- results of {source} --> and <!-- end of results -->, a line each",
            where=page,
            do="write both lines where the table shall stand",
        )
    page.write_text(f"{before}{start}{marker_end}{close}\n{markdown(results)}\n\n{end}{after}")


__all__ = [
    "MODE_NAMES",
    "Table",
    "cell",
    "headline",
    "insert_markdown",
    "label",
    "markdown",
    "tables",
    "verdict",
]
