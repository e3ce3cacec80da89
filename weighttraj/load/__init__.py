"""Stored trajectories as PyTorch data sets. Needs torch, which comes with the extra ``sb3``."""

from weighttraj.errors import CacheError, LoaderError, needs

with needs("sb3"):
    import torch as _torch

from weighttraj.load.cache import CachedWeights, cache_folder, cache_size, clear_cache
from weighttraj.load.loader import LoaderState, ResumableLoader
from weighttraj.load.windows import Batch, Item, SnapshotDataset, WindowDataset

__all__ = [
    "Batch",
    "CacheError",
    "CachedWeights",
    "Item",
    "LoaderError",
    "LoaderState",
    "ResumableLoader",
    "SnapshotDataset",
    "WindowDataset",
    "cache_folder",
    "cache_size",
    "clear_cache",
]

del _torch
