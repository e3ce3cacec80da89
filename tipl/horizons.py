"""Horizons: numbers of snapshots ahead."""

from __future__ import annotations

from collections.abc import Sequence

from tipl.errors import ForecastError, TrainError

HORIZONS = (*range(1, 11), 20, 50, 100, 200)
"""Horizons that forecasters are fitted for, and that evaluations report."""


def fitted(horizons: Sequence[int]) -> tuple[int, ...]:
    """Return the horizons to fit, rising, each once; refuse an empty list, and those below 1."""
    if not len(horizons) or min(horizons) < 1:
        raise TrainError(
            "there is nothing to fit",
            expected="horizons from 1",
            got=list(horizons),
            do="name at least one horizon",
        )
    return tuple(sorted(set(horizons)))


def rows_of(known: Sequence[int], wanted: Sequence[int], name: str) -> list[int]:
    """Return the places of the wanted horizons among those that were fitted; refuse others."""
    if missing := sorted(set(wanted) - set(known)):
        raise ForecastError(
            "the forecaster was not fitted for this horizon",
            expected=f"horizons among {list(known)}",
            got=missing,
            where=name,
            do="ask for those, or fit it with these: fit(runs, horizons=...)",
        )
    return [list(known).index(h) for h in wanted]


def too_short(horizons: Sequence[int]) -> TrainError:
    """Return the error of runs that end before the last horizon."""
    return TrainError(
        "the runs are too short to train for each horizon",
        expected=f"runs of more than {max(horizons) + 2} snapshots",
        do="train for fewer horizons, or collect longer runs",
    )
