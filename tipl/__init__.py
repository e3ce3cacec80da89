"""TIPL: policy weights as trajectory modelling. A consumer of ``weighttraj`` data sets.

After "Can We Optimize Deep RL Policy Weights as Trajectory Modeling?" (Tang, 2025,
arXiv:2503.04074). Needs the extra ``tipl``. Importing this package imports none of its parts: each
is imported when it is first named.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tipl.checks.measures import check
    from tipl.checks.results import Checks
    from tipl.evaluation.config import EvaluateConfig
    from tipl.forecaster import Forecaster
    from tipl.models.baselines import (
        Persistence,
        Reconstruction,
        fit_baselines,
        save_baselines,
    )
    from tipl.models.tipl import TIPL, GPTConfig, TrainConfig, train
    from tipl.registry import Kind, load, register
    from tipl.report.page import evaluate
    from tipl.representation import TemporalSVD
    from tipl.training import LoopConfig, change
    from tipl.zoo.remote import push

_PLACES = {
    "Checks": "tipl.checks.results",
    "EvaluateConfig": "tipl.evaluation.config",
    "Forecaster": "tipl.forecaster",
    "GPTConfig": "tipl.models.tipl",
    "Kind": "tipl.registry",
    "LoopConfig": "tipl.training",
    "Persistence": "tipl.models.baselines",
    "Reconstruction": "tipl.models.baselines",
    "TIPL": "tipl.models.tipl",
    "TemporalSVD": "tipl.representation",
    "TrainConfig": "tipl.models.tipl",
    "change": "tipl.training",
    "check": "tipl.checks.measures",
    "evaluate": "tipl.report.page",
    "fit_baselines": "tipl.models.baselines",
    "load": "tipl.registry",
    "push": "tipl.zoo.remote",
    "register": "tipl.registry",
    "save_baselines": "tipl.models.baselines",
    "train": "tipl.models.tipl",
}
"""Module of each public name."""

__all__ = [
    "TIPL",
    "Checks",
    "EvaluateConfig",
    "Forecaster",
    "GPTConfig",
    "Kind",
    "LoopConfig",
    "Persistence",
    "Reconstruction",
    "TemporalSVD",
    "TrainConfig",
    "change",
    "check",
    "evaluate",
    "fit_baselines",
    "load",
    "push",
    "register",
    "save_baselines",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _check_extra() -> None:
    """Refuse to be imported without the extra ``tipl``; nothing of it is imported here."""
    for part in ("torch", "jinja2", "matplotlib", "safetensors", "threadpoolctl"):
        try:
            found = find_spec(part) is not None
        except ModuleNotFoundError:
            found = False
        if not found:
            from weighttraj.errors import missing_extra

            raise missing_extra(part, "tipl")


_check_extra()
