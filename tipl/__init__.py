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
    from tipl.checks.measures import check as check
    from tipl.checks.results import Checks as Checks
    from tipl.evaluation.config import EvaluateConfig as EvaluateConfig
    from tipl.forecaster import Forecaster as Forecaster
    from tipl.models.baselines import Persistence as Persistence
    from tipl.models.baselines import Reconstruction as Reconstruction
    from tipl.models.baselines import fit_baselines as fit_baselines
    from tipl.models.baselines import save_baselines as save_baselines
    from tipl.models.tipl import TIPL as TIPL
    from tipl.models.tipl import GPTConfig as GPTConfig
    from tipl.models.tipl import TrainConfig as TrainConfig
    from tipl.models.tipl import train as train
    from tipl.registry import Kind as Kind
    from tipl.registry import load as load
    from tipl.registry import register as register
    from tipl.report.page import evaluate as evaluate
    from tipl.representation import TemporalSVD as TemporalSVD
    from tipl.training import LoopConfig as LoopConfig
    from tipl.training import change as change
    from tipl.zoo.remote import push as push

_HOMES = {
    "tipl.checks.measures": ("check",),
    "tipl.checks.results": ("Checks",),
    "tipl.evaluation.config": ("EvaluateConfig",),
    "tipl.forecaster": ("Forecaster",),
    "tipl.models.baselines": ("Persistence", "Reconstruction", "fit_baselines", "save_baselines"),
    "tipl.models.tipl": ("TIPL", "GPTConfig", "TrainConfig", "train"),
    "tipl.registry": ("Kind", "load", "register"),
    "tipl.report.page": ("evaluate",),
    "tipl.representation": ("TemporalSVD",),
    "tipl.training": ("LoopConfig", "change"),
    "tipl.zoo.remote": ("push",),
}
"""The public names that each module has."""

__all__ = sorted(name for names in _HOMES.values() for name in names)


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(home), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _check_extra() -> None:
    """Refuse to be imported without the extra ``tipl``; nothing of it is imported here."""
    from weighttraj.errors import needs

    for part in ("torch", "jinja2", "matplotlib", "safetensors", "threadpoolctl"):
        with needs("tipl"):
            if find_spec(part) is None:
                raise ModuleNotFoundError(name=part)


_check_extra()
