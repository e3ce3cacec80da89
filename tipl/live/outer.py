"""Outer steps: what to compare a forecast with, from the displacements of the last iterations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from tipl.forecaster import Forecaster, check_request
from tipl.runs import weights_of
from weighttraj import Run

_ITERATIONS = 20
"""Number of iterations that are averaged at most."""


@dataclass(frozen=True)
class IterationAverage(Forecaster):
    """Goes on along an exponential moving average of the displacements of whole iterations.

    With ``beta = 0`` this is the last iteration's displacement, and a jump of one iteration after
    each iteration is the outer step of Nichol et al. (arXiv:1803.02999) and of outer-PPO, with
    sigma = 1 + amplitude. With ``beta > 0`` it is an outer step with momentum.
    """

    beta: float = 0.5
    """Decay of the average from one iteration to the one before."""

    @property
    def name(self) -> str:
        """``iteration-average`` and the decay."""
        return f"iteration-average-{self.beta:g}"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t + h v_t, with v_t the average over the number of snapshots an iteration."""
        check_request(run, starts, horizons)
        weights, phase = weights_of(run), run.phase
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        for place, t in enumerate(starts):
            n = max(1, int(phase[: t + 1].max()) + 1)
            rows = weights[max(0, t - n * _ITERATIONS) : t + 1][::-1][::n].astype(np.float64)
            velocity = np.zeros(run.layout.size)
            if len(rows) > 1:
                shares = self.beta ** np.arange(len(rows) - 1)
                velocity = (shares / shares.sum()) @ (rows[:-1] - rows[1:]) / n
            out[place] = weights[t] + np.multiply.outer(np.asarray(horizons, float), velocity)
        return out
