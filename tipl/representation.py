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


@dataclass(frozen=True, kw_only=True)
class TemporalSVD:
    """A rank-d basis of one run's weights.

    >>> rng = np.random.default_rng(0)
    >>> weights = rng.normal(size=(50, 3)) @ rng.normal(size=(3, 10))
    >>> svd = TemporalSVD.fit(weights, rank=3)
    >>> bool(np.allclose(svd.inverse_transform(svd.transform(weights)), weights))
    True
    """

    components: Float[np.ndarray, "rank param"]
    """Rows of V^T: orthonormal directions in weight space."""
    singular_values: Float[np.ndarray, " rank"]
    """Diagonal of S, falling."""
    total_energy: float
    """Squared Frobenius norm of the weights: the sum of *all* squared singular values."""

    @classmethod
    def fit(cls, weights: Float[np.ndarray, "time param"], rank: int) -> TemporalSVD:
        """Basis of a trajectory.

        Signs are arbitrary in an SVD. Here each column of U has a positive sum over the first
        tenth of the run, so that columns of different runs are alike.

        Raises:
            RepresentationError: the rank is not between 1 and the smaller side, or the weights
                are not finite.
        """
        if not 1 <= rank <= min(weights.shape):
            raise RepresentationError(
                "the rank does not fit the weights",
                expected=f"1 to {min(weights.shape)}, the smaller side of {weights.shape}",
                got=rank,
                do="choose a smaller rank, or longer runs",
            )
        if not np.isfinite(weights).all():
            raise RepresentationError(
                "the weights are not finite", do="leave the run out; `weighttraj verify` names it"
            )
        exact = np.asarray(weights, np.float64)
        u, s, vt = np.linalg.svd(exact, full_matrices=False)
        early = u[: max(1, len(u) // 10), :rank].sum(0)
        signs = np.where(early < 0, -1.0, 1.0)
        return cls(
            components=vt[:rank] * signs[:, None],
            singular_values=s[:rank],
            total_energy=float(np.sum(s**2)),
        )

    @property
    def rank(self) -> int:
        """Number of directions d."""
        return len(self.singular_values)

    def transform(
        self, weights: Float[np.ndarray, "*batch param"]
    ) -> Float[np.ndarray, "*batch rank"]:
        """Coefficients u = phi V / S: rows of U for the weights of the fit."""
        scale = np.maximum(self.singular_values, np.finfo(np.float64).tiny)
        return np.asarray(weights @ self.components.T / scale)

    def inverse_transform(
        self, coefficients: Float[np.ndarray, "*batch rank"]
    ) -> Float[np.ndarray, "*batch param"]:
        """Weights phi~ = u S V^T."""
        return np.asarray((coefficients * self.singular_values) @ self.components)

    @property
    def information(self) -> Float[np.ndarray, " rank"]:
        """Share of the squared norm of the weights in the first 1, 2, ..., d directions."""
        return np.cumsum(self.singular_values**2) / self.total_energy

    def reconstruction_error(self, weights: Float[np.ndarray, "time param"]) -> float:
        """Mean squared error of the weights after a round trip through d coefficients."""
        back = self.inverse_transform(self.transform(weights))
        return float(np.mean((back - weights) ** 2))
