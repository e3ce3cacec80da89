"""Trains tipl-causal on the training runs of one or several data sets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.console import Console
from torch import Tensor

import weighttraj as wt
from tipl.baselines.horizons import fitted
from tipl.baselines.trajectory import columns_of, stratified
from tipl.causal.forecaster import Causal, CausalModelConfig
from tipl.causal.view import SCALE_STEPS, View, bases_of, local_scale, view
from tipl.errors import TrainError
from tipl.learn import (
    LearnConfig,
    Learner,
    Tell,
    cadence_of,
    draw_starts,
    learn,
    too_short,
)
from tipl.models.causal import CausalConfig, CausalGPT
from tipl.settings import check_heads, check_settings
from tipl.structure import Clock, Structure

POOL = 4096
"""Parameters of a run that its displacements are measured on."""


@dataclass(frozen=True, kw_only=True)
class CausalTrainConfig(LearnConfig):
    """One training of tipl-causal."""

    learning_rate: float = 1e-3
    """Of AdamW at its highest; it rises over the first tenth and falls along a cosine."""
    batch_size: int = 64
    """Starts in a batch."""
    rank: int = 16
    """Directions of the prefix."""
    window: int = 256
    """Snapshots that a basis sees at most."""
    block_size: int = 20
    """Tokens: the last snapshots."""
    n_layer: int = 3
    """Transformer blocks."""
    n_head: int = 4
    """Attention heads."""
    n_embd: int = 64
    """Width of the stream."""

    def check(self) -> None:
        """As of every training, and sizes of the network."""
        super().check()
        sizes = ("rank", "window", "block_size", "n_layer", "n_head", "n_embd")
        check_settings(vars(self), dict.fromkeys(sizes, 1), TrainError)
        check_heads(self.n_embd, self.n_head, TrainError)


@dataclass(frozen=True, kw_only=True)
class CausalExamples:
    """Starts and what followed, in units of the local step."""

    seen: View
    """Of each start."""
    target: Float[Tensor, "start horizon rank"]
    """Displacements within the basis; 0 where the run ends before."""
    energy: Float[Tensor, "start horizon"]
    """Squared norm of the whole displacement; NaN where the run ends before."""
    group: Int[Tensor, " start"]
    """Data set, from 0."""

    def __len__(self) -> int:
        return len(self.target)

    def __getitem__(self, rows: Int[Tensor, " some"]) -> CausalExamples:
        return CausalExamples(
            **{field.name: getattr(self, field.name)[rows] for field in fields(self)}
        )


def train_causal(config: CausalTrainConfig, *, console: Console | None = None) -> Causal:
    """Train tipl-causal, or go on where the training stopped; a finished one is loaded.

    Raises:
        TrainError: as ``learn``.
        RepresentationError: a run has too few directions.
    """
    learn(config, lambda runs: _CausalLearner(config, runs), console=console)
    return Causal.load(config.out)


class _CausalLearner(Learner[CausalExamples]):
    network: CausalGPT

    def __init__(self, config: CausalTrainConfig, runs: Sequence[wt.Run]) -> None:
        every, phases = cadence_of(runs)
        sizes = CausalConfig(
            horizons=fitted(config.horizons),
            phases=phases,
            rank=config.rank,
            window=config.window,
            block_size=config.block_size,
            n_layer=config.n_layer,
            n_head=config.n_head,
            n_embd=config.n_embd,
        )
        self._train, self._model = config, CausalModelConfig(network=sizes, every=every)
        self.network = CausalGPT(sizes)

    def gather(self, groups: Sequence[Sequence[wt.Run]], tell: Tell) -> CausalExamples:
        config, sizes = self._train, self._model.network
        found: list[dict[str, Any]] = []
        for group, runs in enumerate(groups):
            for number, run in enumerate(runs):
                rng = np.random.default_rng([config.seed, group, number])
                examples = _of_run(run, sizes, config.starts, rng)
                found += [one | {"group": torch.tensor(group)} for one in examples]
                tell(run)
        energies = [one["energy"] for one in found]
        if not energies or not torch.stack(energies).isfinite().any(0).all():
            raise too_short(sizes.horizons)
        seen = View(
            **{
                field.name: torch.stack([getattr(one["seen"], field.name) for one in found])
                for field in fields(View)
            }
        )
        rest = {n: torch.stack([one[n] for one in found]) for n in ("target", "energy", "group")}
        return CausalExamples(seen=seen, **rest)

    def error(self, examples: CausalExamples) -> Float[Tensor, ""]:
        seen = examples.seen
        moved = self.network(seen.tokens, seen.phases, seen.mask, seen.state)
        known = examples.energy.isfinite() & (examples.energy > 0)
        energy = torch.where(known, examples.energy, 1)
        # What leaves the basis is lost in any case.
        outside = energy - examples.target.square().sum(2)
        ratio = ((moved - examples.target).square().sum(2) + outside) / energy
        error: Tensor = (ratio * known).sum() / known.sum().clamp(min=1)
        return error

    def save(self, out: Path) -> None:
        Causal(self.network, self._model).save(out)


def _of_run(
    run: wt.Run, sizes: CausalConfig, count: int, rng: np.random.Generator
) -> Iterator[dict[str, Any]]:
    clock, horizons = Clock.of(run), np.array(sizes.horizons)
    columns, counts = stratified(Structure.of(run.layout).tensor.numpy(), POOL, rng)
    weights = columns_of(run.weights, columns).astype(np.float64)
    bases = bases_of(run, sizes, ahead=max(sizes.horizons))
    for t in draw_starts(len(run), count, rng):
        if t < sizes.rank:
            continue
        scale = local_scale(weights[max(0, t - SCALE_STEPS) : t + 1], counts)
        if scale == 0:
            continue
        prefix = bases.tokens(t)
        reached = t + horizons < len(run)
        later = horizons[reached]
        target = np.zeros((len(horizons), sizes.rank))
        values = prefix.singular_values / scale
        target[reached] = prefix.coefficients[t - prefix.first + later] * values
        energy = np.full(len(horizons), np.nan)
        moved = (weights[t + later] - weights[t]) ** 2 @ counts / scale**2
        # The pool is a sample: it may find less than lies within the basis.
        energy[reached] = np.maximum(moved, (target[reached] ** 2).sum(1))
        yield {
            "seen": view(prefix, t, scale, clock, sizes),
            "target": torch.from_numpy(target).float(),
            "energy": torch.from_numpy(energy).float(),
        }


__all__ = ["CausalTrainConfig", "train_causal"]
