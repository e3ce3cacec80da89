"""Temporal SVD: the path of a policy in the few directions along which it moves most.

After "The Ladder in Chaos" (Tang et al., NeurIPS 2024), as TIPL uses it (Tang, 2025): the snapshots
of one run are the rows of a matrix, which is not centred, and ``Phi = U S V^T``. A token is a row
of U, cut to the first d columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tipl.errors import RepresentationError
from tipl.representation.randomised import leading
from tipl.representation.rows import RunOrRows, Stack

EXACT_WORK = 10**9
"""Smaller side squared times larger side, up to which ``fit_run`` and ``fit_shared`` take the
exact SVD: about a second of one core. 122 parameters and 1,951 snapshots are 3 % of it."""


@dataclass(frozen=True, kw_only=True)
class TemporalSVD:
    """A rank-d basis of weights.

    >>> rng = np.random.default_rng(0)
    >>> weights = rng.normal(size=(50, 3)) @ rng.normal(size=(3, 10))
    >>> svd = TemporalSVD.fit(weights, rank=3)
    >>> bool(np.allclose(svd.inverse_transform(svd.transform(weights)), weights))
    True
    """

    components: Float[np.ndarray, "rank param"]
    """Rows of V^T: orthonormal directions in weight space."""
    singular_values: Float[np.ndarray, " rank"]
    """Diagonal of S, falling: the spectrum, cut at the rank."""
    total_energy: float
    """Squared Frobenius norm of the weights: the sum of *all* squared singular values."""

    @classmethod
    def fit(cls, weights: Float[np.ndarray, "time param"], rank: int) -> TemporalSVD:
        """Basis of a trajectory in memory, exact, in float64.

        Signs are arbitrary in an SVD. Here each column of U has a positive sum over the first
        tenth of the run, so that columns of different runs are alike.

        Raises:
            RepresentationError: the rank is not between 1 and the smaller side or is above the
                rank of the weights, or they are not finite.
        """
        return _exact(Stack([weights]), rank)

    @classmethod
    def fit_streamed(
        cls,
        trajectory: RunOrRows,
        rank: int,
        *,
        oversampling: int = 32,
        power_iterations: int = 2,
        seed: int = 0,
        piece: int | None = None,
    ) -> TemporalSVD:
        """Basis of a trajectory of any length, by a randomised SVD (Halko et al., 2011).

        Reads (and decodes) the run ``power_iterations + 1`` times, a piece at a time. With w =
        rank + oversampling, it takes ``(4 * power_iterations + 2) * w * T * P`` operations, where
        an exact SVD takes ``4 * T * T * P`` and more, and keeps ``(power_iterations + 3) * w * P``
        float64 in memory beside a piece.

        The leading singular values are the most accurate. On random walks and on a run of PPO on
        HalfCheetah, with the defaults: the first 32 of 64 within 1e-5, the last within 2e-3; with
        one power iteration more within 1e-9 and 3e-6. They are never too large, but for rounding.
        The same seed and pieces give the same basis, bit by bit; other pieces, the same up to
        rounding. Signs are as in ``fit``.

        Args:
            trajectory: the run, or a matrix that is read when it is sliced.
            rank: directions d.
            oversampling: directions beyond the rank that are followed on the way.
            power_iterations: passes before the last one.
            seed: seed of the random directions at the start.
            piece: snapshots that are in memory at a time; None: about 64 MiB, or a chunk.

        Raises:
            RepresentationError: as ``fit``, or a setting is negative.
        """
        settings = (oversampling, power_iterations, seed, 0 if piece is None else piece - 1)
        if min(settings) < 0:
            raise RepresentationError(
                "the randomised SVD cannot be done like this",
                expected="oversampling, power_iterations and seed from 0, piece from 1",
                got=(oversampling, power_iterations, seed, piece),
                do="leave them out: the defaults suit runs of PPO",
            )
        stack = Stack([trajectory], piece)
        return _streamed(stack, rank, oversampling, power_iterations, seed)

    @property
    def rank(self) -> int:
        """Number of directions d."""
        return len(self.singular_values)

    def transform(
        self, weights: Float[np.ndarray, "*batch param"]
    ) -> Float[np.ndarray, "*batch rank"]:
        """Coefficients u = phi V / S: rows of U for the weights of the fit."""
        return np.asarray(weights @ self.components.T / self.singular_values)

    def inverse_transform(
        self, coefficients: Float[np.ndarray, "*batch rank"]
    ) -> Float[np.ndarray, "*batch param"]:
        """Weights phi~ = u S V^T."""
        return np.asarray((coefficients * self.singular_values) @ self.components)

    def coefficients(self, trajectory: RunOrRows) -> Float[np.ndarray, "time rank"]:
        """Coefficients of a whole trajectory, read a piece at a time."""
        pieces = Stack([trajectory]).pieces()
        return np.concatenate([self.transform(rows) for _, rows in pieces])

    @property
    def information(self) -> Float[np.ndarray, " rank"]:
        """Share of the squared norm of the weights in the first 1, 2, ..., d directions."""
        return np.cumsum(self.singular_values**2) / self.total_energy

    def reconstruction_error(self, trajectory: RunOrRows) -> float:
        """Mean squared error of the weights after a round trip through d coefficients.

        In squared units of a weight; read a piece at a time.
        """
        stack = Stack([trajectory])
        total = 0.0
        for _, rows in stack.pieces():
            back = self.inverse_transform(self.transform(rows))
            back -= rows
            total += float(np.vdot(back, back))
        return total / (stack.shape[0] * stack.shape[1])


def fit_run(trajectory: RunOrRows, rank: int, *, seed: int = 0) -> TemporalSVD:
    """Basis of a run: exact up to ``EXACT_WORK``, else streamed with the defaults.

    Raises:
        RepresentationError: as ``TemporalSVD.fit``.
    """
    return fit_shared([trajectory], rank, seed=seed)


def fit_shared(trajectories: Sequence[RunOrRows], rank: int, *, seed: int = 0) -> TemporalSVD:
    """One basis for several runs: of their snapshots one below the other.

    Expect it to fail on other runs. Each run begins at its own initialisation and goes its own
    way, so that the directions of some runs hold hardly more of another's movement than random
    ones. It is here to show that, and for runs that do share a beginning.

    Signs are settled by the first tenth of every run; ``transform`` scales all runs alike.

    Raises:
        RepresentationError: as ``TemporalSVD.fit``, or the runs have different policies.
    """
    stack = Stack(trajectories)
    small, large = sorted(stack.shape)
    if small**2 * large <= EXACT_WORK:
        return _exact(stack, rank)
    return _streamed(stack, rank, oversampling=32, power_iterations=2, seed=seed)


def _exact(stack: Stack, rank: int) -> TemporalSVD:
    _check_sides(stack, rank)
    weights = stack.read().astype(np.float64)
    left, values, right = np.linalg.svd(weights, full_matrices=False)
    check_rank(values, rank, _rounding(stack), stack.where)
    signs = signs_of(left[stack.early(), :rank])
    return TemporalSVD(
        components=right[:rank] * signs[:, None],
        singular_values=values[:rank],
        total_energy=float(np.sum(values**2)),
    )


def _streamed(
    stack: Stack, rank: int, oversampling: int, power_iterations: int, seed: int
) -> TemporalSVD:
    _check_sides(stack, rank)
    found = leading(
        stack, rank, oversampling=oversampling, power_iterations=power_iterations, seed=seed
    )
    check_rank(found.singular_values, rank, _rounding(stack), stack.where)
    signs = signs_of(found.left[stack.early()])
    return TemporalSVD(
        components=found.components * signs[:, None],
        singular_values=found.singular_values,
        total_energy=found.energy,
    )


def signs_of(early: Float[np.ndarray, "row rank"]) -> Float[np.ndarray, " rank"]:
    """1 or -1 for each column of U, so that its sum over these rows is positive."""
    return np.where(early.sum(0) < 0, -1.0, 1.0)


def check_rank(
    values: Float[np.ndarray, " value"], rank: int, tolerance: float, where: object
) -> None:
    """Refuse directions along which the weights do not move: their coefficients would be noise.

    Args:
        values: singular values, falling, as many as the rank or more.
        rank: directions asked for.
        tolerance: share of the first singular value that may be rounding.
        where: what the weights are of.

    Raises:
        RepresentationError: the weights have a lower rank.
    """
    moving = int(np.sum(values > tolerance * values[0]))
    if rank > moving:
        raise RepresentationError(
            "the rank is above that of the weights",
            expected=f"at most {moving}: along more directions they do not move",
            got=rank,
            where=where,
            do="choose a smaller rank",
        )


def _rounding(stack: Stack) -> float:
    """Share of the first singular value that is rounding in float64; numpy's rule for ranks."""
    return max(stack.shape) * float(np.finfo(np.float64).eps)


def _check_sides(stack: Stack, rank: int) -> None:
    if not 1 <= rank <= min(stack.shape):
        raise RepresentationError(
            "the rank does not fit the weights",
            expected=f"1 to {min(stack.shape)}, the smaller side of {stack.shape}",
            got=rank,
            where=stack.where,
            do="choose a smaller rank, or longer runs",
        )
