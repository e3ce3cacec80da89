"""tipl-drift: the direction of tipl-gate, as far as it serves the return.

``forecaster`` is the model, and the same with the directions of any other forecaster; ``train``
chooses how far, by the returns of forecast policies on validation runs.
"""

from tipl.drift.forecaster import Drift, Further
from tipl.drift.train import DriftConfig, train_drift

__all__ = ["Drift", "DriftConfig", "Further", "train_drift"]
