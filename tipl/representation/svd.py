"""Temporal SVD: the path of a policy in the few directions along which it moves most.

After "The Ladder in Chaos" (Tang et al., NeurIPS 2024), as TIPL uses it (Tang, 2025): the snapshots
of one run are the rows of a matrix, which is not centred, and ``Phi = U S V^T``. A token is a row
of U, cut to the first d columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tipl.errors import RepresentationError
from tipl.representation.randomised import leading
from tipl.representation.rows import RunOrRows, Snapshots
from tipl.runs import while_open
from weighttraj import Run

EXACT_WORK = 10**9
"""Smaller side squared times larger side, up to which ``fit_run`` takes the exact SVD: about a
second of one core. 122 parameters and 1,951 snapshots are 3 % of it."""


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
        """Return the exact basis of a trajectory in memory, computed in float64.

        The signs of an SVD are arbitrary. Here each column of U has a positive sum over the first
        tenth of the run, so that columns of different runs are alike.

        Raises:
            RepresentationError: the rank is not between 1 and the smaller side or is above the
                rank of the weights, or they are not finite.
        """
        return _exact(Snapshots(weights), rank)

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
        """Return the basis of a trajectory of any length, by a randomised SVD (Halko et al., 2011).

        Reads the run ``power_iterations + 1`` times, a piece at a time, and keeps
        ``power_iterations + 3`` times ``(rank + oversampling) * P`` float64 in memory.

        The leading singular values are the most accurate. With the defaults, on random walks and
        on a run of PPO on HalfCheetah, the first 32 of 64 are within 1e-5, the last within 2e-3;
        with one power iteration more, within 1e-9 and 3e-6. Apart from rounding they are never too
        large. The same seed and pieces give the same bits. Signs are as in ``fit``.

        Args:
            trajectory: the run, or a matrix that is read when it is sliced.
            rank: number of directions d.
            oversampling: number of directions beyond the rank that are followed.
            power_iterations: number of passes before the last one.
            seed: seed of the random directions at the start.
            piece: number of snapshots in memory at once; None: about 64 MiB.

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
        snapshots = Snapshots(trajectory, piece)
        return _streamed(snapshots, rank, oversampling, power_iterations, seed)

    @property
    def rank(self) -> int:
        """Number of directions d."""
        return len(self.singular_values)

    def transform(
        self, weights: Float[np.ndarray, "*batch param"]
    ) -> Float[np.ndarray, "*batch rank"]:
        """Return the coefficients u = phi V / S: rows of U for the weights of the fit."""
        return np.asarray(weights @ self.components.T / self.singular_values)

    def inverse_transform(
        self, coefficients: Float[np.ndarray, "*batch rank"]
    ) -> Float[np.ndarray, "*batch param"]:
        """Return the weights phi~ = u S V^T."""
        return np.asarray((coefficients * self.singular_values) @ self.components)

    def coefficients(self, trajectory: RunOrRows) -> Float[np.ndarray, "time rank"]:
        """Return the coefficients of a whole trajectory, which is read a piece at a time."""
        pieces = Snapshots(trajectory).pieces()
        return np.concatenate([self.transform(rows) for _, rows in pieces])

    @property
    def information(self) -> Float[np.ndarray, " rank"]:
        """Share of the squared norm of the weights in the first 1, 2, ..., d directions."""
        return np.cumsum(self.singular_values**2) / self.total_energy

    def reconstruction_error(self, trajectory: RunOrRows) -> float:
        """Return the mean squared error of the weights that d coefficients give back."""
        snapshots, total = Snapshots(trajectory), 0.0
        for _, rows in snapshots.pieces():
            error = self.inverse_transform(self.transform(rows)) - rows
            total += float(np.vdot(error, error))
        return total / (snapshots.shape[0] * snapshots.shape[1])


@dataclass(frozen=True, kw_only=True)
class Embedded:
    """A run in the basis of its whole trajectory."""

    svd: TemporalSVD
    """The basis."""
    coefficients: Float[np.ndarray, "time rank"]
    """Row t stands for phi_t."""


@while_open
def embed(run: Run, rank: int) -> Embedded:
    """Return a run in d coefficients, as the paper represents it.

    The basis of a large run takes tens of seconds and forecasts are asked for some starts at a
    time, so the result is kept as long as the run is open.

    Raises:
        RepresentationError: as ``TemporalSVD.fit``.
    """
    svd = fit_run(run, rank)
    return Embedded(svd=svd, coefficients=svd.coefficients(run))


def fit_run(trajectory: RunOrRows, rank: int, *, seed: int = 0) -> TemporalSVD:
    """Return the basis of a run: exact up to ``EXACT_WORK``, else streamed with the defaults.

    Raises:
        RepresentationError: as ``TemporalSVD.fit``.
    """
    snapshots = Snapshots(trajectory)
    small, large = sorted(snapshots.shape)
    if small**2 * large <= EXACT_WORK:
        return _exact(snapshots, rank)
    return _streamed(snapshots, rank, oversampling=32, power_iterations=2, seed=seed)


def _exact(snapshots: Snapshots, rank: int) -> TemporalSVD:
    _check_sides(snapshots, rank)
    left, values, right = np.linalg.svd(snapshots.read(), full_matrices=False)
    check_rank(values, rank, _rounding(snapshots), snapshots.where)
    return TemporalSVD(
        components=right[:rank] * signs_of(left[:, :rank])[:, None],
        singular_values=values[:rank],
        total_energy=float(np.sum(values**2)),
    )


def _streamed(
    snapshots: Snapshots, rank: int, oversampling: int, power_iterations: int, seed: int
) -> TemporalSVD:
    _check_sides(snapshots, rank)
    found = leading(
        snapshots, rank, oversampling=oversampling, power_iterations=power_iterations, seed=seed
    )
    check_rank(found.singular_values, rank, _rounding(snapshots), snapshots.where)
    return TemporalSVD(
        components=found.components * signs_of(found.left)[:, None],
        singular_values=found.singular_values,
        total_energy=found.energy,
    )


def signs_of(left: Float[np.ndarray, "time rank"]) -> Float[np.ndarray, " rank"]:
    """Return 1 or -1 for each column of U: times it, the first tenth of the column sums above 0."""
    early = left[: max(1, len(left) // 10)]
    return np.where(early.sum(0) < 0, -1.0, 1.0)


def check_rank(
    values: Float[np.ndarray, " value"], rank: int, tolerance: float, where: object
) -> None:
    """Refuse directions along which the weights do not move: their coefficients would be noise.

    Args:
        values: singular values, falling, at least as many as the rank.
        rank: number of directions that were asked for.
        tolerance: share of the first singular value that may be rounding.
        where: what the weights belong to.
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


def _rounding(snapshots: Snapshots) -> float:
    """Return the share of the first singular value that is rounding: numpy's rule for ranks."""
    return max(snapshots.shape) * float(np.finfo(np.float64).eps)


def _check_sides(snapshots: Snapshots, rank: int) -> None:
    if not 1 <= rank <= min(snapshots.shape):
        raise RepresentationError(
            "the rank does not fit the weights",
            expected=f"1 to {min(snapshots.shape)}, the smaller side of {snapshots.shape}",
            got=rank,
            where=snapshots.where,
            do="choose a smaller rank, or longer runs",
        )
