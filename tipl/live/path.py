"""The path of a training so far, and forecasts from it.

The forecaster sees a continuous path: every jump is subtracted from the weights that follow it, so
that what it forecasts is how training itself goes on.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64

from tipl.errors import ForecastError
from tipl.forecaster import Forecaster, check_forecaster
from tipl.growing import GrowingRun
from tipl.live.config import Jump, JumpConfig, known_every, known_horizons
from tipl.registry import load
from weighttraj import ParamLayout, RunInfo
from weighttraj.collect.undisturbed import undisturbed
from weighttraj.format.schema import Cadence

EVERY = 64
"""Number of gradient steps between snapshots for forecasters of any cadence."""


def forecaster_of(forecaster: str | Path | Forecaster) -> Forecaster:
    """Return a forecaster by its name, folder, address or class; no random number is drawn.

    Raises:
        ForecastError: it is none, or it needs the future of the run.
    """
    if isinstance(forecaster, str | Path):
        with undisturbed():
            forecaster = load(forecaster)
    check_forecaster(forecaster)
    if not forecaster.causal or forecaster.is_oracle:
        raise ForecastError(
            "the forecaster looks at what comes after the start, which no training has",
            expected="a causal forecaster",
            got=forecaster.name,
            do="choose another one, such as tipl-gate",
        )
    return forecaster


class TrainingPath:
    """The path of one training, and forecasts from its end.

    Args:
        forecaster: a causal forecaster.
        config: when and how far the training jumps.
        layout: order of the parameters.
        weights: policy weights before training.
        every: number of gradient steps between snapshots for forecasters of any cadence.
    """

    def __init__(
        self,
        forecaster: Forecaster,
        config: JumpConfig,
        layout: ParamLayout,
        weights: Float32[np.ndarray, " param"],
        every: int = EVERY,
    ) -> None:
        self.jumps: list[Jump] = []
        """What was done so far."""
        self.seconds = 0.0
        """CPU time of forecasts and of keeping the path."""
        self._forecaster, self._config = forecaster, config
        self._every = config.every or known_every(forecaster) or every
        self._known = known_horizons(forecaster)
        info = RunInfo(run_id="live", layout=layout, cadence=Cadence(every=self._every))
        self._run = GrowingRun(info)
        self._moves = _moving(layout, config)
        self._offset: Float64[np.ndarray, " param"] | None = None
        self._step = self._step_before = self._last_start = 0
        self._before = np.array(weights)
        self._append(weights, 0, 0, -1, float("nan"))

    def check_iteration(self, gradient_steps: int) -> None:
        """Refuse a training some of whose iterations would add no snapshot to the path.

        Args:
            gradient_steps: number of gradient steps of an iteration.

        Raises:
            ForecastError: an iteration has fewer of them than there are between two snapshots.
        """
        if gradient_steps < self._every:
            raise ForecastError(
                "an iteration has too few gradient steps to forecast after each",
                expected=f"at least {self._every}, as from one snapshot of {self._forecaster.name} "
                "to the next",
                got=gradient_steps,
                do="set JumpConfig(every=...) for a forecaster of any cadence, take more samples "
                "or epochs in an iteration, or choose a forecaster of this cadence",
            )

    def end_gradient_step(self) -> bool:
        """Count a gradient step; return whether a snapshot is due."""
        self._step += 1
        return self._step % self._every == 0

    def append(
        self,
        weights: Float32[np.ndarray, " param"],
        iteration: int,
        num_timesteps: int,
        learning_rate: float,
    ) -> None:
        """Add a snapshot, after ``end_gradient_step`` said that it is due."""
        begun = time.process_time()
        phase = (self._step - self._step_before - 1) // self._every
        self._append(weights, iteration, num_timesteps, phase, learning_rate)
        self.seconds += time.process_time() - begun

    def end_iteration(self, weights: Float32[np.ndarray, " param"]) -> None:
        """Note that the next gradient step begins an iteration.

        Args:
            weights: policy weights now.
        """
        self._step_before, self._before = self._step, np.array(weights)

    def propose(
        self,
        weights: Float32[np.ndarray, " param"],
        iteration: int,
        num_timesteps: int,
        remaining: float,
    ) -> tuple[Jump, Float32[np.ndarray, " param"]] | None:
        """Return the jump after an iteration and the weights after it; None: there is none.

        Args:
            weights: policy weights now, at the end of the iteration.
            iteration: counted from 1.
            num_timesteps: environment steps so far.
            remaining: share of the training that is still to come.
        """
        begun = time.process_time()
        own = weights - self._before
        self.end_iteration(weights)
        horizon = None
        if self._config.is_due(iteration) and remaining > 0:
            horizon = self._config.horizon_at(iteration, remaining, self._known)
        found = None if horizon is None else self._displacement(horizon, remaining)
        self.seconds += time.process_time() - begun
        if found is None or horizon is None:
            return None
        size, norm = float(np.linalg.norm(found)), float(np.linalg.norm(own))
        jump = Jump(
            iteration=iteration,
            num_timesteps=num_timesteps,
            horizon=horizon,
            size=size,
            relative_size=size / norm if norm else 0.0,
        )
        return jump, (weights + found).astype(np.float32)

    def moved(
        self, before: Float32[np.ndarray, " param"], after: Float32[np.ndarray, " param"]
    ) -> None:
        """Leave a change of the weights that was no training out of the path.

        Such changes come at iteration boundaries only.
        """
        change = after.astype(np.float64) - before
        self._offset = change if self._offset is None else self._offset + change
        self.end_iteration(after)

    def _displacement(self, horizon: int, remaining: float) -> Float32[np.ndarray, " param"] | None:
        """Return how far the policy is to move.

        None: not at all, the forecast is not finite, or no snapshot came since the last forecast.
        """
        t = len(self._run) - 1
        if t == self._last_start:  # an update that ended early added no snapshot
            return None
        self._last_start = t
        forecast = self._forecaster.forecast(self._run, [t], [horizon])
        if np.shape(forecast) != (1, 1, self._run.layout.size):
            raise ForecastError(
                "a forecast has another shape than asked for",
                expected=f"(start, horizon, param) = (1, 1, {self._run.layout.size})",
                got=np.shape(forecast),
                where=self._forecaster.name,
                do="correct the forecaster: see tipl.Forecaster.forecast",
            )
        moved = (forecast[0, 0] - self._run.rows[t]) * self._moves
        moved *= np.float32(self._config.amplitude_at(remaining))
        return moved if np.isfinite(moved).all() and moved.any() else None

    def _append(
        self,
        weights: Float32[np.ndarray, " param"],
        iteration: int,
        num_timesteps: int,
        phase: int,
        learning_rate: float,
    ) -> None:
        if self._offset is not None:
            weights = (weights - self._offset).astype(np.float32)
        self._run.append(
            weights,
            num_timesteps=num_timesteps,
            iteration=iteration,
            gradient_step=self._step,
            phase=phase,
            learning_rate=learning_rate,
        )


def _moving(layout: ParamLayout, config: JumpConfig) -> Bool[np.ndarray, " param"]:
    """Return which parameters a jump moves."""
    moves = np.ones(layout.size, bool)
    for param in layout.params:
        if param.role == "log_std" and not config.log_std:
            moves[param.slice] = False
    return moves
