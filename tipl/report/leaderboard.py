"""A leaderboard as a page that can be sorted, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path

import jinja2

from tipl.evaluation.leaderboard import Entry, Leaderboard
from tipl.evaluation.results import Interval, TaskScore
from weighttraj.atomic import replace_file
from weighttraj.text import markdown as escaped

COLUMNS = ("tasks", "score", "error ratio", "wins", "wins over rival", "rank", "CPU ms")
"""Columns of a leaderboard behind the forecaster."""
_ORDER = ("skill", "gain", "function skill")


def cells(entry: Entry, *, interval: bool = True) -> tuple[str, ...]:
    """Return the texts of a line's columns."""
    figures = (entry.score, entry.ratio, entry.wins, entry.wins_over, entry.rank)
    cost = "-" if entry.cpu_ms is None else f"{entry.cpu_ms:.2g}"
    return (str(entry.tasks), *(_text(figure, interval) for figure in figures), cost)


def write_page(board: Leaderboard, out: Path, about: Mapping[str, str] | None = None) -> Path:
    """Write ``leaderboard.html``, ``leaderboard.md`` and ``leaderboard.csv``; return the page.

    Args:
        board: what is compared.
        out: folder.
        about: what some forecasters are, by name, for ``leaderboard.html``.
    """
    out.mkdir(parents=True, exist_ok=True)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tipl"), autoescape=True, trim_blocks=True
    )
    groups = [(*key, [(e, cells(e)) for e in lines]) for key, lines in _groups(board)]
    page = environment.get_template("leaderboard.html").render(
        board=board, groups=groups, columns=COLUMNS, tasks=_by_task(board), about=about or {}
    )
    replace_file(out / "leaderboard.html", page.encode())
    replace_file(out / "leaderboard.md", markdown(board).encode())
    replace_file(out / "leaderboard.csv", _csv(board).encode())
    return out / "leaderboard.html"


def markdown(board: Leaderboard) -> str:
    """Return a table for each measure and horizon."""
    parts = []
    for (measure, horizon), entries in _groups(board):
        lines = [
            f"**{measure}, {horizon} snapshot{'' if horizon == 1 else 's'} ahead**",
            "",
            f"| forecaster | {' | '.join(COLUMNS)} |",
            f"|---|{'---:|' * len(COLUMNS)}",
            *(f"| {_name(e)} | {' | '.join(cells(e))} |" for e in entries),
        ]
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _groups(board: Leaderboard) -> Iterator[tuple[tuple[str, int], list[Entry]]]:
    """Yield the entries of each measure and horizon: those of weights first, then returns."""
    keys = dict.fromkeys((e.measure, e.horizon) for e in board.entries)
    for key in sorted(keys, key=lambda key: (_ORDER.index(key[0]), key[1])):
        yield key, [e for e in board.entries if (e.measure, e.horizon) == key]


def _by_task(board: Leaderboard) -> list[tuple[TaskScore, str, str]]:
    return [(score, _text(score.score, True), _text(score.lead, True)) for score in board.scores]


def _name(entry: Entry) -> str:
    name = escaped(entry.forecaster)
    return f"{name} (bound)" if entry.oracle else name


def _text(figure: Interval, interval: bool) -> str:
    """Return a figure with two digits behind the point, and its interval."""
    if figure.value is None:
        return "-"
    text = f"{figure.value:.2f}"
    if interval and figure.low is not None and figure.high is not None:
        text += f" [{figure.low:.2f}, {figure.high:.2f}]"
    return text


def _csv(board: Leaderboard) -> str:
    """Return all lines, and the scores of each task, as one table."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["task", "measure", "horizon", "forecaster", "figure", "value", "low", "high", "tasks"]
    )
    for score in board.scores:
        key = [score.task, score.measure, score.horizon, score.forecaster, "score"]
        writer.writerow([*key, *_numbers(score.score), 1])
        writer.writerow([*key[:-1], "lead", *_numbers(score.lead), 1])
    for entry in board.entries:
        for figure in ("score", "ratio", "wins", "wins_over", "rank"):
            key = ["all", entry.measure, entry.horizon, entry.forecaster, figure]
            writer.writerow([*key, *_numbers(getattr(entry, figure)), entry.tasks])
    return text.getvalue()


def _numbers(figure: Interval) -> list[str]:
    values = (figure.value, figure.low, figure.high)
    return ["" if value is None else f"{value:.6g}" for value in values]
