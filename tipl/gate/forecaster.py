"""The trained network as a forecaster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from safetensors.torch import save_file
from torch import Tensor

from tipl.baselines.files import ARRAYS, load_network, read_config, write
from tipl.baselines.horizons import rows_of
from tipl.forecast import Pushed, check_cadence, check_request
from tipl.gate.adam import AdamReader
from tipl.gate.features import Features, features, pieces
from tipl.gate.history import histories
from tipl.models.gate import GateConfig, GateNetwork
from tipl.structure import Clock, Structure
from tipl.threads import threads
from weighttraj import Run


@dataclass(frozen=True, kw_only=True)
class GateModelConfig:
    """What a saved one says of itself."""

    network: GateConfig
    """Sizes of the network."""
    every: int | None
    """Gradient steps from one snapshot to the next in the training runs."""

    def told(self) -> dict[str, Any]:
        """What is written: nothing of what most networks have not."""
        found = asdict(self)
        for name in ("without", "adam"):
            if not getattr(self.network, name):
                del found["network"][name]
        return found


@dataclass(frozen=True, eq=False)
class Gate(Pushed):
    """tipl-gate: phi_t and a mixture of linear filters on each parameter's own past.

    One file serves policies of any size. A forecast from t has seen phi_0, ..., phi_t, the phase
    and the learning rate of each, and nothing else.
    """

    network: GateNetwork
    """The network."""
    config: GateModelConfig
    """Its sizes, and the cadence that it is for."""
    name: str = "tipl-gate"
    """Name in tables and figures: of the folder that it was loaded from."""
    kind = "gate"
    causal = True

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """phi_t and what the network adds to it.

        Raises:
            ForecastError: it was not trained for such a horizon.
            ModelError: the run has another cadence, or longer iterations.
        """
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        for place, weights, moved in self.moves(run, starts, horizons):
            out[place] = weights + moved
        return out

    def moves(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Iterator[tuple[int, Float32[np.ndarray, " param"], Float32[np.ndarray, "horizon param"]]]:
        """The forecast in parts: for each start its place among them, phi_t, and what is added.

        Raises:
            ForecastError: it was not trained for such a horizon.
            ModelError: the run has another cadence, or longer iterations.
        """
        check_request(run, starts, horizons)
        sizes = self.config.network
        rows = rows_of(sizes.horizons, horizons, self.name)
        structure, clock = Structure.of(run.layout), Clock.of(run)
        check_cadence(run, self.config.every, sizes.phases)
        adam = AdamReader(run, max(starts)) if sizes.adam else None
        self.network.eval()
        with threads():
            for place, history in histories(run, starts, sizes.lags, sizes.betas):
                with torch.no_grad():
                    now = adam.at(history.t) if adam else None
                    seen = features(history, structure, clock, sizes, now)
                    moved = self.displacements(seen, structure, rows)
                yield place, history.weights.numpy(), moved.numpy()

    def displacements(
        self, seen: Features, structure: Structure, rows: list[int]
    ) -> Float[Tensor, "horizon param"]:
        """What is added to the weights.

        Args:
            seen: at the start.
            structure: of the policy.
            rows: places of the wanted horizons among those of the network.
        """
        parts = []
        for number, part in enumerate(structure.slices):
            for some in pieces(part):
                inputs, basis = seen.of(some)
                parts.append(self.network.of_one_tensor(inputs, seen.contexts[number], basis, rows))
        return torch.cat(parts, dim=1)

    def save(self, path: str | Path) -> None:
        """Write config.json and model.safetensors."""
        write(path, {"kind": self.kind, **self.config.told()})
        save_file(self.network.state_dict(), Path(path) / ARRAYS)

    @classmethod
    def load(cls, path: str | Path) -> Gate:
        """Read a saved one; every parameter must be there.

        Raises:
            FileNotFoundError: there is no forecaster in the folder.
            ModelError: the files are another's, or damaged.
        """
        config = read_config(path, cls.kind, GateModelConfig)
        network = load_network(GateNetwork(config.network), path)
        return cls(network, config, Path(path).resolve().name)


__all__ = ["Gate", "GateModelConfig"]
