"""Snapshots of one or several trajectories, a piece at a time: no run need fit into memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from tipl.errors import RepresentationError
from tipl.runs import Rows, weights_of
from weighttraj import Run

PIECE_BYTES = 64 << 20
"""Bytes of the rows that are in memory at a time, at most, where a block of a run is smaller."""


BLOCK = 4096
"""Parameters that are in memory as float64 at a time."""

RunOrRows = Run | Rows
"""The snapshots of one run, time-ordered: the run, or the matrix of its weights."""


def matrix_of(trajectory: RunOrRows) -> Rows:
    """Return the matrix of a run's weights."""
    return weights_of(trajectory) if isinstance(trajectory, Run) else trajectory


def spans(size: int) -> Iterator[slice]:
    """Some parameters at a time."""
    return (slice(start, start + BLOCK) for start in range(0, size, BLOCK))


class Stack:
    """Trajectories one below the other, as one matrix.

    Args:
        trajectories: of equally many parameters.
        piece: rows that are read at once; None: about ``PIECE_BYTES``, and whole chunks of a run.

    Raises:
        RepresentationError: there are no trajectories or no snapshots, or they do not fit
            together.
    """

    def __init__(self, trajectories: Sequence[RunOrRows], piece: int | None = None) -> None:
        self._parts = [matrix_of(t) for t in trajectories]
        self._places = [t.path if isinstance(t, Run) else None for t in trajectories]
        blocks = [t.info.block if isinstance(t, Run) else 1 for t in trajectories]
        shapes = [part.shape for part in self._parts]
        if len({shape[1:] for shape in shapes}) != 1 or len(shapes[0]) != 2:
            raise RepresentationError(
                "these are no trajectories of one kind of policy",
                expected="matrices (time, param) with equally many parameters",
                got=f"shapes {shapes}",
                do="give runs of one data set",
            )
        self.lengths = [shape[0] for shape in shapes]
        """Snapshots of each trajectory."""
        self.shape = (sum(self.lengths), shapes[0][1])
        """Snapshots of all, and parameters."""
        if 0 in self.shape:
            raise RepresentationError(
                "there is nothing to represent",
                expected="a snapshot and a parameter at least",
                got=f"shapes {shapes}",
                where=self.where,
                do="wait until the run has committed its first snapshots",
            )
        single = all(part.dtype == np.float32 for part in self._parts)
        self.dtype: np.dtype[Any] = np.dtype(np.float32 if single else np.float64)
        """float32 where all weights are; else float64."""
        self._steps = [
            piece or _step(self.shape[1] * part.dtype.itemsize, block)
            for part, block in zip(self._parts, blocks, strict=True)
        ]

    @property
    def where(self) -> str | None:
        """Where the runs lie; None: they are arrays."""
        return ", ".join(str(place) for place in self._places if place) or None

    def pieces(self) -> Iterator[tuple[int, Float[np.ndarray, "row param"]]]:
        """Yield each piece, and the number of its first row in the stack.

        Raises:
            RepresentationError: a value is not finite.
            DamageError: a run is damaged.
        """
        first = 0
        for part, place, n, step in zip(
            self._parts, self._places, self.lengths, self._steps, strict=True
        ):
            for start in range(0, n, step):
                rows = np.asarray(part[start : start + step], self.dtype)
                check_finite(rows, start, place)
                yield first + start, rows
            first += n

    def read(self) -> Float[np.ndarray, "time param"]:
        """All rows, in memory."""
        out = np.empty(self.shape, self.dtype)
        for start, rows in self.pieces():
            out[start : start + len(rows)] = rows
        return out

    def early(self) -> np.ndarray:
        """Numbers of the rows in the first tenth of each trajectory: they settle signs."""
        ends = np.cumsum(self.lengths)
        tenths = [np.arange(max(1, n // 10)) for n in self.lengths]
        return np.concatenate(
            [end - n + rows for end, n, rows in zip(ends, self.lengths, tenths, strict=True)]
        )


def check_finite(
    rows: Float[np.ndarray, "row param"], first: int = 0, where: object = None
) -> None:
    """Refuse weights that are NaN or infinite.

    Args:
        rows: some snapshots.
        first: number of the first of them.
        where: what they are of.

    Raises:
        RepresentationError: a value is not finite.
    """
    if not np.isfinite(rows).all():
        bad = first + int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise RepresentationError(
            "the weights are not finite",
            expected="numbers only",
            got=f"NaN or infinity in snapshot {bad}",
            where=where,
            do="leave the run out; `weighttraj verify` names it",
        )


def _step(row_bytes: int, block: int) -> int:
    """Rows of a piece. Of a run, a power of two of blocks: wide packed runs have 64 or 128 rows
    in a chunk."""
    blocks = max(1, PIECE_BYTES // max(1, row_bytes * block))
    return block << (blocks.bit_length() - 1)
