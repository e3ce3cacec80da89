"""Stretched forecasts: the displacement of another forecaster, times a factor for each horizon.

Stretched along tipl-gate, the model is called tipl-drift. ``forecaster`` is the model; ``train``
chooses the factors, by the returns of forecast policies on validation runs.
"""

from tipl.models.stretched.forecaster import Stretched, StretchedGate
from tipl.models.stretched.train import StretchedTrainConfig, train_stretched

__all__ = ["Stretched", "StretchedGate", "StretchedTrainConfig", "train_stretched"]
