"""Gram matrices of the displacements of any prefix, from one reading of a run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from tipl.representation.rows import Snapshots, spans

Solved = tuple[np.ndarray, np.ndarray]
"""Of the displacements ``phi_s - phi_t``, s from first to t: the eigenvalues of their Gram matrix,
falling, (value,). And for s from first to last (inclusive): the coefficients times the singular
values, (snapshot, value)."""


class Held:
    """For few parameters: the run is in memory, and Gram matrices are (param, param)."""

    def __init__(self, snapshots: Snapshots) -> None:
        self._rows = snapshots.read()

    def solve(self, first: int, t: int, last: int) -> Solved:
        """Return what ``Solved`` says."""
        rows = self._rows[first : last + 1] - self._rows[t]
        prefix = rows[: t - first + 1]
        squares, components = np.linalg.eigh(prefix.T @ prefix)
        return squares[::-1], rows @ components[:, ::-1]


class Band:
    """For many parameters: Gram matrices are (snapshot, snapshot).

    They come from inner products of neighbouring steps ``phi_s - phi_{s-1}``, which are computed
    once. These are sums of small numbers; differences of products of whole snapshots would lose
    most digits.

    Args:
        snapshots: the run.
        reach: largest number of snapshots from the first of a prefix to the last one asked for.
    """

    def __init__(self, snapshots: Snapshots, reach: int) -> None:
        length, size = snapshots.shape
        reach = min(reach, length)
        # Row s, column j: step s times step s - j.
        self._band = np.zeros((length, reach))
        kept = np.empty((0, size), snapshots.dtype)
        for start, piece in _short(snapshots, max(128, reach)):
            rows = np.concatenate([kept, piece])
            gram = _products(rows, len(piece))
            new, all_rows = gram.shape
            for i in range(new):
                end = all_rows - new + i + 1
                products = gram[i, max(0, end - reach) : end][::-1]
                self._band[start + len(piece) - new + i, : len(products)] = products
            kept = rows[max(0, len(rows) - reach) :].copy()

    def solve(self, first: int, t: int, last: int) -> Solved:
        """Return what ``Solved`` says."""
        gram, now = self._gram(first, t, last), t - first + 1
        squares, left = np.linalg.eigh(gram[:now, :now])
        squares, left = squares[::-1], left[:, ::-1]
        values = np.sqrt(np.maximum(squares, np.finfo(np.float64).tiny))
        return squares, np.concatenate([left * values, gram[now:, :now] @ left / values])

    def _gram(self, first: int, t: int, last: int) -> np.ndarray:
        """Return the inner products of the displacements from t, from first to last."""
        steps = np.arange(first + 1, last + 1)
        later = np.maximum.outer(steps, steps)
        gram: np.ndarray = self._band[later, np.abs(np.subtract.outer(steps, steps))]
        # Sums of steps are displacements from the first snapshot. Then move the origin to t.
        gram, now = np.pad(gram.cumsum(0).cumsum(1), ((1, 0), (1, 0))), t - first
        gram += gram[now, now] - gram[:, [now]] - gram[[now], :]
        return gram


def _short(snapshots: Snapshots, most: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield pieces of at most so many rows: longer ones are multiplied with rows out of reach."""
    for start, piece in snapshots.pieces():
        for at in range(0, len(piece), most):
            yield start + at, piece[at : at + most]


def _products(rows: np.ndarray, new: int) -> Float[np.ndarray, "new step"]:
    """Return the inner products of the last ``new`` steps with all steps."""
    count = len(rows) - 1
    new = min(new, count)
    gram = np.zeros((new, count))
    for span in spans(rows.shape[1]):
        steps = np.diff(rows[:, span].astype(np.float64), axis=0)
        gram += steps[count - new :] @ steps.T
    return gram
