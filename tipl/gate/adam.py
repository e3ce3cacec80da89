"""What the optimizer knows beside the weights: Adam's moments, of runs that store them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tipl.baselines.trajectory import Reader
from tipl.errors import ModelError
from weighttraj import Run


@dataclass(frozen=True, kw_only=True)
class Adam:
    """At one snapshot."""

    direction: Float[Tensor, " param"]
    """Where the next update goes if the gradient is its own average, in learning rates:
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
            Reader(run[f"optimizer/{name}"], last) for name in ("exp_avg", "exp_avg_sq")
        ]

    def at(self, t: int) -> Adam:
        """At a snapshot; before the first gradient step all is 0."""
        n = int(self._steps[t])
        mean, square = (
            torch.from_numpy(reader.rows(t, t + 1)[0]) / (1 - beta**n if n > 0 else 1)
            for reader, beta in zip(self._moments, self._betas, strict=True)
        )
        gradient = square.sqrt()
        direction = -mean / (gradient + self._eps)
        return Adam(direction=direction.float(), gradient=gradient.float())


__all__ = ["Adam", "AdamReader"]
