"""Forecasts in few directions of the observed past: a causal SVD, and DMD."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float32, Float64

from tipl.forecaster import check_request
from tipl.models.baselines.data import Trajectory, renewal
from tipl.models.baselines.features import Features, Inputs, last_steps
from tipl.runs import Rows
from tipl.saved import SavedSettings
from weighttraj import Run

MAX_ROWS = 256
"""Snapshots, evenly spaced, that stand for a longer past."""


def prefix_basis(
    weights: Rows, last: int, rank: int, scale: Float64[np.ndarray, " param"]
) -> Float64[np.ndarray, "direction param"]:
    """Return the orthonormal directions along which a run moved most up to a snapshot.

    These are the first right singular vectors of scale * (phi_s - phi_last), s = 0, ..., last;
    fewer than the rank if the run moved in fewer.
    """
    rows = np.unique(np.linspace(0, last, min(last + 1, MAX_ROWS)).round().astype(int))
    moved = np.asarray(weights[rows], np.float64)
    moved = (moved - moved[-1]) * scale
    # The matrix (snapshot, snapshot) of products is small, however many parameters there are.
    squared, left = np.linalg.eigh(moved @ moved.T)
    kept = squared[::-1][:rank] > 1e-10 * max(squared[-1], np.finfo(float).tiny)
    squared, left = squared[::-1][:rank][kept], left[:, ::-1][:, :rank][:, kept]
    return np.asarray((left / np.sqrt(squared)).T @ moved)


@dataclass(frozen=True)
class ProjectedSteps(Features):
    """The last steps, projected onto a basis of the past at the last ``renewal``.

    A model that works on coefficients of a causal SVD sees the same.
    """

    lags: int = 20
    """Number of steps."""
    rank: int = 32
    """Number of directions of the basis: as many as TIPL has coefficients."""
    kind = "projected-steps"

    @property
    def name(self) -> str:
        """``ar-20-svd``, for example."""
        return f"ar-{self.lags}-svd"

    @property
    def size(self) -> int:
        """Number of features."""
        return self.lags

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the features of each start."""
        found, scale = -1, np.sqrt(trajectory.importance)
        basis = np.zeros((0, len(scale)))
        for place, window in trajectory.windows(starts, self.lags):
            if (newest := renewal(starts[place])) != found:
                found = newest
                basis = prefix_basis(trajectory.weights, newest, self.rank, scale)
            steps = last_steps(window, self.lags) * scale
            yield place, window[-1], (steps @ basis.T) @ basis / scale


@dataclass(frozen=True)
class DMD(SavedSettings):
    """Dynamic mode decomposition of the last steps: d_{t+1} = A d_t with A of low rank.

    After Schmid, "Dynamic mode decomposition of numerical and experimental data" (J. Fluid Mech.
    656, 2010). A is the least-squares operator on the first singular directions of the window, and
    the forecast adds up A d_t, A^2 d_t, .... Eigenvalues outside the unit disc are moved to its
    edge: without that the error at h = 50 is 1e58 times that of persistence.

    Ours: steps instead of weights, so that a straight line is a fixed point and the origin does
    not matter; 50 steps, rank 2, which loses least on some validation runs of InvertedPendulum
    (skill 0.00, -0.01, -0.04 at h = 1, 5, 10; rank 5: -0.06, -0.05, -0.14; weights instead of
    steps, rank 5: -0.13, -0.26, -0.50). The null test passes although nothing is fitted: the steps
    of a random walk in 122 dimensions are nearly orthogonal, so A is nearly 0.
    """

    window: int = 50
    """Number of steps that the operator is fitted to."""
    rank: int = 2
    """Number of directions."""
    kind = "dmd"
    name = "dmd"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t + A d_t + ... + A^h d_t."""
        check_request(run, starts, horizons)
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        for place, window in Trajectory.of(run).windows(starts, self.window):
            steps = np.diff(window, axis=0)
            out[place] = window[-1] + self._combination(steps @ steps.T, horizons) @ steps
        return out

    def _combination(
        self, products: Float64[np.ndarray, "step step"], horizons: Sequence[int]
    ) -> Float64[np.ndarray, "horizon step"]:
        """Return the displacement at each horizon as a combination of the window's steps."""
        n = len(products) - 1
        combination = np.zeros((len(horizons), n + 1))
        if n < 1 or products[-1, -1] == 0:
            return combination
        # X = U S V^T holds all steps but the last as columns; A maps it to all steps but the first.
        squared, right = np.linalg.eigh(products[:-1, :-1])
        squared, right = squared[::-1][: self.rank], right[:, ::-1][:, : self.rank]
        kept = squared > 1e-12 * max(squared[0], np.finfo(float).tiny)
        back = right[:, kept] / np.sqrt(squared[kept])  # U = X back
        values, vectors = np.linalg.eig(back.T @ products[:-1, 1:] @ back)
        values = values.astype(complex) / np.maximum(1, np.abs(values))
        now = np.linalg.lstsq(vectors, (back.T @ products[:-1, -1]).astype(complex), rcond=None)[0]
        modes = _sums(values, horizons) * now  # (horizon, mode)
        combination[:, :-1] = (modes @ vectors.T).real @ back.T
        return combination


def _sums(
    values: Complex[np.ndarray, " mode"], horizons: Sequence[int]
) -> Complex[np.ndarray, "horizon mode"]:
    """Return x + x^2 + ... + x^h of each eigenvalue."""
    powers = values[None] ** np.arange(1, max(horizons) + 1)[:, None]
    return np.asarray(powers.cumsum(0)[np.asarray(horizons) - 1])
