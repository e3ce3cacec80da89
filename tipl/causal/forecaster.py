"""The trained network as a forecaster."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from safetensors.torch import save_file

from tipl.baselines.files import ARRAYS, load_network, read_config, write
from tipl.baselines.horizons import rows_of
from tipl.causal.view import SCALE_STEPS, bases_of, local_scale, view
from tipl.errors import RepresentationError
from tipl.forecast import Pushed, check_cadence, check_request
from tipl.models.causal import CausalConfig, CausalGPT
from tipl.structure import Clock
from tipl.threads import threads
from weighttraj import Run


@dataclass(frozen=True, kw_only=True)
class CausalModelConfig:
    """What a saved one says of itself."""

    network: CausalConfig
    """Sizes of the network."""
    every: int | None
    """Gradient steps from one snapshot to the next in the training runs."""


@dataclass(frozen=True, eq=False)
class Causal(Pushed):
    """tipl-causal: phi_t and a displacement within the directions of the path up to t.

    Before the path has as many directions as the basis, and where it rests, it is persistence. Its
    error is at least the part of the true displacement that leaves the path's directions.
    """

    network: CausalGPT
    """The network."""
    config: CausalModelConfig
    """Its sizes, and the cadence that it is for."""
    name: str = "tipl-causal"
    """Name in tables and figures: of the folder that it was loaded from."""
    kind = "causal"
    causal = True

    @torch.no_grad()
    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """phi_t and what the network adds to it.

        Raises:
            ForecastError: it was not trained for such a horizon.
            ModelError: the run has another cadence, or longer iterations.
        """
        check_request(run, starts, horizons)
        sizes = self.config.network
        places = rows_of(sizes.horizons, horizons, self.name)
        clock = Clock.of(run)
        check_cadence(run, self.config.every, sizes.phases)
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        self.network.eval()
        with threads():
            for place, t in enumerate(starts):
                out[place] = run.weights[t]
                if t < sizes.rank:
                    continue
                bases = bases_of(run, sizes)
                recent = run.weights[max(0, t - SCALE_STEPS) : t + 1].astype(np.float64)
                scale = local_scale(recent)
                try:
                    prefix = bases.tokens(t)
                except RepresentationError:  # too few directions
                    continue
                if scale == 0:
                    continue
                seen = view(prefix, t, scale, clock, sizes)
                moved = self.network(
                    seen.tokens[None], seen.phases[None], seen.mask[None], seen.state[None]
                )[0, places]
                directions = bases.basis(t).components
                out[place] += (moved.numpy() * scale) @ directions
        return out

    def save(self, path: str | Path) -> None:
        """Write config.json and model.safetensors."""
        write(path, {"kind": self.kind, **asdict(self.config)})
        save_file(self.network.state_dict(), Path(path) / ARRAYS)

    @classmethod
    def load(cls, path: str | Path) -> Causal:
        """Read a saved one; every parameter must be there.

        Raises:
            FileNotFoundError: there is no forecaster in the folder.
            ModelError: the files are another's, or damaged.
        """
        config = read_config(path, cls.kind, CausalModelConfig)
        network = load_network(CausalGPT(config.network), path)
        return cls(network, config, Path(path).resolve().name)


__all__ = ["Causal", "CausalModelConfig"]
