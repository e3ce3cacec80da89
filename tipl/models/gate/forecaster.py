"""The trained network as a forecaster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from tipl.forecaster import check_cadence, check_request
from tipl.horizons import rows_of
from tipl.models.gate.adam import AdamReader
from tipl.models.gate.features import Features, features, pieces
from tipl.models.gate.history import histories
from tipl.models.gate.network import GateConfig, GateNetwork
from tipl.saved import ModelConfig, SavedNetwork
from tipl.structure import Clock, Structure
from tipl.threads import threads
from weighttraj import Run

SMALL = 1024
"""Number of parameters up to which all tensors go through the network at once: a forecast of 122
parameters then takes half the time, one of 668 parameters 0.7 of it."""


@dataclass(frozen=True, kw_only=True)
class GateModelConfig(ModelConfig[GateConfig]):
    """What a saved tipl-gate says of itself."""


@dataclass(frozen=True, eq=False)
class Gate(SavedNetwork[GateNetwork, GateModelConfig]):
    """tipl-gate: phi_t and a mixture of linear filters on each parameter's own past.

    One file serves policies of any size. A forecast from t has seen phi_0, ..., phi_t, the phase
    and the learning rate of each, and nothing else.
    """

    name: str = "tipl-gate"
    kind = "gate"
    config_type = GateModelConfig

    @classmethod
    def build(cls, config: GateModelConfig) -> GateNetwork:
        """Return an untrained network."""
        return GateNetwork(config.network)

    def document(self) -> dict[str, Any]:
        """Return what config.json says; settings that are rarely used are left out."""
        found = super().document()
        for name in ("without", "adam"):
            if not found["network"][name]:
                del found["network"][name]
        return found

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t and what the network adds to it."""
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        for place, weights, moved in self.moves(run, starts, horizons):
            out[place] = weights + moved
        return out

    def moves(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Iterator[tuple[int, Float32[np.ndarray, " param"], Float32[np.ndarray, "horizon param"]]]:
        """Yield the forecast in parts: the place of each start, phi_t, and what is added to it."""
        check_request(run, starts, horizons)
        sizes = self.config.network
        rows = rows_of(sizes.horizons, horizons, self.name)
        structure, clock = Structure.of(run.layout), Clock.of(run)
        check_cadence(run, self.config.every, sizes.phases)
        adam = AdamReader(run, max(starts)) if sizes.adam else None
        self.network.eval()
        with threads():
            for place, history in histories(run, starts, sizes.lags, sizes.betas):
                with torch.inference_mode():
                    now = adam.at(history.t) if adam else None
                    seen = features(history, structure, clock, sizes, now)
                    moved = self.displacements(seen, structure, rows)
                yield place, history.weights.numpy(), moved.numpy()

    def displacements(
        self, seen: Features, structure: Structure, rows: list[int]
    ) -> Float[Tensor, "horizon param"]:
        """Return what is added to the weights; ``rows`` are places of horizons in the network."""
        if len(structure.tensor) <= SMALL:  # all tensors at once: fewer calls of torch
            inputs, basis = seen.of()
            moved: Tensor = self.network(inputs.T, seen.contexts, basis.T, structure.tensor)
            return moved.T[rows]
        parts = []
        for number, part in enumerate(structure.slices):
            for some in pieces(part):
                inputs, basis = seen.of(some)
                parts.append(self.network.of_one_tensor(inputs, seen.contexts[number], basis, rows))
        return torch.cat(parts, dim=1)
