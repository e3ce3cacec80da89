"""The ladder of baselines: what a model must beat, from a copy to small networks.

| name | what it does |
|---|---|
| ``persistence`` | copies the last weights: the zero of skill |
| ``last-step`` | repeats the last step |
| ``trend-5``, ``-20``, ``-50``, ``-200`` | goes on along a line through the last snapshots |
| ``ema-0.9``, ``-0.95``, ``-0.98`` | repeats a mean of steps |
| ``dmd`` | a linear operator on the last steps, of low rank |
| ``last-step-shrunk``, ``ema-...-shrunk`` | the same times a fitted factor for each horizon |
| ``ar-20``, ``ar-20-phase`` | regression on 20 steps; by part of the PPO iteration |
| ``ar-20-svd`` | the same, seen through an SVD of the past |
| ``cmd`` | the same, seen through correlation modes |
| ``lfd-2`` | regression on the first and last weights of a window |
| ``wnn``, ``nino-mlp`` | small networks that see one parameter at a time |

``Reconstruction`` is no forecast: it is the floor under models that predict coefficients.
"""

from __future__ import annotations

from tipl.baselines.endpoints import EndPoints
from tipl.baselines.floor import Reconstruction
from tipl.baselines.horizons import HORIZONS
from tipl.baselines.ladder import by_name, fit_ladder, names, save_ladder
from tipl.baselines.modes import ModeSteps
from tipl.baselines.naive import Extrapolation, Persistence
from tipl.baselines.networks import TrainingConfig
from tipl.baselines.nowcasters import WNN, NinoMLP
from tipl.baselines.regression import Regression
from tipl.baselines.steps import Ema, Slope, Steps
from tipl.baselines.subspace import DMD, ProjectedSteps
from tipl.forecast import Forecaster

KINDS: dict[str, type[Forecaster]] = {
    "persistence": Persistence,
    "extrapolation": Extrapolation,
    "dmd": DMD,
    "regression": Regression,
    "wnn": WNN,
    "nino-mlp": NinoMLP,
    "reconstruction": Reconstruction,
}
"""The class of each ``kind`` that config.json of a saved baseline may name."""


__all__ = [
    "DMD",
    "HORIZONS",
    "KINDS",
    "WNN",
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
    "TrainingConfig",
    "by_name",
    "fit_ladder",
    "names",
    "save_ladder",
]
