"""The baselines that need no fit, in the order of tables."""

from __future__ import annotations

from tipl.forecaster import Forecaster
from tipl.models.baselines.naive import Extrapolation, Persistence
from tipl.models.baselines.steps import Ema, Slope, Steps
from tipl.models.baselines.subspace import DMD

BETAS = (0.9, 0.95, 0.98)
"""Decays of the moving averages of steps."""
UNFITTED: tuple[Forecaster, ...] = (
    Persistence(),
    Extrapolation(Steps(1)),
    *(Extrapolation(Slope(window)) for window in (5, 20, 50, 200)),
    *(Extrapolation(Ema(beta)) for beta in BETAS),
    DMD(),
)
"""All of them."""
