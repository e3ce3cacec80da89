"""Bases that have seen nothing after a start, for many starts of a run.

The basis at t is an SVD of the displacements ``phi_s - phi_t`` for s up to t: of all of them, or of
the last ``window``. It comes from the eigenvectors of the smaller one of its two Gram matrices.
When that is (snapshot, snapshot), its entries for all starts come from one reading of the run.

For T snapshots of P parameters and a window of W < P, the reading takes T W P multiplications and a
start 9 W^3; with P <= W, a start takes W P^2 + 9 P^3. On one core, a window of 256 of a run of
HalfCheetah (T = 4,881, P = 71,948) takes 15 s once and 10 ms a start; all its snapshots take a
minute once and half a minute a start. All snapshots of a run of InvertedPendulum (T = 1,951, P =
122) take 5 ms a start.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from tipl.errors import RepresentationError
from tipl.representation.gram import Band, Held
from tipl.representation.rows import RunOrRows, Snapshots, spans
from tipl.representation.svd import TemporalSVD, check_rank, signs_of


@dataclass(frozen=True, kw_only=True)
class PrefixTokens:
    """The neighbourhood of a start t in the basis of its prefix."""

    first: int
    """The first snapshot that the basis has seen."""
    coefficients: Float[np.ndarray, "snapshot rank"]
    """Coefficients of ``phi_s - phi_t``, s from ``first``: rows of U up to t, and then the
    snapshots that were asked for with ``ahead``, in the same units."""
    singular_values: Float[np.ndarray, " rank"]
    """Singular values of the prefix, falling."""
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

    rank: int
    """Number of directions d."""
    window: int
    """Largest number of snapshots that a basis sees, its start included."""
    ahead: int
    """Number of snapshots after a start whose coefficients ``tokens`` returns too."""
    _snapshots: Snapshots = field(repr=False)
    _grams: Band | Held = field(repr=False)

    @classmethod
    def fit(
        cls, trajectory: RunOrRows, rank: int, *, window: int | None = None, ahead: int = 0
    ) -> PrefixBases:
        """Read a run once, and keep what all bases need.

        Args:
            trajectory: the run, or the matrix of its weights.
            rank: number of directions d.
            window: largest number of snapshots that a basis sees; None: all.
            ahead: number of snapshots after a start whose coefficients are wanted, for example as
                targets of a training. No basis sees them.

        Raises:
            RepresentationError: no prefix has such a rank, or a value is not finite.
        """
        snapshots = Snapshots(trajectory)
        length, size = snapshots.shape
        window = length if window is None else min(window, length)
        most = min(window - 1, size)
        if not (1 <= rank <= most and ahead >= 0):
            raise RepresentationError(
                "no prefix of the run has such a basis",
                expected=f"a rank from 1 to {most}, for the displacements of "
                f"{window} snapshots of {size} parameters; ahead from 0",
                got=f"rank {rank}, ahead {ahead}",
                where=snapshots.where,
                do="choose a smaller rank or a longer window, or longer runs",
            )
        grams = Held(snapshots) if size <= window else Band(snapshots, window + ahead)
        return cls(rank=rank, window=window, ahead=ahead, _snapshots=snapshots, _grams=grams)

    def tokens(self, t: int) -> PrefixTokens:
        """Return the coefficients around a start; the run is not read again.

        Raises:
            RepresentationError: there is no such snapshot, too few came before it, or they lie
                along fewer directions than the rank.
        """
        self._check_start(t)
        first, last = max(0, t - self.window + 1), self._snapshots.shape[0] - 1
        squares, images = self._grams.solve(first, t, min(t + self.ahead, last))
        # Squares below this share of the first are rounding.
        tolerance = float(np.sqrt(len(squares) * np.finfo(np.float64).eps))
        values, where = np.sqrt(np.maximum(squares, 0)), self._snapshots.where or "a run"
        check_rank(values, self.rank, tolerance, f"snapshots {first} to {t} of {where}")
        values, count = values[: self.rank], t - first + 1
        coefficients = images[:, : self.rank] / values
        return PrefixTokens(
            first=first,
            coefficients=coefficients * signs_of(coefficients[:count]),
            singular_values=values,
            total_energy=float(squares.sum()),
        )

    def basis(self, t: int) -> TemporalSVD:
        """Return the basis of a start; reads the snapshots that it has seen.

        A forecast u is decoded as ``phi_t + basis.inverse_transform(u)``.

        Raises:
            RepresentationError: as ``tokens``.
        """
        tokens = self.tokens(t)
        rows = self._snapshots.rows[tokens.first : t + 1]
        mix = tokens.coefficients[: len(rows)].T / tokens.singular_values[:, None]
        components = np.empty((self.rank, rows.shape[1]))
        for span in spans(rows.shape[1]):
            block = np.asarray(rows[:, span], np.float64)
            components[:, span] = mix @ (block - block[-1])
        return TemporalSVD(
            components=components,
            singular_values=tokens.singular_values,
            total_energy=tokens.total_energy,
        )

    def _check_start(self, t: int) -> None:
        where, last = self._snapshots.where, self._snapshots.shape[0] - 1
        if not 0 <= t <= last:
            raise RepresentationError(
                "there is no such start",
                expected=f"a snapshot from 0 to {last}",
                got=t,
                where=where,
                do="choose another start",
            )
        if t < self.rank:
            raise RepresentationError(
                "there are too few snapshots up to this start",
                expected=f"a start from {self.rank}, for {self.rank} directions of displacements",
                got=t,
                where=where,
                do="choose later starts, or a smaller rank",
            )
