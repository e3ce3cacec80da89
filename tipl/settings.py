"""Refuses invalid settings before anything is read or written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from weighttraj.errors import WeightTrajError


def check_settings(
    settings: Mapping[str, Any], least: Mapping[str, float], error: type[WeightTrajError]
) -> None:
    """Refuse numbers that are too small, and empty lists.

    Args:
        settings: values by name; others are ignored.
        least: smallest value of each setting, or of each number in its list.
        error: type of the error.
    """
    wrong = {name: value for name, low in least.items() if not _fits(value := settings[name], low)}
    if wrong:
        raise error(
            "invalid settings",
            expected=", ".join(f"{name} of at least {least[name]:g}" for name in wrong),
            got=", ".join(f"{name} {_told(value)}" for name, value in wrong.items()),
            do="change them",
        )


def check_heads(n_embd: int, n_head: int, error: type[WeightTrajError]) -> None:
    """Refuse a width that the heads cannot share equally."""
    if n_embd % n_head:
        raise error(
            "the attention heads cannot share the width equally",
            expected="n_embd a multiple of n_head",
            got=f"n_embd {n_embd}, n_head {n_head}",
            do="change one of them",
        )


def _fits(value: Any, least: float) -> bool:
    numbers = value if isinstance(value, tuple | list) else (value,)
    return len(numbers) > 0 and min(numbers) >= least


def _told(value: Any) -> str:
    if isinstance(value, tuple | list):
        return " ".join(map(str, value)) or "empty"
    return str(value)
