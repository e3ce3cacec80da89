"""What tipl-causal sees of a run at a start, and the examples that it is trained on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tipl.models.causal.network import CausalConfig
from tipl.representation import PrefixBases, PrefixTokens
from tipl.runs import columns_of, stratified, weights_of, while_open
from tipl.structure import Clock, Structure
from tipl.training.starts import Example, StartExamples, draw_starts
from weighttraj import Run

SCALE_STEPS = 20
"""Number of steps whose RMS norm is the unit of length."""
POOL = 4096
"""Number of sampled parameters of a run, to measure displacements."""


@dataclass(frozen=True, kw_only=True)
class CausalExamples(StartExamples):
    """Starts and what followed, in units of the local step."""

    tokens: Float[Tensor, "start window rank"]
    """Displacements of the last snapshots from phi_t, over the local step; 0 in padding."""
    phases: Int[Tensor, "start window"]
    """Phase of each snapshot, from 0, which is before training."""
    mask: Bool[Tensor, "start window"]
    """False in padding."""
    state: Float[Tensor, "start state"]
    """Logarithm of the spectrum over the local step; and time."""
    target: Float[Tensor, "start horizon rank"]
    """Displacements within the basis; 0 where the run ends before."""
    energy: Float[Tensor, "start horizon"]
    """Squared norm of the whole displacement; NaN where the run ends before."""


def examples_of(
    run: Run, config: CausalConfig, count: int, rng: np.random.Generator
) -> Iterator[Example]:
    """Yield about ``count`` examples of a run."""
    clock = Clock.of(run)
    columns, counts = stratified(Structure.of(run.layout).tensor.numpy(), POOL, rng)
    weights = columns_of(weights_of(run), columns).astype(np.float64)
    bases = bases_of(run, config, ahead=max(config.horizons))
    for t in draw_starts(len(run), count, rng):
        if t < config.rank:
            continue
        scale = local_scale(weights[unit_rows(t, config)], counts)
        if scale == 0:
            continue
        prefix = bases.tokens(t)
        seen = view(prefix, t, scale, clock, config)
        yield seen | _followed(prefix, t, scale, weights, counts, config.horizons)


def _followed(
    prefix: PrefixTokens,
    t: int,
    scale: float,
    weights: Float[np.ndarray, "time some"],
    counts: Float[np.ndarray, " some"],
    horizons: Sequence[int],
) -> Example:
    """Return the displacements after a start: those in its basis, and their whole energy."""
    ahead = np.array(horizons)
    reached = t + ahead < len(weights)
    later = ahead[reached]
    values = prefix.singular_values / scale
    target = np.zeros((len(ahead), len(values)))
    target[reached] = prefix.coefficients[t - prefix.first + later] * values
    energy = np.full(len(ahead), np.nan)
    moved = (weights[t + later] - weights[t]) ** 2 @ counts / scale**2
    # The pool is a sample: it may find less than lies within the basis.
    energy[reached] = np.maximum(moved, (target[reached] ** 2).sum(1))
    return {
        "target": torch.from_numpy(target).float(),
        "energy": torch.from_numpy(energy).float(),
    }


def view(prefix: PrefixTokens, t: int, scale: float, clock: Clock, config: CausalConfig) -> Example:
    """Return what the network sees at t: tokens, phases, mask and state.

    ``scale`` is the RMS norm of the last steps, the unit of length.
    """
    count = min(config.block_size, t - prefix.first + 1)
    values = prefix.singular_values / scale
    tokens = np.zeros((config.block_size, config.rank), np.float32)
    end = t - prefix.first + 1
    tokens[-count:] = prefix.coefficients[end - count : end] * values
    phases = np.zeros(config.block_size, np.int64)
    phases[-count:] = clock.phase[t - count + 1 : t + 1] + 1
    return {
        "tokens": torch.from_numpy(tokens),
        "phases": torch.from_numpy(phases),
        "mask": torch.arange(config.block_size) >= config.block_size - count,
        "state": torch.tensor([*np.log(values + 1e-6), *clock.numbers(t)], dtype=torch.float32),
    }


def local_scale(
    rows: Float[np.ndarray, "time param"], counts: Float[np.ndarray, " param"] | float = 1.0
) -> float:
    """Return the RMS norm of the steps between snapshots; ``counts`` weighs the parameters."""
    return float(np.sqrt((np.diff(rows, axis=0) ** 2 * counts).sum(1).mean()))


def unit_rows(t: int, config: CausalConfig) -> slice:
    """Return the snapshots up to t whose steps give the unit of length."""
    first = max(0, t - SCALE_STEPS) if config.unit == "recent" else 0
    return slice(first, min(t, first + SCALE_STEPS) + 1)


@while_open
def bases_of(run: Run, config: CausalConfig, ahead: int = 0) -> PrefixBases:
    """Return the bases of all starts of a run, which are kept as long as the run is open."""
    return PrefixBases.fit(run, config.rank, window=config.window, ahead=ahead)
