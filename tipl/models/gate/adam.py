"""Adam's moments, of runs that store them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from tipl.errors import ModelError
from weighttraj import Run

MAX_BYTES = 2**25
"""Bytes of the rows that are read at once."""


@dataclass(frozen=True, kw_only=True)
class Adam:
    """What Adam's moments say at one snapshot."""

    direction: Float[Tensor, " param"]
    """Next update if the gradient is its own average, in units of the learning rate:
    ``-m / (sqrt(v) + eps)``, both moments bias-corrected (Kingma and Ba, 2015, algorithm 1)."""
    gradient: Float[Tensor, " param"]
    """Root of the mean squared gradient, ``sqrt(v)``."""


class AdamReader:
    """Reads the moments of a run.

    Args:
        run: the run.
        last: the last snapshot that may be read.

    Raises:
        ModelError: it stores none.
    """

    def __init__(self, run: Run, last: int) -> None:
        if not run.info.optimizer_moments:
            raise ModelError(
                "the run does not store Adam's moments, and this network sees them",
                expected="arrays optimizer/exp_avg and optimizer/exp_avg_sq",
                got=f"run {run.id} without",
                where=run.path,
                do="collect with optimizer_moments = true under [store] of the recipe, or take a "
                "network that was trained without --adam",
            )
        told = run.info.algorithm.hyperparameters if run.info.algorithm else {}
        settings = told.get("optimizer", {})
        self._betas = settings.get("betas", (0.9, 0.999))
        self._eps = settings.get("eps", 1e-8)
        self._steps = run["index/gradient_step"][:]
        self._moments = [
            _ReadAhead(run[f"optimizer/{name}"], last) for name in ("exp_avg", "exp_avg_sq")
        ]

    def at(self, t: int) -> Adam:
        """Return what they say at a snapshot; before the first gradient step all is 0."""
        n = int(self._steps[t])
        mean, square = (
            torch.from_numpy(reader.row(t)) / (1 - beta**n if n > 0 else 1)
            for reader, beta in zip(self._moments, self._betas, strict=True)
        )
        gradient = square.sqrt()
        direction = -mean / (gradient + self._eps)
        return Adam(direction=direction.float(), gradient=gradient.float())


class _ReadAhead:
    """Reads rows of the run in blocks.

    The memory map of ``weighttraj.load`` has weights only. A copy of the moments would take twice
    their space in the cache, few runs store them, and a walk reads each row once, in order.
    """

    def __init__(self, array: Any, last: int) -> None:
        self._array, self._last = array, last
        self._ahead = max(1, MAX_BYTES // (4 * array.shape[1]))
        self._first = 0
        self._block: np.ndarray = np.empty((0, array.shape[1]), np.float32)

    def row(self, t: int) -> Float64[np.ndarray, " param"]:
        if not self._first <= t < self._first + len(self._block):
            self._first = t
            self._block = self._array[t : min(t + 1 + self._ahead, self._last + 1)]
        return np.asarray(self._block[t - self._first], np.float64)
