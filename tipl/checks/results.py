"""What the six checks find, and the file that ``tipl check`` writes. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from tipl.errors import ModelError

NULL = 0.02
"""Largest skill, up or down, that passes on random walks."""
TOLERANCE = 1e-3
"""Largest error, relative to the displacement, that passes. Float32 keeps a weight of 0.5 to 3e-8
and so a step of 1e-4 to 3e-4; sums in another order differ by less."""


@dataclass(frozen=True, kw_only=True)
class Checks:
    """What the checks measured of one forecaster; ``passed`` compares it with limits."""

    null: dict[int, float]
    """Skill at each horizon on random walks."""
    causality: bool
    """Whether the forecast is the same to the last bit, whatever comes later."""
    permutation: float
    """Error after a permutation of hidden units, relative to the displacement."""
    sign: float | None
    """Error after a flip of signs; None: the policy has no odd units."""
    scale: float
    """Error after all steps were doubled."""
    drift: float | None
    """Error on a straight line; None: no forecast, since a line has fewer directions than a basis
    needs."""

    @property
    def passed(self) -> dict[str, bool]:
        """Verdict of each check."""
        return {
            "null": all(abs(skill) < NULL for skill in self.null.values()),
            "causality": self.causality,
            "permutation": self.permutation < TOLERANCE,
            "sign": self.sign is None or self.sign < TOLERANCE,
            "scale": self.scale < TOLERANCE,
            "drift": self.drift is not None and self.drift < TOLERANCE,
        }


class Limits(msgspec.Struct, frozen=True, kw_only=True):
    """The largest values that pass."""

    null: float = NULL
    error: float = TOLERANCE


class CheckResults(msgspec.Struct, frozen=True, kw_only=True):
    """What the file of ``tipl check`` holds: how a forecaster was checked, and ``Checks``."""

    forecaster: str
    """Name of the forecaster."""
    fingerprint: str
    """SHA-256 of the files that it saves."""
    data: str
    """Id of the data set."""
    version: str
    """Version of the data set."""
    run: str
    """Id of the run that the checks alter."""
    fitted_to_walks: bool
    """Whether a forecaster of this kind was fitted to random walks."""
    batches: int
    """Number of batches of that fit."""
    walks: int
    """Number of random walks: two are forecast, the others are for the fit."""
    seed: int
    """Seed of walks, symmetries and that fit."""
    largest: Limits
    """The largest values that pass."""
    null: dict[int, float]
    causality: bool
    permutation: float
    sign: float | None
    scale: float
    drift: float | None
    passed: dict[str, bool]
    """Verdict of each check."""
    command: str
    """The command that made the file."""


def read_checks(file: Path) -> CheckResults:
    """Read a file of ``tipl check``.

    Raises:
        ModelError: it is none.
        FileNotFoundError: it is not there.
    """
    try:
        return msgspec.json.decode(file.read_bytes(), type=CheckResults)
    except msgspec.DecodeError as error:
        raise ModelError(
            "the file holds no checks",
            expected="what `tipl check` writes",
            got=error,
            where=file,
            do="check the model again",
        ) from error
