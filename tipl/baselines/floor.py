"""The floor under every model that predicts coefficients: no forecast, but what a basis loses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from tipl.baselines.files import read_config, write
from tipl.errors import ForecastError
from tipl.forecast import check_request
from tipl.representation import embed
from weighttraj import Run


@dataclass(frozen=True)
class Reconstruction:
    """The truth, phi_{t+h}, after a round trip through d coefficients. No forecast: a floor.

    A model that predicts coefficients in the basis of the whole run cannot do better than this.
    """

    rank: int
    """Rank of the basis."""
    kind = "reconstruction"
    causal = False
    floor = True

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        return f"reconstruction-{self.rank}"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """phi_{t+h} projected to the first d directions of the run.

        Raises:
            ForecastError: the run ends before.
        """
        check_request(run, starts, horizons)
        if max(starts) + max(horizons) >= len(run):
            raise ForecastError(
                "the truth is not known so far ahead",
                expected=f"start and horizon of at most {len(run) - 1} together",
                got=max(starts) + max(horizons),
                where=run.path,
            )
        embedded = embed(run, self.rank)
        later = np.asarray(starts)[:, None] + np.asarray(horizons)
        back = embedded.svd.inverse_transform(embedded.coefficients[later])
        return back.astype(np.float32)

    def save(self, path: str | Path) -> None:
        """Write config.json."""
        write(path, {"kind": self.kind, "rank": self.rank})

    @classmethod
    def load(cls, path: str | Path) -> Reconstruction:
        """Read the rank.

        Raises:
            FileNotFoundError: there is no forecaster in the folder.
            ModelError: the folder holds another one.
        """
        return read_config(path, cls.kind, cls)


__all__ = ["Reconstruction"]
