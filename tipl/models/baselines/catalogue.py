"""Features by kind, as saved forecasters name them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from tipl.models.baselines.features import Ema, EndPoints, Features, Slope, Steps
from tipl.models.baselines.modes import ModeSteps
from tipl.models.baselines.published import LastIteration, LeadingDirections, Lines, Relex
from tipl.models.baselines.subspace import ProjectedSteps
from tipl.saved import broken

KINDS: dict[str, type[Features]] = {
    cls.kind: cls
    for cls in (
        Steps,
        Slope,
        Ema,
        LastIteration,
        Lines,
        Relex,
        LeadingDirections,
        ProjectedSteps,
        ModeSteps,
        EndPoints,
    )
}


def features_of(settings: Mapping[str, Any], path: str | Path) -> Features:
    """Return the features that ``Features.settings`` describes; ``path`` is where they were saved.

    Raises:
        ModelError: there are no such features.
    """
    fields = dict(settings)
    kind = fields.pop("kind", None)
    if kind not in KINDS:
        raise broken(path, f"features of kind {kind!r}; there are {sorted(KINDS)}")
    try:
        return msgspec.convert(fields, KINDS[kind])
    except msgspec.ValidationError as error:
        raise broken(path, error) from error
