"""Linear regression from features of the past to displacements, shared by all parameters.

``phi_{t+h} - phi_t = sum_k c_{hk} x_k``: each horizon has its own coefficients, fitted directly by
least squares; with ``by_phase`` also each part of the PPO iteration. The same coefficients serve
every parameter, so a fit on a policy of 122 forecasts one of 71,948.

Starts are not weighted. Steps shrink up to 400 times over a run, so the first 20 of 1,950 starts
have 30 % of the sums; and as much in the skill, which is a ratio of sums. On validation runs of
InvertedPendulum, AR(20) by phase, skill at h = 1, 5, 10, 50 (behind the slash the mean of the
starts' own skills): 0.41/0.36, 0.31/0.18, 0.23/0.05, 0.11/-0.02. With starts divided by their mean
squared step: 0.33/0.39, 0.28/0.19, 0.21/0.09, 0.09/0.03, which is better start by start and worse
in the sum; the same for the last step and for AR(20). We fit what is evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from tipl.errors import ForecastError, TrainError
from tipl.forecaster import Forecaster, check_request
from tipl.horizons import HORIZONS, fitted, rows_of
from tipl.models.baselines.catalogue import features_of
from tipl.models.baselines.data import Trajectory, samples, thinned
from tipl.models.baselines.features import Features
from tipl.saved import read_arrays, read_config, write
from weighttraj import Run

MAX_STARTS = 2000
"""Number of starts of a run that a fit looks at."""


@dataclass(frozen=True, kw_only=True)
class _Config:
    features: dict[str, Any]
    horizons: tuple[int, ...]
    phases: tuple[int, ...] | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression(Forecaster):
    """Forecasts by fitted coefficients."""

    features: Features
    """What the regression sees of the past."""
    horizons: tuple[int, ...]
    """Horizons that it was fitted for, rising."""
    phases: tuple[int, ...] | None
    """Parts of the iteration with separate coefficients; None: all have the same."""
    coefficients: Float64[np.ndarray, "phase horizon feature"]
    """c; one phase if all have the same."""
    kind = "regression"

    @property
    def name(self) -> str:
        """Name in tables and figures. The fit of one feature is a factor, which shrinks it."""
        name = self.features.name + ("-shrunk" if self.features.size == 1 else "")
        return name if self.phases is None else f"{name}-phase"

    @classmethod
    def fit(
        cls,
        runs: Sequence[Run],
        features: Features,
        *,
        by_phase: bool = False,
        horizons: Sequence[int] = HORIZONS,
        seed: int = 0,
    ) -> Regression:
        """Fit to runs, which are read one after another.

        Args:
            runs: training runs.
            features: what the regression sees of the past.
            by_phase: fit separate coefficients for each part of the iteration.
            horizons: numbers of snapshots ahead.
            seed: seed of the sample of parameters and starts of large runs.

        Raises:
            TrainError: the runs are too short.
        """
        fitting = RegressionFit(features, by_phase=by_phase, horizons=horizons, seed=seed)
        for _, trajectory in samples(runs, seed):
            fitting.add(trajectory)
        return fitting.finish()

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t + c x."""
        check_request(run, starts, horizons)
        rows = rows_of(self.horizons, horizons, self.name)
        trajectory = Trajectory.of(run)
        groups = self._groups(trajectory, starts, run)
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        for place, last, features in self.features(trajectory, starts):
            out[place] = last + self.coefficients[groups[place]][rows] @ features
        return out

    def _groups(self, trajectory: Trajectory, starts: Sequence[int], run: Run) -> list[int]:
        """Return which coefficients each start takes; phi_0 has no phase, and features of 0."""
        if self.phases is None:
            return [0] * len(starts)
        phases = trajectory.phase[np.asarray(starts)].tolist()
        pairs = [(t, phase) for t, phase in zip(starts, phases, strict=True) if t > 0]
        if unknown := sorted({phase for _, phase in pairs} - set(self.phases)):
            raise ForecastError(
                "the forecaster was not fitted for this part of an iteration",
                expected=f"phases {list(self.phases)}",
                got=f"phases {unknown}",
                where=run.path,
                do="fit it on runs of the same cadence",
            )
        known = {phase: place for place, phase in enumerate(self.phases)}
        return [known.get(phase, 0) for phase in phases]

    def save(self, path: str | Path) -> None:
        """Write config.json and model.safetensors."""
        config = {
            "kind": self.kind,
            "features": self.features.settings(),
            "horizons": self.horizons,
            "phases": self.phases,
        }
        write(path, config, {"coefficients": self.coefficients})

    @classmethod
    def load(cls, path: str | Path) -> Regression:
        """Read a saved one."""
        config = read_config(path, cls.kind, _Config)
        features = features_of(config.features, path)
        groups = 1 if config.phases is None else len(config.phases)
        shape = (groups, len(config.horizons), features.size)
        arrays = read_arrays(path, {"coefficients": shape})
        return cls(features=features, horizons=config.horizons, phases=config.phases, **arrays)


class RegressionFit:
    """A fit that takes one run after the other and only keeps sums of products.

    The arguments are those of ``Regression.fit``.
    """

    def __init__(
        self,
        features: Features,
        *,
        by_phase: bool = False,
        horizons: Sequence[int] = HORIZONS,
        seed: int = 0,
    ) -> None:
        self._features, self._by_phase = features, by_phase
        self._horizons = fitted(horizons)
        self._rng = np.random.default_rng(seed)
        self._sums: dict[int, _Sums] = {}

    def add(self, trajectory: Trajectory) -> None:
        """Add the sums of one run."""
        first = int(self._by_phase)  # phi_0 has no phase
        starts, counts = thinned(len(trajectory) - first - self._horizons[0], MAX_STARTS, self._rng)
        starts = starts + first
        if not len(starts):
            return
        phases = trajectory.phase[starts] if self._by_phase else np.zeros(len(starts), int)
        ahead = np.asarray(self._horizons)
        for place, last, features in self._features(trajectory, starts.tolist()):
            later = ahead[: np.searchsorted(ahead, len(trajectory) - starts[place])]
            moved = trajectory.weights[starts[place] + later] - last
            sums = self._sums.setdefault(
                int(phases[place]), _Sums.zero(len(ahead), self._features.size)
            )
            sums.add(features, moved, trajectory.importance * counts[place])

    def finish(self) -> Regression:
        """Return the regression.

        Raises:
            TrainError: no run was long enough.
        """
        phases = tuple(sorted(self._sums))
        counts = np.array([self._sums[phase].count for phase in phases])
        if not counts.size or not counts.all():
            raise TrainError(
                "the runs are too short to fit each horizon",
                expected=f"runs of more than {max(self._horizons) + 5} snapshots",
                got=f"starts for each phase and horizon: {counts.tolist()}",
                do="fit fewer horizons, or collect longer runs",
            )
        return Regression(
            features=self._features,
            horizons=self._horizons,
            phases=phases if self._by_phase else None,
            coefficients=np.stack([self._sums[phase].solve() for phase in phases]),
        )


@dataclass(frozen=True)
class _Sums:
    """Normal equations of one phase, for each horizon: left @ c = right."""

    left: Float64[np.ndarray, "horizon feature feature"]
    right: Float64[np.ndarray, "horizon feature"]
    count: np.ndarray

    @classmethod
    def zero(cls, horizons: int, size: int) -> _Sums:
        shape = (horizons, size)
        return cls(np.zeros((*shape, size)), np.zeros(shape), np.zeros(horizons, int))

    def add(
        self,
        features: Float64[np.ndarray, "feature param"],
        moved: Float64[np.ndarray, "some param"],
        weight: Float64[np.ndarray, " param"],
    ) -> None:
        """Add one start; later horizons may be missing."""
        n, weighted = len(moved), features * weight
        self.left[:n] += weighted @ features.T
        self.right[:n] += moved @ weighted.T
        self.count[:n] += 1

    def solve(self) -> Float64[np.ndarray, "horizon feature"]:
        pairs = zip(self.left, self.right, strict=True)
        return np.stack([np.linalg.lstsq(a, b, rcond=1e-12)[0] for a, b in pairs])
