"""``tipl zoo``: lists the released models. Imports neither torch nor zarr."""

from __future__ import annotations

from typing import Literal

from rich.markup import escape
from rich.table import Table

from tipl import registry
from tipl.report.scores import GAIN, SKILL, row_at
from tipl.report.tables import cell
from tipl.zoo.metrics import read_metrics
from weighttraj.terminal import Output

WIDE = 150
"""Number of characters that a table with intervals needs."""
HEADLINE = {
    "skill, h = 1": (SKILL, 1),
    "skill, h = 10": (SKILL, 10),
    "gain, h = 50": (GAIN, 50),
}
"""Columns that sum a model up: a figure and its horizon."""


def zoo() -> None:
    """List the released models."""
    console = Output()
    table, wide = Table(), console.width >= WIDE
    columns = {"name": True, "kind": wide, "causal": True, "data set": wide}
    columns |= dict.fromkeys(HEADLINE, True)
    for column, shown in columns.items():
        if shown:
            justify: Literal["left", "right"] = "right" if column in HEADLINE else "left"
            table.add_column(column, justify=justify, no_wrap=column == "name")
    for name in registry.names():
        cells = zip(listed(name, interval=wide), columns.values(), strict=True)
        table.add_row(*(escape(text) for text, shown in cells if shown))
    console.print(table)


def listed(name: str, *, interval: bool = True) -> tuple[str, ...]:
    """Return a line of ``tipl zoo``: name, kind, causal, data set, and ``HEADLINE`` figures."""
    folder = registry.MODELS / name
    metrics = read_metrics(folder)
    if metrics is None:
        return (name, registry.kind_in(folder), *["-"] * (2 + len(HEADLINE)))
    rows = [row_at(metrics.scores, measure, h) for measure, h in HEADLINE.values()]
    figures = [cell(row, interval=interval) for row in rows]
    causal = "yes" if metrics.causal else "no"
    return (name, metrics.kind, causal, metrics.results.data, *figures)
