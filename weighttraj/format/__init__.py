"""What lies on disk. ``FORMAT.md`` beside this file is the specification."""

from weighttraj.format.integrity import verify
from weighttraj.format.layout import ParamLayout, ParamSpec
from weighttraj.format.reader import Dataset, Run, open_dataset, open_run
from weighttraj.format.schema import (
    FORMAT_VERSION,
    Algorithm,
    Cadence,
    DatasetInfo,
    EnvInfo,
    ObsNorm,
    PolicySpec,
    Provenance,
    RunEntry,
    RunInfo,
)
from weighttraj.format.writer import RunWriter

__all__ = [
    "FORMAT_VERSION",
    "Algorithm",
    "Cadence",
    "Dataset",
    "DatasetInfo",
    "EnvInfo",
    "ObsNorm",
    "ParamLayout",
    "ParamSpec",
    "PolicySpec",
    "Provenance",
    "Run",
    "RunEntry",
    "RunInfo",
    "RunWriter",
    "open_dataset",
    "open_run",
    "verify",
]
