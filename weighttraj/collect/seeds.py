"""Seeds of runs: lists of them, and ranges."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, field

from weighttraj.errors import RecipeError

SPLITS = ("train", "validation", "test")

_END = 2**32
"""NumPy's generators, which SB3 draws from, take seeds below this."""
_MOST = 100_000
"""Seeds that can be named at once."""
_FORMS = (
    f"integers from 0 to {_END - 1}, at most {_MOST:,} of them: a list, a range such as "
    '"0:30" (the end excluded), or several with commas between them, such as "0:4,30"'
)


@dataclass(frozen=True, kw_only=True)
class Seeds:
    """Seeds of each split: a list, or ranges such as ``"0:30"`` (the end excluded)."""

    train: list[int] | str = field(default_factory=list)
    """Runs that models are trained on."""
    validation: list[int] | str = field(default_factory=list)
    """Runs that choices are made on."""
    test: list[int] | str = field(default_factory=list)
    """Runs that only results are computed on."""

    def by_split(self) -> dict[str, list[int]]:
        """The seeds of each split, ranges written out."""
        return {name: parse_seeds(getattr(self, name)) for name in SPLITS}


def parse_seeds(seeds: list[int] | str) -> list[int]:
    """Return seeds from a list, a range, or several ranges with commas between them.

    >>> parse_seeds("3:6")
    [3, 4, 5]
    >>> parse_seeds("0:2,30,40:42")
    [0, 1, 30, 40, 41]

    Raises:
        RecipeError: if it is no such range, or a seed is below 0 or above 2**32 - 1.
    """
    try:
        return read_seeds(seeds)
    except ValueError as error:
        raise RecipeError("invalid seeds", expected=error, got=reprlib.repr(seeds)) from error


def read_seeds(seeds: list[int] | str) -> list[int]:
    """Return the same as ``parse_seeds``.

    Raises:
        ValueError: saying what seeds could be.
    """
    try:
        ranges = (
            [_read_range(part) for part in seeds.split(",")]
            if isinstance(seeds, str)
            else [range(seed, seed + 1) for seed in seeds]
        )
    except (TypeError, ValueError):
        raise ValueError(_FORMS) from None
    # Counted before a list is made: "0:4000000000" would not fit into memory.
    if not all(map(_is_valid, ranges)) or sum(map(len, ranges)) > _MOST:
        raise ValueError(_FORMS)
    return [seed for part in ranges for seed in part]


def _read_range(text: str) -> range:
    start, _, stop = text.partition(":")
    return range(int(start), int(stop) if stop else int(start) + 1)


def _is_valid(seeds: range) -> bool:
    return 0 <= seeds.start < seeds.stop <= _END


__all__ = ["SPLITS", "Seeds", "parse_seeds", "read_seeds"]
