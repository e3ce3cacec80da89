"""The trained network as a forecaster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32

from tipl.errors import RepresentationError
from tipl.forecaster import check_cadence, check_request
from tipl.horizons import rows_of
from tipl.models.causal.data import bases_of, local_scale, unit_rows, view
from tipl.models.causal.network import CausalConfig, CausalGPT
from tipl.runs import weights_of
from tipl.saved import ModelConfig, SavedNetwork
from tipl.structure import Clock
from tipl.threads import threads
from weighttraj import Run


@dataclass(frozen=True, kw_only=True)
class CausalModelConfig(ModelConfig[CausalConfig]):
    """What a saved tipl-causal says of itself."""


@dataclass(frozen=True, eq=False)
class Causal(SavedNetwork[CausalGPT, CausalModelConfig]):
    """tipl-causal: phi_t and a displacement within the directions of the path up to t.

    Before the path has as many directions as the basis, and where the run has stopped moving, it
    falls back to persistence. Its error is at least the part of the true displacement that leaves
    the path's directions.
    """

    name: str = "tipl-causal"
    kind = "causal"
    config_type = CausalModelConfig

    @classmethod
    def build(cls, config: CausalModelConfig) -> CausalGPT:
        """Return an untrained network."""
        return CausalGPT(config.network)

    def document(self) -> dict[str, Any]:
        """Return what config.json says; the default ``unit`` is left out."""
        document = super().document()
        if self.config.network.unit == "recent":
            del document["network"]["unit"]
        return document

    @torch.no_grad()
    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t and what the network adds to it."""
        check_request(run, starts, horizons)
        sizes, weights = self.config.network, weights_of(run)
        places = rows_of(sizes.horizons, horizons, self.name)
        check_cadence(run, self.config.every, sizes.phases)
        clock = Clock.of(run)
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        self.network.eval()
        with threads():
            for place, t in enumerate(starts):
                out[place] = weights[t]
                moved = self._displacement(run, t, clock)
                if moved is not None:
                    out[place] += moved[places]
        return out

    def _displacement(
        self, run: Run, t: int, clock: Clock
    ) -> Float[np.ndarray, "horizon param"] | None:
        """Return the displacement from a start at each horizon; None: there is no basis yet."""
        sizes = self.config.network
        if t < sizes.rank:
            return None
        scale = local_scale(weights_of(run)[unit_rows(t, sizes)].astype(np.float64))
        if scale == 0:
            return None
        bases = bases_of(run, sizes)
        try:
            prefix = bases.tokens(t)
        except RepresentationError:  # too few directions
            return None
        seen = view(prefix, t, scale, clock, sizes)
        names = ("tokens", "phases", "mask", "state")
        moved = self.network(*(seen[name][None] for name in names))[0]  # (horizon, rank)
        return np.asarray((moved.numpy() * scale) @ bases.basis(t).components)
