"""``tipl zoo``: lists the released models. Imports neither torch nor zarr."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich import box
from rich.markup import escape
from rich.table import Table

from tipl import registry
from tipl.report.scores import GAIN, SKILL, row_at
from tipl.report.tables import cell
from tipl.zoo.metrics import read_metrics
from weighttraj.terminal import Output, say

WIDE = 150
"""Number of characters that a table with intervals needs."""
HEADLINE = {
    "skill, h = 1": (SKILL, 1),
    "skill, h = 10": (SKILL, 10),
    "gain, h = 50": (GAIN, 50),
}
"""Columns that sum a model up: a figure and its horizon."""


def zoo(
    into: Annotated[
        Path | None, tyro.conf.arg(help="write the table between the markers of a Markdown page")
    ] = None,
) -> None:
    """List the released models."""
    if into is not None:
        from tipl.zoo.table import insert_models

        insert_models(into)
        say(f"models in {into}")
        return
    console = Output()
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    wide = console.width >= WIDE
    columns = {"name": True, "kind": wide, "causal": True, "data set": wide}
    columns |= dict.fromkeys(HEADLINE, True)
    for column, shown in columns.items():
        if shown:
            justify: Literal["left", "right"] = "right" if column in HEADLINE else "left"
            head = column.replace(", ", "\n")
            table.add_column(head, justify=justify, no_wrap=column != "data set", vertical="bottom")
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
