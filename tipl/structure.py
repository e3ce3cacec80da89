"""What networks see of a run beside its weights: groups of parameters and the time of snapshots."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from weighttraj import ParamLayout, Run

KINDS = ("input weight", "hidden weight", "output weight", "hidden bias", "output bias", "other")
"""Kinds of tensors of a policy."""


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Which parameters belong together."""

    tensor: Int[Tensor, " param"]
    """Tensor of each parameter."""
    row: Int[Tensor, " param"]
    """Row of its tensor, counted over all tensors; of a vector, each element."""
    column: Int[Tensor, " param"]
    """The same for columns."""
    kind: Int[Tensor, " tensor"]
    """Kind of each tensor, a place in ``KINDS``."""
    slices: tuple[slice, ...]
    """Parameters of each tensor."""

    @classmethod
    def of(cls, layout: ParamLayout) -> Structure:
        """Return the structure of a policy's layout."""
        return _structure(layout)

    def means(self, values: Float[Tensor, "any param"]) -> Float[Tensor, "any tensor"]:
        """Return means over the parameters of each tensor."""
        return torch.stack([values[:, part].mean(1) for part in self.slices], dim=1)


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Phase and learning rate of each snapshot."""

    phase: Int[np.ndarray, " time"]
    """Part of its iteration that ends at a snapshot; -1: unset."""
    rate: Float[np.ndarray, " time"]
    """Learning rate relative to the first one; 1 where it is not recorded."""

    @classmethod
    def of(cls, run: Run) -> Clock:
        """Return phases and learning rates of a run."""
        rates = np.asarray(run.learning_rate, np.float64)
        known = rates[np.isfinite(rates)]
        first = known[0] if len(known) else 1.0
        return cls(phase=np.asarray(run.phase), rate=np.nan_to_num(rates / first, nan=1.0))

    def numbers(self, t: int) -> tuple[float, float, float]:
        """Return the time of a snapshot as networks see it: its index, its learning rate twice."""
        rate = float(self.rate[t])
        return np.log1p(t) / 4, rate, np.log(rate + 1e-3) / 3


@functools.lru_cache(maxsize=8)
def _structure(layout: ParamLayout) -> Structure:
    """Return the structure of a layout; a training asks for the same one again and again."""
    size = layout.size
    tensor, row, column = (np.zeros(size, np.int64) for _ in range(3))
    rows = columns = 0
    for number, param in enumerate(layout.params):
        tensor[param.slice] = number
        shape = param.shape if len(param.shape) == 2 else (param.size, 1)
        i, j = (place.ravel() for place in np.indices(shape))
        is_matrix = len(param.shape) == 2
        row[param.slice] = rows + i
        column[param.slice] = columns + (j if is_matrix else i)
        rows, columns = rows + shape[0], columns + (shape[1] if is_matrix else shape[0])
    return Structure(
        tensor=torch.from_numpy(tensor),
        row=torch.from_numpy(row),
        column=torch.from_numpy(column),
        kind=torch.tensor([_kind(param.role, param.axes) for param in layout.params]),
        slices=tuple(param.slice for param in layout.params),
    )


def _kind(role: str, axes: tuple[str, ...]) -> int:
    names = {
        ("weight", "input"): "input weight",
        ("weight", "hidden"): "hidden weight",
        ("weight", "output"): "output weight",
        ("bias", "hidden"): "hidden bias",
        ("bias", "output"): "output bias",
    }
    place = "output" if "action" in axes else "input" if "observation" in axes else "hidden"
    return KINDS.index(names.get((role, place), "other"))
