"""Scaled forecasts: the displacement of another forecaster, times a factor for each horizon.

Scaled along tipl-gate, the model is called tipl-drift. ``forecaster`` is the model; ``train``
chooses the factors, by the returns of forecast policies on validation runs.
"""

from tipl.models.scaled.forecaster import Scaled, ScaledGate
from tipl.models.scaled.train import ScaledTrainConfig, train_scaled

__all__ = ["Scaled", "ScaledGate", "ScaledTrainConfig", "train_scaled"]
