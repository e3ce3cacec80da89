"""Policy weight trajectories as data: collect, store, load.

Importing this package loads neither torch nor a reinforcement learning library. The parts that
need them, ``weighttraj.collect``, ``weighttraj.policies`` and ``weighttraj.load``, are loaded when
they are first named.
"""

from __future__ import annotations

import importlib
from types import ModuleType

from weighttraj.format import (
    Dataset,
    ParamLayout,
    Run,
    RunInfo,
    RunWriter,
    open_dataset,
    open_run,
    verify,
)

__version__ = "0.1.0"

open = open_dataset

__all__ = [
    "Dataset",
    "ParamLayout",
    "Run",
    "RunInfo",
    "RunWriter",
    "collect",
    "load",
    "open",
    "open_dataset",
    "open_run",
    "policies",
    "verify",
]

_ROOMS = ("collect", "load", "policies")


def __getattr__(name: str) -> ModuleType:
    if name in _ROOMS:
        return importlib.import_module(f"weighttraj.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
