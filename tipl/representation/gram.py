"""What prefixes of a run have in common: enough for the Gram matrix of each, without the run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from tipl.representation.rows import Stack, spans

Solved = tuple[np.ndarray, np.ndarray]
"""Of the snapshots from first to t, or of their displacements from t: the eigenvalues of their Gram
matrix, falling, (value,); and of those from first to last (inclusive), the coefficients times
singular values, (snapshot, value)."""


class Held:
    """For few parameters: the run is in memory, and Gram matrices are those of its parameters.

    Args:
        stack: the run.
        moved: displacements from t are asked for, and not snapshots.
    """

    def __init__(self, stack: Stack, moved: bool) -> None:
        self._rows, self._moved = stack.read().astype(np.float64), moved

    def solve(self, first: int, t: int, last: int) -> Solved:
        """See ``Solved``."""
        rows = self._rows[first : last + 1]
        if self._moved:
            rows = rows - self._rows[t]
        prefix = rows[: t - first + 1]
        squares, components = np.linalg.eigh(prefix.T @ prefix)
        return squares[::-1], rows @ components[:, ::-1]


class Band:
    """For many parameters: Gram matrices of snapshots, from inner products of neighbouring rows.

    Rows are steps ``phi_s - phi_{s-1}`` if displacements are asked for: sums of small numbers,
    where differences of products of whole snapshots would lose most digits.

    Args:
        stack: the run.
        reach: snapshots from the first of a prefix to the last one asked for, at most.
        moved: displacements from t are asked for, and not snapshots.
    """

    def __init__(self, stack: Stack, reach: int, moved: bool) -> None:
        self._moved = moved
        length, size = stack.shape
        reach = min(reach, length)
        # Row s, column j: row s times row s - j.
        self._band = np.zeros((length, reach))
        kept = np.empty((0, size), stack.dtype)
        for start, piece in _short(stack, max(128, reach)):
            rows = np.concatenate([kept, piece])
            gram = _products(rows, len(piece), moved)
            new, all_rows = gram.shape
            for i in range(new):
                end = all_rows - new + i + 1
                products = gram[i, max(0, end - reach) : end][::-1]
                self._band[start + len(piece) - new + i, : len(products)] = products
            kept = rows[max(0, len(rows) - reach) :].copy()

    def solve(self, first: int, t: int, last: int) -> Solved:
        """See ``Solved``."""
        gram, now = self._gram(first, t, last), t - first + 1
        squares, left = np.linalg.eigh(gram[:now, :now])
        squares, left = squares[::-1], left[:, ::-1]
        values = np.sqrt(np.maximum(squares, np.finfo(np.float64).tiny))
        return squares, np.concatenate([left * values, gram[now:, :now] @ left / values])

    def _gram(self, first: int, t: int, last: int) -> np.ndarray:
        """Inner products of the snapshots from first to last, or of their displacements from t."""
        rows = np.arange(first + self._moved, last + 1)
        later = np.maximum.outer(rows, rows)
        gram: np.ndarray = self._band[later, np.abs(np.subtract.outer(rows, rows))]
        if not self._moved:
            return gram
        # From steps to displacements from the first snapshot, and then from t.
        gram, now = np.pad(gram.cumsum(0).cumsum(1), ((1, 0), (1, 0))), t - first
        gram += gram[now, now] - gram[:, [now]] - gram[[now], :]
        return gram


def _short(stack: Stack, most: int) -> Iterator[tuple[int, np.ndarray]]:
    """Pieces of at most so many rows: longer ones would be multiplied with rows out of reach."""
    for start, piece in stack.pieces():
        for at in range(0, len(piece), most):
            yield start + at, piece[at : at + most]


def _products(rows: np.ndarray, new: int, moved: bool) -> Float[np.ndarray, "new row"]:
    """Inner products of the last rows, or of their steps, with all."""
    count = len(rows) - moved
    new = min(new, count)
    gram = np.zeros((new, count))
    for span in spans(rows.shape[1]):
        block = rows[:, span].astype(np.float64)
        block = np.diff(block, axis=0) if moved else block
        gram += block[count - new :] @ block.T
    return gram
