"""Stored trajectories as PyTorch data sets. Needs torch, which comes with the extra ``sb3``."""

from weighttraj.errors import missing_extra

try:
    import torch as _torch
except ModuleNotFoundError as error:
    raise missing_extra(str(error.name), "sb3") from error

from weighttraj.load.windows import SeededSampler, WindowDataset

__all__ = ["SeededSampler", "WindowDataset"]

del _torch
