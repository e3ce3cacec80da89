"""What a recipe says of how runs are trained and stored, and of their seeds."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, field
from typing import Literal

from weighttraj.errors import RecipeError
from weighttraj.format.schema import Profile


@dataclass(frozen=True, kw_only=True)
class Collect:
    """Who trains."""

    collector: Literal["sb3", "population"] = "sb3"
    """``sb3``: Stable-Baselines3, any environment, a run at a time. ``population``: the same
    training of many seeds at once, several times as fast, for Gymnasium's MuJoCo environments."""
    population: int = 16
    """Runs that a population trains at once; more or fewer give the same bytes."""

    @property
    def block(self) -> int:
        """Runs that one process makes at once."""
        return self.population if self.collector == "population" else 1


@dataclass(frozen=True, kw_only=True)
class Store:
    """What is stored, and how often."""

    every: int = 64
    """Gradient steps from one snapshot to the next."""
    critic: bool = False
    """Store the critic's parameters."""
    optimizer_moments: bool = False
    """Store Adam's moments of the policy's parameters."""
    probe_observations: int = 64
    """Network inputs kept of each rollout."""
    block: int = 64
    """Snapshots in a chunk and in a commit."""
    profile: Profile = "default"
    """How a finished run is packed: ``default``, or ``archive``, the smallest."""


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
        """Return the seeds of each split, ranges written out."""
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
        raise RecipeError(
            "invalid seeds", expected=error, got=reprlib.repr(seeds), do="correct the seeds"
        ) from error


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
