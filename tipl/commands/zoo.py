"""``tipl zoo``: lists the released models. Imports neither torch nor zarr."""

from __future__ import annotations

from typing import Literal

from rich.markup import escape
from rich.table import Table

from tipl import registry
from tipl.zoo.listing import HEADLINE, listed
from weighttraj.terminal import Output

WIDE = 150
"""Number of characters that a table with intervals needs."""


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
