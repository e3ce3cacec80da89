"""What lies on disk. ``FORMAT.md`` beside this file is the specification."""

from weighttraj.format.export import export_npy, export_safetensors
from weighttraj.format.integrity import repair, seal, unseal, verify
from weighttraj.format.layout import ParamLayout, ParamSpec
from weighttraj.format.lint import lint
from weighttraj.format.packing import pack
from weighttraj.format.reader import Dataset, Run, open_dataset, open_run
from weighttraj.format.returns import store_returns
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
from weighttraj.format.writer import RunWriter

__all__ = [
    "FORMAT_VERSION",
    "Algorithm",
    "Cadence",
    "Continuation",
    "Dataset",
    "DatasetInfo",
    "EnvInfo",
    "Evaluation",
    "ObsNorm",
    "ParamLayout",
    "ParamSpec",
    "PolicySpec",
    "Provenance",
    "Run",
    "RunEntry",
    "RunInfo",
    "RunWriter",
    "export_npy",
    "export_safetensors",
    "lint",
    "open_dataset",
    "open_run",
    "pack",
    "repair",
    "seal",
    "store_returns",
    "unseal",
    "verify",
]
