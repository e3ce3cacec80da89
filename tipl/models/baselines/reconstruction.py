"""Oracles: no forecasts, but the truth as far as a basis of rank d shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from tipl.errors import ForecastError
from tipl.forecaster import check_request
from tipl.models.baselines.data import Trajectory
from tipl.models.baselines.published import leading
from tipl.representation import embed
from tipl.saved import SavedSettings
from weighttraj import Run


@dataclass(frozen=True)
class Reconstruction(SavedSettings):
    """The truth, phi_{t+h}, after a round trip through d coefficients: an oracle, no forecast.

    A model that predicts coefficients in the basis of the whole run cannot have a smaller error.
    """

    rank: int
    """Rank of the basis."""
    kind = "reconstruction"
    causal = False
    is_oracle = True

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        return f"reconstruction-{self.rank}"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_{t+h} projected onto the first d directions of the run.

        Raises:
            ForecastError: the run ends before.
        """
        check_known(run, starts, horizons)
        embedded = embed(run, self.rank)
        later = np.asarray(starts)[:, None] + np.asarray(horizons)
        back = embedded.svd.inverse_transform(embedded.coefficients[later])
        return back.astype(np.float32)


@dataclass(frozen=True)
class PathOracle(SavedSettings):
    """The true displacement, projected onto the leading directions of the path up to t.

    A model that moves within d directions that the policy has already taken cannot have a smaller
    error, whatever it predicts along them.
    """

    rank: int = 16
    """Number of directions."""
    window: int = 256
    """Largest number of snapshots whose path gives the directions."""
    kind = "path-oracle"
    causal = False
    is_oracle = True

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        return f"path-oracle-{self.rank}"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t and the projected displacement.

        Raises:
            ForecastError: the run ends before.
        """
        check_known(run, starts, horizons)
        trajectory = Trajectory.of(run)
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        for place, path in trajectory.windows(starts, self.window - 1):
            directions = leading(path - path.mean(0), self.rank)  # (direction, param)
            true = trajectory.weights[starts[place] + np.asarray(horizons)] - path[-1]
            out[place] = path[-1] + true @ directions.T @ directions
        return out


def check_known(run: Run, starts: Sequence[int], horizons: Sequence[int]) -> None:
    """Refuse a request for snapshots that the run does not have."""
    check_request(run, starts, horizons)
    if max(starts) + max(horizons) >= len(run):
        raise ForecastError(
            "the run ends before, so the truth is not known",
            expected=f"start and horizon of at most {len(run) - 1} together",
            got=max(starts) + max(horizons),
            where=run.path,
            do="choose earlier starts or shorter horizons",
        )
