"""TIPL: policy weights as trajectory modelling. A consumer of ``weighttraj`` data sets.

After "Can We Optimize Deep RL Policy Weights as Trajectory Modeling?" (Tang, 2025,
arXiv:2503.04074). Needs the extra ``tipl``.
"""

from weighttraj.errors import missing_extra

try:
    import jinja2 as _jinja2
    import matplotlib as _matplotlib
    import safetensors as _safetensors
    import torch as _torch
except ModuleNotFoundError as error:
    raise missing_extra(str(error.name), "tipl") from error

from tipl.baselines import Persistence, Reconstruction, fit_ladder, save_ladder
from tipl.checks import Checks, check
from tipl.evaluation import EvaluateConfig, evaluate
from tipl.forecast import TIPL, Forecaster
from tipl.representation import TemporalSVD
from tipl.train import TrainConfig, train
from tipl.zoo import load, push

__all__ = [
    "TIPL",
    "Checks",
    "EvaluateConfig",
    "Forecaster",
    "Persistence",
    "Reconstruction",
    "TemporalSVD",
    "TrainConfig",
    "check",
    "evaluate",
    "fit_ladder",
    "load",
    "push",
    "save_ladder",
    "train",
]

del _jinja2, _matplotlib, _safetensors, _torch
