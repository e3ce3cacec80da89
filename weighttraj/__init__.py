"""Policy weight trajectories as data: collect, store, load.

Importing this package imports none of its parts: each is imported when it is first named. Reading
data needs neither torch nor a reinforcement learning library; ``weighttraj.collect``,
``weighttraj.policies`` and ``weighttraj.load`` do.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from weighttraj.dataset import Dataset
    from weighttraj.format import Evaluation, ParamLayout, RunInfo
    from weighttraj.opening import open_dataset, open_run
    from weighttraj.opening import open_dataset as open
    from weighttraj.remote import Place
    from weighttraj.run import Run
    from weighttraj.tools.export import export_npy, export_safetensors
    from weighttraj.tools.hdf5 import export_hdf5, import_hdf5
    from weighttraj.tools.lint import lint
    from weighttraj.tools.pack import pack
    from weighttraj.tools.repair import repair, seal, unseal
    from weighttraj.tools.returns import store_returns
    from weighttraj.tools.verify import verify
    from weighttraj.writer import RunWriter

__version__ = "0.2.0"

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
_HOMES = {
    "weighttraj.dataset": ("Dataset",),
    "weighttraj.format": ("Evaluation", "ParamLayout", "RunInfo"),
    "weighttraj.opening": ("open_dataset", "open_run"),
    "weighttraj.registry": ("download", "load_dataset", "upload"),
    "weighttraj.remote": ("Place",),
    "weighttraj.run": ("Run",),
    "weighttraj.tools.export": ("export_npy", "export_safetensors"),
    "weighttraj.tools.hdf5": ("export_hdf5", "import_hdf5"),
    "weighttraj.tools.lint": ("lint",),
    "weighttraj.tools.pack": ("pack",),
    "weighttraj.tools.repair": ("repair", "seal", "unseal"),
    "weighttraj.tools.returns": ("store_returns",),
    "weighttraj.tools.verify": ("verify",),
    "weighttraj.writer": ("RunWriter",),
}
"""The public names that each module has."""


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return importlib.import_module(f"weighttraj.{name}")
    wanted = "open_dataset" if name == "open" else name
    for home, names in _HOMES.items():
        if wanted in names:
            return getattr(importlib.import_module(home), wanted)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
