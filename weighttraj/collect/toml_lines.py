"""Where a key stands in a TOML text: ``tomllib`` does not say."""

from __future__ import annotations

import re
import tomllib

_NAME = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_KEY = rf"{_NAME}(?:\s*\.\s*{_NAME})*"
_HEADER = re.compile(rf"\s*\[\s*({_KEY})\s*\]")
_ASSIGNMENT = re.compile(rf"\s*({_KEY})\s*=")


def line_of(text: str, key: str) -> int | None:
    """Return the number of the line that sets a key, or a table that holds it; None: there is none.

    Args:
        text: TOML that can be read.
        key: with its tables, such as ``ppo.gamma``.
    """
    lines = text.split("\n")
    table, of_table = "", None
    for i, line in enumerate(lines):
        if match := _HEADER.match(line):
            if _is_outermost(lines[:i]):
                table = _plain(match[1])
                of_table = i + 1 if table == key else of_table
        elif match := _ASSIGNMENT.match(line):
            name = _plain(f"{table}.{match[1]}" if table else match[1])
            # An inline table, ppo = {gamma = 2}, holds its keys.
            if (key == name or key.startswith(f"{name}.")) and _is_outermost(lines[:i]):
                return i + 1
    return of_table


def _plain(key: str) -> str:
    """``ppo . "gamma"`` as ``ppo.gamma``."""
    return ".".join(part.strip("\"'") for part in re.findall(_NAME, key))


def _is_outermost(before: list[str]) -> bool:
    """Return whether the next line is not in the middle of a list or string of several lines."""
    try:
        tomllib.loads("\n".join(before))
    except ValueError:
        return False
    return True
