"""The baselines: what a model must beat, from persistence to small networks.

| name | what it does |
|---|---|
| ``persistence`` | repeats the last weights: the zero of skill |
| ``last-step`` | repeats the last step |
| ``trend-5``, ``-20``, ``-50``, ``-200`` | goes on along a line through the last snapshots |
| ``ema-0.9``, ``-0.95``, ``-0.98`` | repeats a mean of steps |
| ``last-iteration`` | repeats the change of the last PPO iteration |
| ``lines-50`` | a line for each weight, where a line fits (Linearity) |
| ``relex-50`` | one direction for each tensor, and a line along it (RELEX) |
| ``pptb-4`` | the last iteration's change along the leading directions of the path (PPTB) |
| ``dmd`` | a linear operator on the last steps, of low rank |
| ``last-step-shrunk``, ``ema-...-shrunk`` | the same times a fitted factor for each horizon |
| ``ar-20``, ``ar-20-phase`` | regression on 20 steps; by part of the PPO iteration |
| ``ar-20-svd`` | the same, seen through an SVD of the past |
| ``cmd`` | the same, seen through correlation modes |
| ``lfd-2`` | regression on the first and last weights of a window |
| ``wnn``, ``nino-mlp`` | small networks that see one parameter at a time |

``Reconstruction`` is no forecast: it is the oracle that bounds models that predict coefficients.
"""

from __future__ import annotations

from tipl.horizons import HORIZONS
from tipl.models.baselines.features import Ema, EndPoints, Slope, Steps
from tipl.models.baselines.modes import ModeSteps
from tipl.models.baselines.naive import Extrapolation, Persistence
from tipl.models.baselines.nowcasters import WNN, NinoMLP
from tipl.models.baselines.reconstruction import Reconstruction
from tipl.models.baselines.regression import Regression
from tipl.models.baselines.subspace import DMD, ProjectedSteps
from tipl.models.baselines.train import (
    BaselinesConfig,
    fit_baselines,
    save_baselines,
    train_baselines,
)

__all__ = [
    "DMD",
    "HORIZONS",
    "WNN",
    "BaselinesConfig",
    "Ema",
    "EndPoints",
    "Extrapolation",
    "ModeSteps",
    "NinoMLP",
    "Persistence",
    "ProjectedSteps",
    "Reconstruction",
    "Regression",
    "Slope",
    "Steps",
    "fit_baselines",
    "save_baselines",
    "train_baselines",
]
