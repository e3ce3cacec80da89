"""What a model must beat, and the floor that no model in its basis can pass."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from tipl.forecast import check_request
from tipl.representation import TemporalSVD
from weighttraj import Run


@dataclass(frozen=True)
class Persistence:
    """Copies the last weights: the forecast of phi_{t+h} is phi_t."""

    name = "persistence"
    causal = True

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """phi_t, once a horizon."""
        check_request(run, starts, horizons)
        last = run.weights[np.asarray(starts)]
        return np.repeat(last[:, None], len(horizons), axis=1)

    def save(self, path: str | Path) -> None:
        """Write config.json; there is nothing fitted."""
        Path(path).mkdir(parents=True, exist_ok=True)
        (Path(path) / "config.json").write_text(json.dumps({"kind": self.name}))

    @classmethod
    def load(cls, path: str | Path) -> Persistence:
        """A new one."""
        return cls()


@dataclass(frozen=True)
class Reconstruction:
    """The truth, phi_{t+h}, after a round trip through d coefficients. No forecast: a floor.

    A model that predicts coefficients in the basis of the whole run cannot do better than this.
    """

    rank: int
    """Rank of the basis."""
    causal = False
    floor = True

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        return f"reconstruction-{self.rank}"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """phi_{t+h} projected to the first d directions of the run."""
        check_request(run, starts, horizons)
        weights = run.weights[:]
        svd = TemporalSVD.fit(weights, self.rank)
        later = np.asarray(starts)[:, None] + np.asarray(horizons)
        return svd.inverse_transform(svd.transform(weights[later])).astype(np.float32)

    def save(self, path: str | Path) -> None:
        """Write config.json."""
        Path(path).mkdir(parents=True, exist_ok=True)
        (Path(path) / "config.json").write_text(
            json.dumps({"kind": "reconstruction", "rank": self.rank})
        )

    @classmethod
    def load(cls, path: str | Path) -> Reconstruction:
        """Read the rank."""
        return cls(json.loads((Path(path) / "config.json").read_text())["rank"])
