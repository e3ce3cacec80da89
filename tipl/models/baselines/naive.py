"""Forecasts without a fit: persistence, and a straight line from the last weights."""

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
from tipl.models.baselines.features import Features
from tipl.runs import weights_of
from tipl.saved import broken, read_config, read_settings, write
from weighttraj import Run


@dataclass(frozen=True)
class Persistence(Forecaster):
    """Persistence: the forecast of phi_{t+h} is phi_t."""

    name = "persistence"
    kind = "persistence"
    causal = True

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t for each horizon."""
        check_request(run, starts, horizons)
        last = weights_of(run)[np.asarray(starts)]
        return np.repeat(last[:, None], len(horizons), axis=1)

    def save(self, path: str | Path) -> None:
        """Write config.json; there is nothing fitted."""
        write(path, {"kind": self.kind})

    @classmethod
    def load(cls, path: str | Path) -> Persistence:
        """Return a new one, if the folder says so."""
        read_settings(path, cls.kind)
        return cls()


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
    causal = True

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
        """Read what v_t is.

        Raises:
            FileNotFoundError: there is no forecaster in the folder.
            ModelError: the folder holds another one.
        """
        config = read_config(path, cls.kind, _Config)
        try:
            velocity = features_of(config.velocity)
        except ValueError as error:
            raise broken(path, error) from error
        if velocity.size != 1:
            raise broken(path, f"a velocity of {velocity.size:.3g} features, not of 1")
        return cls(velocity)
