"""What lies on disk. ``FORMAT.md`` beside this file is the specification."""

from weighttraj.format.layout import ParamLayout, ParamSpec
from weighttraj.format.schema import (
    FORMAT_VERSION,
    Algorithm,
    Cadence,
    Continuation,
    DatasetInfo,
    EnvInfo,
    Evaluation,
    ObsNorm,
    PolicySpec,
    Provenance,
    RunEntry,
    RunInfo,
)

__all__ = [
    "FORMAT_VERSION",
    "Algorithm",
    "Cadence",
    "Continuation",
    "DatasetInfo",
    "EnvInfo",
    "Evaluation",
    "ObsNorm",
    "ParamLayout",
    "ParamSpec",
    "PolicySpec",
    "Provenance",
    "RunEntry",
    "RunInfo",
]
