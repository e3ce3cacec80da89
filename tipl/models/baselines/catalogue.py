"""Features by kind, as saved forecasters name them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from tipl.models.baselines.endpoints import EndPoints
from tipl.models.baselines.features import Features
from tipl.models.baselines.modes import ModeSteps
from tipl.models.baselines.steps import Ema, Slope, Steps
from tipl.models.baselines.subspace import ProjectedSteps

FEATURES: dict[str, type[Features]] = {
    "steps": Steps,
    "slope": Slope,
    "ema": Ema,
    "projected-steps": ProjectedSteps,
    "mode-steps": ModeSteps,
    "end-points": EndPoints,
}


def features_of(settings: Mapping[str, Any]) -> Features:
    """Features as ``Features.settings`` describes them.

    Raises:
        ValueError: there are no such features.
    """
    fields = dict(settings)
    kind = fields.pop("kind", None)
    if kind not in FEATURES:
        raise ValueError(f"features of kind {kind!r}; there are {sorted(FEATURES)}")
    return msgspec.convert(fields, FEATURES[kind])
