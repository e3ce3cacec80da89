"""Policy weight trajectories as data: collect, store, load.

Importing this package imports none of its parts: each is imported when it is first named. Reading
data needs neither torch nor a reinforcement learning library; ``weighttraj.collect``,
``weighttraj.policies`` and ``weighttraj.load`` do.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
    from weighttraj.format import open_dataset as open
    from weighttraj.remote import Place

__version__ = "0.1.0"

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
_ELSEWHERE = {
    "Place": "weighttraj.remote",
    "download": "weighttraj.registry",
    "export_hdf5": "weighttraj.format.hdf5",
    "import_hdf5": "weighttraj.format.hdf5",
    "load_dataset": "weighttraj.registry",
    "upload": "weighttraj.registry",
}
"""Module of each public name that ``weighttraj.format`` does not have."""


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"weighttraj.{name}")
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_ELSEWHERE.get(name, "weighttraj.format"))
    return getattr(module, "open_dataset" if name == "open" else name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
