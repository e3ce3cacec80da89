"""Policy weight trajectories as data: collect, store, load.

Importing this package loads neither torch nor a reinforcement learning library. The parts that
need them, ``weighttraj.collect``, ``weighttraj.policies`` and ``weighttraj.load``, are loaded when
they are first named.
"""

from __future__ import annotations

import importlib
from typing import Any

from weighttraj.format import (
    Dataset,
    Evaluation,
    ParamLayout,
    Run,
    RunInfo,
    RunWriter,
    export_npy,
    export_safetensors,
    lint,
    open_dataset,
    open_run,
    pack,
    repair,
    seal,
    store_returns,
    unseal,
    verify,
)
from weighttraj.remote import Place

__version__ = "0.1.0"

open = open_dataset

__all__ = [
    "Dataset",
    "Evaluation",
    "ParamLayout",
    "Place",
    "Run",
    "RunInfo",
    "RunWriter",
    "collect",
    "download",
    "export_hdf5",
    "export_npy",
    "export_safetensors",
    "import_hdf5",
    "lint",
    "load",
    "load_dataset",
    "open",
    "open_dataset",
    "open_run",
    "pack",
    "policies",
    "publish",
    "registry",
    "repair",
    "seal",
    "store_returns",
    "unseal",
    "upload",
    "verify",
]

_ROOMS = ("collect", "load", "policies", "publish", "registry")
_REGISTRY = ("download", "load_dataset", "upload")
_HDF5 = ("export_hdf5", "import_hdf5")


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"weighttraj.{name}")
    if name in _REGISTRY:
        return getattr(importlib.import_module("weighttraj.registry"), name)
    if name in _HDF5:
        return getattr(importlib.import_module("weighttraj.format.hdf5"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
