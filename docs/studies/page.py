"""What is written by a program into a page written by hand."""

from __future__ import annotations

from pathlib import Path


def insert(page: str, script: Path, content: str) -> str:
    """The page with the content between the script's two lines."""
    start, end = f"<!-- table: written by {script.name} -->", "<!-- end of the table -->"
    before, rest = page.split(start)
    _, after = rest.split(end)
    return f"{before}{start}\n\n{content}\n\n{end}{after}"
