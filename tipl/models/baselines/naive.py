"""Baselines that need no fit: persistence, and a straight line from the last weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from tipl.forecaster import Forecaster, check_request
from tipl.models.baselines.catalogue import features_of
from tipl.models.baselines.data import Trajectory
from tipl.models.baselines.features import Ema, Features, Slope, Steps
from tipl.models.baselines.published import LastIteration, LeadingDirections, Lines, Relex
from tipl.models.baselines.subspace import DMD
from tipl.runs import weights_of
from tipl.saved import SavedSettings, broken, read_config, write
from weighttraj import Run


@dataclass(frozen=True)
class Persistence(SavedSettings):
    """Persistence: the forecast of phi_{t+h} is phi_t."""

    name = "persistence"
    kind = "persistence"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t for each horizon."""
        check_request(run, starts, horizons)
        last = weights_of(run)[np.asarray(starts)]
        return np.repeat(last[:, None], len(horizons), axis=1)


@dataclass(frozen=True, kw_only=True)
class _Config:
    velocity: dict[str, Any]


@dataclass(frozen=True)
class Extrapolation(Forecaster):
    """Goes on along a straight line: the forecast of phi_{t+h} is phi_t + h v_t.

    ``v_t`` is one step: the last one, the slope of a line through the last snapshots, or a mean of
    steps. A run on a straight line is forecast exactly. The null test fails: on a random walk every
    straight line is worse than persistence.
    """

    velocity: Features
    """What v_t is; one feature."""
    kind = "extrapolation"

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        return self.velocity.name

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t + h v_t."""
        check_request(run, starts, horizons)
        times = np.asarray(horizons, np.float64)[:, None]
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        for place, last, (velocity,) in self.velocity(Trajectory.of(run), starts):
            out[place] = last + times * velocity
        return out

    def save(self, path: str | Path) -> None:
        """Write config.json; there is nothing fitted."""
        write(path, {"kind": self.kind, "velocity": self.velocity.settings()})

    @classmethod
    def load(cls, path: str | Path) -> Extrapolation:
        """Read what v_t is."""
        config = read_config(path, cls.kind, _Config)
        velocity = features_of(config.velocity, path)
        if velocity.size != 1:
            raise broken(path, f"a velocity of {velocity.size:.3g} features, not of 1")
        return cls(velocity)


BETAS = (0.9, 0.95, 0.98)
"""Decays of the moving averages of steps."""
UNFITTED: tuple[Forecaster, ...] = (
    Persistence(),
    Extrapolation(Steps(1)),
    *(Extrapolation(Slope(window)) for window in (5, 20, 50, 200)),
    *(Extrapolation(Ema(beta)) for beta in BETAS),
    DMD(),
    *map(Extrapolation, (LastIteration(), Lines(), Relex(), LeadingDirections())),
)
"""All baselines that need no fit, in the order of tables."""
