"""Errors of this package; the same family and form as ``weighttraj.errors``."""

from __future__ import annotations

from weighttraj.errors import WeightTrajError


class RepresentationError(WeightTrajError, ValueError):
    """Weights that cannot be represented as asked."""


class ModelError(WeightTrajError, ValueError):
    """A model that cannot be loaded, or does not fit the data."""


class ForecastError(WeightTrajError, ValueError):
    """Starts or horizons that a run does not have."""


class TrainError(WeightTrajError, ValueError):
    """A training that cannot be started or continued."""


class EvaluateError(WeightTrajError, ValueError):
    """An evaluation that cannot be made."""


class LeftOutWarning(UserWarning):
    """A run was left out of a training or an evaluation; the message says which, and why."""
