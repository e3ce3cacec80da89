"""TIPL as a forecaster: it feeds each predicted token back as the next one.

It is marked *not causal*: the basis of each run is fitted to the whole run, its future included,
as in the paper. The Transformer itself sees the past only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from tipl.errors import ModelError
from tipl.forecaster import Forecaster, check_cadence, check_request
from tipl.models.baselines.reconstruction import Reconstruction
from tipl.models.tipl.data import history
from tipl.models.tipl.network import GPT, GPTConfig
from tipl.representation import embed
from tipl.saved import SavedNetwork
from weighttraj import Run


@dataclass(frozen=True, kw_only=True)
class TIPLConfig:
    """What a saved TIPL says of itself."""

    gpt: GPTConfig
    """Sizes of the network."""
    every: int | None
    """Number of gradient steps from one snapshot to the next in the training runs."""
    parameters: int | None = None
    """Number of parameters of a policy in the training runs; unset: not recorded."""


@dataclass(frozen=True, eq=False)
class TIPL(SavedNetwork[GPT, TIPLConfig]):
    """The trained Transformer as a forecaster."""

    name: str = "tipl"
    kind = "tipl"
    causal = False
    config_type = TIPLConfig

    @classmethod
    def build(cls, config: TIPLConfig) -> GPT:
        """Return an untrained network."""
        return GPT(config.gpt)

    @property
    def oracles(self) -> tuple[Forecaster, ...]:
        """Return the bound of every model in a basis of this rank, to be evaluated beside it."""
        return (Reconstruction(self.config.gpt.rank),)

    def document(self) -> dict[str, Any]:
        """Return what config.json says; ``residual`` is left out where it is not used."""
        sizes = asdict(self.config)
        if not self.config.gpt.residual:
            del sizes["gpt"]["residual"]
        return {**sizes, "kind": self.kind}

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return forecasts; each prediction is fed back as the next token."""
        check_request(run, starts, horizons)
        self._check(run, max(starts) + max(horizons))
        embedded = embed(run, self.config.gpt.rank)
        rolled = self.roll_out(embedded.coefficients, np.asarray(starts), max(horizons))
        chosen = rolled[:, np.asarray(horizons) - 1]
        return embedded.svd.inverse_transform(chosen).astype(np.float32)

    @torch.no_grad()
    def roll_out(
        self,
        coefficients: Float[np.ndarray, "time rank"],
        starts: Int[np.ndarray, " start"],
        steps: int,
    ) -> Float[np.ndarray, "start step rank"]:
        """Return ``steps`` further rows of coefficients after each start."""
        self.network.eval()
        device = self.network.input_mean.device
        tokens, index = history(coefficients, starts, self.config.gpt.block_size)
        tokens, index = tokens.to(device), index.to(device)
        predicted: list[Tensor] = []
        for _ in range(steps):
            following = self.network(tokens, index.clamp(min=0), index >= 0)[:, -1:]
            predicted.append(following)
            tokens = torch.cat([tokens[:, 1:], following], dim=1)
            index = index + 1
        return torch.cat(predicted, dim=1).cpu().numpy()

    def _check(self, run: Run, last: int) -> None:
        check_cadence(run, self.config.every)
        if self.config.parameters not in (None, run.layout.size):
            raise ModelError(
                "the model was trained on policies of another structure",
                expected=f"policies of {self.config.parameters:,} parameters",
                got=f"{run.layout.size:,}",
                where=run.path,
                do="train a model on such runs, or use one that serves policies of any size: "
                "tipl-gate",
            )
        if last > self.config.gpt.max_timestep:
            raise ModelError(
                "the run is longer than the runs that the model was trained on, and time is an "
                "absolute index to it",
                expected=f"forecasts up to snapshot {self.config.gpt.max_timestep}",
                got=last,
                where=run.path,
                do="train on longer runs, or forecast earlier starts",
            )
