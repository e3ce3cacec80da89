"""The weights of one trajectory, read a piece at a time, so that no run need fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from tipl.errors import RepresentationError
from tipl.runs import Rows, weights_of
from weighttraj import Run

PIECE_BYTES = 64 << 20
"""Bytes of the rows that are read at once."""
BLOCK = 4096
"""Number of parameters that are converted to float64 at once."""

RunOrRows = Run | Rows
"""The snapshots of one run, time-ordered: the run, or the matrix of its weights."""


def spans(size: int) -> Iterator[slice]:
    """Yield slices of at most ``BLOCK`` parameters."""
    return (slice(start, start + BLOCK) for start in range(0, size, BLOCK))


class Snapshots:
    """The weights of a trajectory as a matrix (time, param) that is read in pieces.

    Args:
        trajectory: the run, or the matrix of its weights.
        piece: number of rows that are read at once; None: about ``PIECE_BYTES``.

    Raises:
        RepresentationError: there is no snapshot or no parameter, or the matrix has other axes.
    """

    def __init__(self, trajectory: RunOrRows, piece: int | None = None) -> None:
        self.rows: Rows = weights_of(trajectory) if isinstance(trajectory, Run) else trajectory
        self.where = trajectory.path if isinstance(trajectory, Run) else None
        self.shape = self.rows.shape
        if len(self.shape) != 2 or 0 in self.shape:
            raise RepresentationError(
                "there is nothing to represent",
                expected="a matrix (time, param) with a snapshot and a parameter at least",
                got=f"shape {self.shape}",
                where=self.where,
                do="wait until the run has committed its first snapshots",
            )
        single = self.rows.dtype == np.float32
        self.dtype: np.dtype[Any] = np.dtype(np.float32 if single else np.float64)
        self._piece = piece or max(1, PIECE_BYTES // (self.shape[1] * self.rows.dtype.itemsize))

    def pieces(self) -> Iterator[tuple[int, Float[np.ndarray, "row param"]]]:
        """Yield each piece with the number of its first row.

        Raises:
            RepresentationError: a value is not finite.
            DamageError: the run is damaged.
        """
        for start in range(0, self.shape[0], self._piece):
            rows = np.asarray(self.rows[start : start + self._piece], self.dtype)
            self._check_finite(rows, start)
            yield start, rows

    def read(self) -> Float[np.ndarray, "time param"]:
        """Return all rows, in float64."""
        return np.concatenate([rows.astype(np.float64) for _, rows in self.pieces()])

    def _check_finite(self, rows: Float[np.ndarray, "row param"], first: int) -> None:
        bad = ~np.isfinite(rows).all(axis=1)
        if bad.any():
            raise RepresentationError(
                "the weights are not finite",
                expected="numbers only",
                got=f"NaN or infinity in snapshot {first + int(bad.argmax())}",
                where=self.where,
                do="leave the run out; `weighttraj verify` names it",
            )
