"""A page whose table is written by a script, from what it measured."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from weighttraj.text import between


class Study:
    """What was measured and the page that tells it, beside the script and named as it is.

    Args:
        script: its file.
        table: writes the table, of what was measured.
    """

    def __init__(self, script: str, table: Callable[[Any], str]) -> None:
        self.script = Path(script)
        self.page = self.script.with_suffix(".md")
        self._measured = self.script.with_suffix(".json")
        self._table = table

    def keep(self, measured: Any) -> None:
        """Write it to the result file."""
        self._measured.write_text(json.dumps(measured) + "\n")

    def measured(self) -> Any:
        """What the result file says; None: nothing was measured."""
        return json.loads(self._measured.read_text()) if self._measured.exists() else None

    def insert(self, page: str) -> str:
        """The page with the table as the result file has it, between the script's two lines."""
        start, end = f"<!-- table: written by {self.script.name} -->", "<!-- end of the table -->"
        return between(page, start, end, self._table(self.measured()))

    def render(self) -> None:
        """Write the page."""
        self.page.write_text(self.insert(self.page.read_text()))


def parser(told: str | None) -> argparse.ArgumentParser:
    """Of a script's options; its docstring is the help."""
    return argparse.ArgumentParser(
        description=told, formatter_class=argparse.RawDescriptionHelpFormatter
    )
