"""What tipl-gate is trained on: some parameters at some starts of each run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tipl.baselines.trajectory import columns_of, stratified
from tipl.gate.adam import AdamReader
from tipl.gate.features import features
from tipl.gate.history import histories
from tipl.learn import Tell, draw_starts, too_short
from tipl.models.gate import GateConfig
from tipl.structure import Clock, Structure
from weighttraj import Run

PARAMS = 128
"""Parameters of one example, some of each tensor."""
POOL = 1024
"""Parameters of a run, of which each example takes others."""


@dataclass(frozen=True, kw_only=True)
class GateExamples:
    """Starts, in units of the RMS step around each. Half precision: a third of a gigabyte."""

    inputs: Float[Tensor, "start param input"]
    """Of the network."""
    contexts: Float[Tensor, "start tensor context"]
    """Of the network; 0 where a policy has fewer tensors than another."""
    basis: Float[Tensor, "start param basis"]
    """Steps and averages."""
    tensor: Int[Tensor, "start param"]
    """Which tensor each parameter belongs to."""
    weight: Float[Tensor, "start param"]
    """How many parameters of the policy each stands for, over all of them."""
    target: Float[Tensor, "start param horizon"]
    """Displacements; NaN: the run ends before."""
    energy: Float[Tensor, "start horizon"]
    """Mean squared displacement of the whole policy."""
    group: Int[Tensor, " start"]
    """Data set, from 0."""

    def __len__(self) -> int:
        return len(self.inputs)

    def __getitem__(self, rows: Int[Tensor, " some"]) -> GateExamples:
        return GateExamples(
            **{field.name: getattr(self, field.name)[rows] for field in fields(self)}
        )


def gather(
    groups: Sequence[Sequence[Run]],
    config: GateConfig,
    *,
    starts: int,
    seed: int,
    tell: Tell = lambda _: None,
) -> GateExamples:
    """Examples from runs of one or several data sets. Each run is read twice, row by row.

    Half of the starts lie evenly in time, half on a logarithmic scale: the learning phase is short.

    Args:
        groups: the runs of each data set.
        config: of the network.
        starts: of each run, about.
        seed: of starts and parameters.
        tell: hears of each run that was read.

    Raises:
        TrainError: no run is long enough for each horizon.
    """
    found: list[dict[str, Tensor]] = []
    tensors = max((len(run.layout.params) for runs in groups for run in runs), default=0)
    for group, runs in enumerate(groups):
        for number, run in enumerate(runs):
            rng = np.random.default_rng([seed, group, number])
            for one in _of_run(run, config, starts, rng):
                pad = tensors - len(one["contexts"])
                one["contexts"] = torch.nn.functional.pad(one["contexts"], (0, 0, 0, pad))
                found.append(one | {"group": torch.tensor(group)})
            tell(run)
    if not found or not all(_reaches(found, place) for place in range(len(config.horizons))):
        raise too_short(config.horizons)
    return GateExamples(**{name: torch.stack([one[name] for one in found]) for name in found[0]})


def _reaches(found: Sequence[dict[str, Tensor]], place: int) -> bool:
    return any(bool(one["energy"][place].isfinite()) for one in found)


def _of_run(
    run: Run, config: GateConfig, count: int, rng: np.random.Generator
) -> Iterator[dict[str, Tensor]]:
    structure, clock = Structure.of(run.layout), Clock.of(run)
    columns, counts = stratified(structure.tensor.numpy(), POOL, rng)
    weights = columns_of(run.weights, columns)
    starts = draw_starts(len(run), count, rng)
    adam = AdamReader(run, max(starts)) if config.adam else None
    for place, history in histories(run, starts, config.lags, config.betas):
        seen = features(history, structure, clock, config, adam.at(history.t) if adam else None)
        scale = float(history.squares.mean().sqrt())
        if scale == 0 or not np.isfinite(scale):
            continue
        some = rng.permutation(len(columns))[:PARAMS]
        chosen = torch.from_numpy(columns[some])
        target, energy = _targets(weights, counts, starts[place], config.horizons)
        weight = torch.from_numpy(counts[some] / counts[some].sum()).float()
        missing = PARAMS - len(some)

        inputs, basis = seen.of(chosen)

        def fill(values: Tensor, missing: int = missing) -> Tensor:
            return torch.cat([values, values.new_zeros(missing, *values.shape[1:])])

        yield {
            "inputs": fill(inputs.T).half(),
            "contexts": seen.contexts.half(),
            "basis": fill(basis.T / scale).half(),
            "tensor": fill(structure.tensor[chosen]),
            "weight": fill(weight),
            "target": fill(torch.from_numpy(target[some] / scale)).half(),
            "energy": torch.from_numpy(energy / scale**2).float(),
        }


def _targets(
    weights: Float[np.ndarray, "time some"],
    counts: Float[np.ndarray, " some"],
    t: int,
    horizons: Sequence[int],
) -> tuple[Float[np.ndarray, "some horizon"], Float[np.ndarray, " horizon"]]:
    """Displacements of the pool, and the mean square over the whole policy that they stand for."""
    target = np.full((weights.shape[1], len(horizons)), np.nan)
    later = t + np.array([h for h in horizons if t + h < len(weights)], int)
    target[:, : len(later)] = (weights[later].astype(np.float64) - weights[t]).T
    energy = counts @ target**2 / counts.sum()
    return target, energy


__all__ = ["PARAMS", "POOL", "GateExamples", "gather"]
