"""What tipl-gate is trained on: some parameters at some starts of each run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tipl.models.gate.adam import AdamReader
from tipl.models.gate.features import features
from tipl.models.gate.history import histories
from tipl.models.gate.network import GateConfig
from tipl.runs import columns_of, stratified, weights_of
from tipl.structure import Clock, Structure
from tipl.training.starts import Example, StartExamples, draw_starts
from weighttraj import Run

PARAMS = 128
"""Number of parameters in one example, some of each tensor."""
POOL = 1024
"""Number of parameters of a run, of which each example takes others."""


G = TypeVar("G", bound="GateExamples")


@dataclass(frozen=True, kw_only=True)
class GateExamples(StartExamples):
    """Starts, in units of the RMS step around each. Half precision: a third of a gigabyte."""

    inputs: Float[Tensor, "start param input"]
    """Inputs of the network."""
    contexts: Float[Tensor, "start tensor context"]
    """Contexts of the network; 0 where a policy has fewer tensors than another."""
    basis: Float[Tensor, "start param basis"]
    """Steps and averages."""
    tensor: Int[Tensor, "start param"]
    """Tensor that each parameter belongs to."""
    weight: Float[Tensor, "start param"]
    """Share of the policy's parameters that each stands for."""
    target: Float[Tensor, "start param horizon"]
    """Displacements; NaN where the run ends before."""
    energy: Float[Tensor, "start horizon"]
    """Mean squared displacement of the whole policy."""

    @classmethod
    def of(cls: type[G], found: Sequence[Example]) -> G:
        """Put examples of one start each together, of policies of any number of tensors."""
        tensors = max(len(one["contexts"]) for one in found)
        for one in found:
            missing = tensors - len(one["contexts"])
            one["contexts"] = torch.nn.functional.pad(one["contexts"], (0, 0, 0, missing))
        return super().of(found)


def examples_of(
    run: Run, config: GateConfig, count: int, rng: np.random.Generator
) -> Iterator[Example]:
    """Yield about ``count`` examples of a run."""
    structure, clock = Structure.of(run.layout), Clock.of(run)
    columns, counts = stratified(structure.tensor.numpy(), POOL, rng)
    pool = _Pool(columns, counts, columns_of(weights_of(run), columns))
    starts = draw_starts(len(run), count, rng)
    adam = AdamReader(run, max(starts)) if config.adam else None
    for place, history in histories(run, starts, config.lags, config.betas):
        seen = features(history, structure, clock, config, adam.at(history.t) if adam else None)
        scale = float(history.squares.mean().sqrt())
        if scale == 0 or not np.isfinite(scale):
            continue
        some = rng.permutation(len(columns))[:PARAMS]
        chosen = torch.from_numpy(columns[some])
        inputs, basis = seen.of(chosen)
        yield pool.example(some, starts[place], scale, config.horizons) | {
            "inputs": _filled(inputs.T).half(),
            "contexts": seen.contexts.half(),
            "basis": _filled(basis.T / scale).half(),
            "tensor": _filled(structure.tensor[chosen]),
        }


@dataclass(frozen=True)
class _Pool:
    """Some parameters of a run, which stand for all."""

    columns: Int[np.ndarray, " some"]
    counts: Float[np.ndarray, " some"]
    weights: Float[np.ndarray, "time some"]

    def example(
        self, some: Int[np.ndarray, " few"], t: int, scale: float, horizons: Sequence[int]
    ) -> Example:
        """Return the targets of some of the parameters at a start, over the scale."""
        target, energy = self._targets(t, horizons)
        weight = torch.from_numpy(self.counts[some] / self.counts[some].sum()).float()
        return {
            "weight": _filled(weight),
            "target": _filled(torch.from_numpy(target[some] / scale)).half(),
            "energy": torch.from_numpy(energy / scale**2).float(),
        }

    def _targets(
        self, t: int, horizons: Sequence[int]
    ) -> tuple[Float[np.ndarray, "some horizon"], Float[np.ndarray, " horizon"]]:
        """Return displacements of the pool, and the mean square over the policy it stands for."""
        target = np.full((len(self.columns), len(horizons)), np.nan)
        later = t + np.array([h for h in horizons if t + h < len(self.weights)], int)
        target[:, : len(later)] = (self.weights[later].astype(np.float64) - self.weights[t]).T
        energy = self.counts @ target**2 / self.counts.sum()
        return target, energy


def _filled(values: Float[Tensor, "few *shape"] | Int[Tensor, " few"]) -> Tensor:
    """Append zeros up to the number of parameters in an example."""
    missing = PARAMS - len(values)
    return torch.cat([values, values.new_zeros(missing, *values.shape[1:])])
