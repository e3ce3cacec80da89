"""Bases that have seen nothing after a start, for many starts of a run.

The basis at t is an SVD of what came before: of the displacements ``phi_s - phi_t``, or of the
snapshots themselves, for s up to t; of all of them, or of the last ``window``. It comes from the
eigenvectors of the smaller of its two Gram matrices. When that is the one of snapshots, its entries
for all starts are inner products of neighbouring rows, which are taken once.

For T snapshots of P parameters, a window of W (all: W = T) and d directions, in multiplications:

| | P > W | P <= W |
|---|---|---|
| once, with one reading | T W P | none |
| tokens of a start | 9 W^3 | W P^2 + 9 P^3 |
| basis of a start | W P d more, and reads W snapshots | W P d more |
| memory, numbers | T W + 2 W P | T P |

On one core, a window of 256 of a run of HalfCheetah (T = 4,881, P = 71,948) takes 15 s once and
10 ms a start; all its snapshots a minute once and half a minute a start. All snapshots of a run of
InvertedPendulum (T = 1,951, P = 122) take 5 ms a start.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from tipl.errors import RepresentationError
from tipl.representation.gram import Band, Held
from tipl.representation.rows import RunOrRows, Stack, matrix_of, spans
from tipl.representation.svd import TemporalSVD, check_rank, signs_of

Kind = Literal["displacements", "snapshots"]
"""Of what a basis is."""


@dataclass(frozen=True, kw_only=True)
class PrefixTokens:
    """The neighbourhood of a start t in the basis of its prefix."""

    first: int
    """The first snapshot that the basis has seen."""
    coefficients: Float[np.ndarray, "snapshot rank"]
    """Of ``phi_s - phi_t`` (or of phi_s), s from ``first``: rows of U up to t, and then, in the
    same units, as many snapshots as were asked for with ``ahead`` and the run has."""
    singular_values: Float[np.ndarray, " rank"]
    """Of the prefix, falling."""
    total_energy: float
    """Squared Frobenius norm of the prefix."""


@dataclass(frozen=True, kw_only=True)
class PrefixBases:
    """A rank-d basis for any start of a run, from the snapshots up to it.

    Signs are as in ``TemporalSVD.fit``: a column of U has a positive sum over the first tenth of
    the prefix.

    >>> weights = np.random.default_rng(0).normal(size=(200, 30)).cumsum(0)
    >>> bases = PrefixBases.fit(weights, rank=4, window=50)
    >>> tokens = bases.tokens(120)
    >>> tokens.first, tokens.coefficients.shape
    (71, (50, 4))
    >>> basis = bases.basis(120)  # of phi_s - phi_120, for s from 71 to 120
    >>> bool(np.allclose(basis.transform(weights[71:121] - weights[120]), tokens.coefficients))
    True
    """

    trajectory: RunOrRows
    """The run."""
    rank: int
    """Directions d."""
    kind: Kind
    """Of what the bases are."""
    window: int
    """Snapshots that a basis sees at most, up to and with its start."""
    ahead: int
    """Snapshots after a start whose coefficients ``tokens`` gives too."""
    _length: int = field(repr=False)
    _grams: Band | Held = field(repr=False)

    @classmethod
    def fit(
        cls,
        trajectory: RunOrRows,
        rank: int,
        *,
        kind: Kind = "displacements",
        window: int | None = None,
        ahead: int = 0,
    ) -> PrefixBases:
        """Read a run once, and take what all bases need.

        Args:
            trajectory: the run, or the matrix of its weights.
            rank: directions d.
            kind: ``displacements``: of ``phi_s - phi_t``, the path as seen from its end;
                ``snapshots``: of phi_s, uncentred.
            window: snapshots that a basis sees at most, up to and with its start; None: all.
            ahead: snapshots after a start whose coefficients are wanted, as the targets of a
                training. No basis sees them.

        Raises:
            RepresentationError: no prefix has such a rank, or a value is not finite.
        """
        stack = Stack([trajectory])
        length, size = stack.shape
        window = length if window is None else min(window, length)
        moved = kind == "displacements"
        if not (1 <= rank <= min(window - moved, size) and ahead >= 0):
            raise RepresentationError(
                "no prefix of the run has such a basis",
                expected=f"a rank from 1 to {min(window - moved, size)}, for the {kind} of "
                f"{window} snapshots of {size} parameters; ahead from 0",
                got=f"rank {rank}, ahead {ahead}",
                where=stack.where,
                do="choose a smaller rank or a longer window, or longer runs",
            )
        grams = Held(stack, moved) if size <= window else Band(stack, window + ahead, moved)
        return cls(
            trajectory=trajectory,
            rank=rank,
            kind=kind,
            window=window,
            ahead=ahead,
            _length=length,
            _grams=grams,
        )

    def tokens(self, t: int) -> PrefixTokens:
        """Coefficients around a start, without its basis; the run is not read again.

        Raises:
            RepresentationError: there is no such snapshot, too few came before it, or they lie
                along fewer directions than the rank.
        """
        first, where = self._first(t), Stack([self.trajectory]).where
        squares, images = self._grams.solve(first, t, min(t + self.ahead, self._length - 1))
        # Squares below this share of the first are rounding.
        tolerance = float(np.sqrt(len(squares) * np.finfo(np.float64).eps))
        values = np.sqrt(np.maximum(squares, 0))
        check_rank(values, self.rank, tolerance, f"snapshots {first} to {t} of {where or 'a run'}")
        values, count = values[: self.rank], t - first + 1
        coefficients = images[:, : self.rank] / values
        return PrefixTokens(
            first=first,
            coefficients=coefficients * signs_of(coefficients[: max(1, count // 10)]),
            singular_values=values,
            total_energy=float(squares.sum()),
        )

    def basis(self, t: int) -> TemporalSVD:
        """The basis of a start; reads the snapshots that it has seen.

        A forecast u is decoded as ``phi_t + basis.inverse_transform(u)``, or, of snapshots,
        without phi_t.

        Raises:
            RepresentationError: as ``tokens``.
        """
        tokens = self.tokens(t)
        rows = matrix_of(self.trajectory)[tokens.first : t + 1]
        mix = tokens.coefficients[: len(rows)].T / tokens.singular_values[:, None]
        components = np.empty((self.rank, rows.shape[1]))
        for span in spans(rows.shape[1]):
            block = np.asarray(rows[:, span], np.float64)
            components[:, span] = mix @ (block - block[-1] if self._moved else block)
        return TemporalSVD(
            components=components,
            singular_values=tokens.singular_values,
            total_energy=tokens.total_energy,
        )

    @property
    def _moved(self) -> bool:
        return self.kind == "displacements"

    def _first(self, t: int) -> int:
        if not 0 <= t < self._length:
            raise RepresentationError(
                "there is no such start",
                expected=f"a snapshot from 0 to {self._length - 1}",
                got=t,
                where=Stack([self.trajectory]).where,
            )
        needed = self.rank - 1 + self._moved
        if t < needed:
            raise RepresentationError(
                "there are too few snapshots up to this start",
                expected=f"a start from {needed}, for {self.rank} directions of {self.kind}",
                got=t,
                where=Stack([self.trajectory]).where,
                do="choose later starts, or a smaller rank",
            )
        return max(0, t - self.window + 1)
