"""Stretched forecasts: the displacement of another forecaster, times a factor for each horizon."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from tipl.forecaster import Forecaster, check_request
from tipl.horizons import rows_of
from tipl.models.gate.forecaster import Gate, GateModelConfig
from tipl.models.gate.network import GateConfig
from tipl.registry import load_folder
from tipl.runs import weights_of
from tipl.saved import ModelConfig, arrays_of, broken, load_network, read_config, write
from weighttraj import ParamLayout, Run


@dataclass(frozen=True, kw_only=True)
class StretchedGateConfig(ModelConfig[GateConfig]):
    """What a saved one says of itself."""

    amplitudes: dict[str, float]
    """Factor of the displacement at each horizon. JSON has no numbers as keys."""


@dataclass(frozen=True, eq=False)
class StretchedGate(Forecaster):
    """phi_t + a_h d_h: the displacement d_h that tipl-gate forecasts, a_h times as long.

    A least-squares forecast is short, because it is the mean of the many ways that training may go.
    The return rises along that mean, and further than it reaches. So a_h is chosen by returns, not
    by errors of weights, which get worse. The exploration noise ``log_std`` moves as tipl-gate
    says: a_h is chosen with it held. This model is ours.
    """

    gate: Gate
    """The forecaster whose displacement is stretched."""
    amplitudes: dict[int, float]
    """Factor a_h of each horizon."""
    name: str = "tipl-drift"
    """Name in tables and figures: of the folder that it was loaded from."""
    kind = "drift"

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t and the stretched displacement."""
        rows_of(list(self.amplitudes), horizons, self.name)
        factors = _factors(run.layout, [self.amplitudes[h] for h in horizons])
        out = np.empty((len(starts), *factors.shape), np.float32)
        for place, weights, moved in self.gate.moves(run, starts, horizons):
            out[place] = weights + factors * moved
        return out

    def save(self, path: str | Path) -> None:
        """Write config.json and model.safetensors."""
        amplitudes = {str(h): a for h, a in self.amplitudes.items()}
        config = {**self.gate.document(), "kind": self.kind, "amplitudes": amplitudes}
        write(path, config, arrays_of(self.gate.network))

    @classmethod
    def load(cls, path: str | Path) -> StretchedGate:
        """Read a saved one; every parameter must be there."""
        config = read_config(path, cls.kind, StretchedGateConfig)
        known = {str(h): h for h in config.network.horizons}
        if not config.amplitudes.keys() <= known.keys():
            raise broken(
                path, f"amplitudes of horizons that the network does not forecast: {known}"
            )
        of_gate = GateModelConfig(network=config.network, every=config.every)
        gate = Gate(load_network(lambda: Gate.build(of_gate), of_gate, path), of_gate)
        amplitudes = {known[h]: a for h, a in config.amplitudes.items()}
        return cls(gate, amplitudes, Path(path).resolve().name)


@dataclass(frozen=True, kw_only=True)
class StretchedConfig:
    """What a saved one says of itself; the stretched forecaster is in a folder beside it."""

    amplitudes: dict[str, float]
    """Factor of the displacement at each horizon."""


@dataclass(frozen=True, eq=False)
class Stretched(Forecaster):
    """phi_t and a_h times the displacement of a forecaster other than tipl-gate.

    Between the horizons that amplitudes were chosen for, they are interpolated linearly in log h.
    """

    along: Forecaster
    """The forecaster whose displacement is stretched."""
    amplitudes: dict[int, float]
    """Factor a_h of some horizons."""
    name: str = "further"
    """Name in tables and figures: of the folder that it was loaded from."""
    kind = "further"

    @property
    def causal(self) -> bool:
        """Whether the forecaster that it stretches is causal."""
        return self.along.causal

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t and the stretched displacement."""
        check_request(run, starts, horizons)
        now = weights_of(run)[np.asarray(starts)][:, None]
        moved = self.along.forecast(run, starts, horizons) - now
        known = sorted(self.amplitudes)
        chosen = np.interp(np.log(horizons), np.log(known), [self.amplitudes[h] for h in known])
        return np.asarray(now + _factors(run.layout, chosen.tolist()) * moved)

    def save(self, path: str | Path) -> None:
        """Write config.json, and the stretched forecaster into a folder beside it."""
        amplitudes = {str(h): a for h, a in self.amplitudes.items()}
        write(path, {"kind": self.kind, "amplitudes": amplitudes})
        self.along.save(Path(path) / _ALONG)

    @classmethod
    def load(cls, path: str | Path) -> Stretched:
        """Read a saved one."""
        config = read_config(path, cls.kind, StretchedConfig)
        if not config.amplitudes or not all(h.isdecimal() and int(h) for h in config.amplitudes):
            raise broken(path, f"amplitudes of {sorted(config.amplitudes)}, not of horizons")
        amplitudes = {int(h): a for h, a in config.amplitudes.items()}
        return cls(load_folder(Path(path) / _ALONG), amplitudes, Path(path).resolve().name)


_ALONG = "along"


def _factors(
    layout: ParamLayout, amplitudes: Sequence[float]
) -> Float32[np.ndarray, "horizon param"]:
    """Return the factor of each displacement; that of the exploration noise is 1."""
    factors = np.ones((len(amplitudes), layout.size), np.float32)
    factors *= np.array(amplitudes, np.float32)[:, None]
    for param in layout.params:
        if param.name == "log_std":
            factors[:, param.slice] = 1
    return factors
