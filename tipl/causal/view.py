"""The path of a run up to a start, as tipl-causal sees it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tipl.models.causal import CausalConfig
from tipl.representation import PrefixBases, PrefixTokens
from tipl.structure import Clock
from weighttraj import Run

SCALE_STEPS = 20
"""Steps whose RMS norm is the unit."""


@dataclass(frozen=True, kw_only=True)
class View:
    """What the network sees of a start, or of several."""

    tokens: Float[Tensor, "*start window rank"]
    """Displacements of the last snapshots from phi_t, over the local step; 0 in padding."""
    phases: Int[Tensor, "*start window"]
    """Of each snapshot, from 0: before training."""
    mask: Bool[Tensor, "*start window"]
    """False in padding."""
    state: Float[Tensor, "*start state"]
    """Logarithm of the spectrum over the local step; and time."""

    def __getitem__(self, rows: Int[Tensor, " some"]) -> View:
        return View(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def view(prefix: PrefixTokens, t: int, scale: float, clock: Clock, config: CausalConfig) -> View:
    """What the network sees at t.

    Args:
        prefix: of the run at t.
        t: the start.
        scale: RMS norm of the last steps.
        clock: phases and learning rates.
        config: of the network.
    """
    count = min(config.block_size, t - prefix.first + 1)
    values = prefix.singular_values / scale
    tokens = np.zeros((config.block_size, config.rank), np.float32)
    end = t - prefix.first + 1
    tokens[-count:] = prefix.coefficients[end - count : end] * values
    phases = np.zeros(config.block_size, np.int64)
    phases[-count:] = clock.phase[t - count + 1 : t + 1] + 1
    rate = float(clock.rate[t])
    time = [np.log1p(t) / 4, rate, np.log(rate + 1e-3) / 3]
    return View(
        tokens=torch.from_numpy(tokens),
        phases=torch.from_numpy(phases),
        mask=torch.arange(config.block_size) >= config.block_size - count,
        state=torch.tensor([*np.log(values + 1e-6), *time], dtype=torch.float32),
    )


def local_scale(
    rows: Float[np.ndarray, "time param"], counts: Float[np.ndarray, " param"] | float = 1.0
) -> float:
    """RMS norm of the steps between these snapshots, each parameter counted so often."""
    return float(np.sqrt((np.diff(rows, axis=0) ** 2 * counts).sum(1).mean()))


def bases_of(run: Run, config: CausalConfig, ahead: int = 0) -> PrefixBases:
    """The bases of all starts of a run, kept as long as the run is open."""
    key = (config.rank, config.window, ahead)
    known = _KNOWN.setdefault(run, {})
    if key not in known:
        known[key] = PrefixBases.fit(run, config.rank, window=config.window, ahead=ahead)
    return known[key]


_KNOWN: WeakKeyDictionary[Run, dict[tuple[int, int, int], PrefixBases]] = WeakKeyDictionary()

__all__ = ["SCALE_STEPS", "View", "bases_of", "local_scale", "view"]
