"""From the history of a policy's weights to what the network sees.

Everything is relative: steps are divided by the local scale of their tensor, and by the sign of an
average of the parameter's steps. So the numbers are the same for a policy with other signs or
another order of its hidden units, or with steps twice as long.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import one_hot, pad, softsign

from tipl.models.gate.adam import Adam
from tipl.models.gate.history import History
from tipl.models.gate.network import LAG_COSINES, GateConfig, Input
from tipl.structure import KINDS, Clock, Structure

TINY = 1e-30
"""Added to squares, so that nothing is divided by 0."""
ROWS = 4096
"""Number of parameters that are computed together, so that they stay in the processor's caches."""
_REFERENCE = 2
"""The average whose sign turns a parameter: beta 0.9."""
_NEAR, _FAR = 1, 3
"""A short average is compared with all from this one on."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """What the network sees of one start; valid until the history goes on.

    Numbers of parameters are computed when they are asked for, some at a time: those of a large
    policy would not fit into the processor's caches.
    """

    contexts: Float[Tensor, "tensor context"]
    """Inputs of each tensor."""
    history: History
    """History of the weights."""
    config: GateConfig
    """Sizes of the network."""
    scale: Float[Tensor, " param"]
    """RMS step of each parameter's tensor."""
    sizes: Float[Tensor, "size param"]
    """Sizes of a parameter's steps and gradients relative to others."""
    adam: Adam | None
    """Adam's moments, if the network sees them."""

    def of(
        self, some: slice | Int[Tensor, " some"] = slice(None)
    ) -> tuple[Float[Tensor, "input some"], Float[Tensor, "basis some"]]:
        """Return the inputs of some parameters, and their basis: steps, averages and drift."""
        config, scale = self.config, self.scale[some]
        basis = self.history.basis[:, some]
        if self.adam is not None:  # as long as recent steps
            basis = torch.cat([basis, (self.adam.direction[some] * scale)[None]])
        inputs = basis * (torch.sign(basis[config.lags + _REFERENCE]) / scale)
        # A random walk's drift falls with the root of time.
        inputs[config.drift] *= max(self.history.t, 1) ** 0.5
        inputs = softsign(torch.cat([inputs, self.sizes[:, some]]))
        if config.without:
            basis = basis.clone()  # the history owns it
        for name in config.without:
            rows, _ = _places(name, config)
            basis[rows] = 0  # inputs begin with the basis
            inputs[rows] = 0
        return inputs, basis


def features(
    history: History,
    structure: Structure,
    clock: Clock,
    config: GateConfig,
    adam: Adam | None = None,
) -> Features:
    """Return what the network sees at the snapshot where the history ends."""
    squares = history.squares
    own = structure.means(squares[None])[0]  # (tensor,)
    scale = (own + TINY).sqrt()[structure.tensor]
    every = torch.stack(
        [squares, *(_shared(squares, place) for place in (structure.row, structure.column))]
    )
    sizes = _log_ratio(every, scale**2)
    products, count = _products(history, structure)
    of_policy = (count[:, None, None] * products).sum(0, keepdim=True) / count.sum()
    everyone = squares.mean()
    contexts = torch.cat(
        [
            _course(products, own, history.t, config),
            _course(of_policy, everyone[None], history.t, config).expand(len(own), -1),
            _log_ratio(own, everyone)[:, None],
            one_hot(structure.kind, len(KINDS)).float(),
            _time(clock, history.t, config.phases).expand(len(own), -1),
        ],
        dim=1,
    )
    if adam is not None:
        gradient, further = _of_adam(adam, structure)
        sizes, contexts = torch.cat([sizes, gradient]), torch.cat([contexts, further], dim=1)
    for name in config.without:
        _, columns = _places(name, config)
        contexts[:, columns] = 0
    return Features(
        contexts=contexts, history=history, config=config, scale=scale, sizes=sizes, adam=adam
    )


def _places(name: Input, config: GateConfig) -> tuple[slice, slice]:
    """Return where an input is: among the numbers of a parameter, and those of a tensor."""
    averages, drift, sizes = config.lags, config.drift, config.basis
    size = config.course
    kind = size + 1
    phase = kind + len(KINDS)
    time = phase + config.phases + 1
    nothing = slice(0)
    return {
        "steps": (slice(averages), nothing),
        "averages": (slice(averages, drift), nothing),
        "drift": (slice(drift, drift + 1), nothing),
        "sizes": (slice(sizes, sizes + 3), slice(size, kind)),
        "course": (nothing, slice(size)),
        "kind": (nothing, slice(kind, phase)),
        "phase": (nothing, slice(phase, time)),
        "time": (nothing, slice(time, time + 1)),
        "rate": (nothing, slice(time + 1, time + 3)),
    }[name]


def _products(
    history: History, structure: Structure
) -> tuple[Float[Tensor, "tensor basis basis"], Float[Tensor, " tensor"]]:
    """Return mean products of steps, averages and drift over each tensor, and its size."""
    found = []
    for part in structure.slices:
        total: Any = 0
        for some in pieces(part):
            basis = history.basis[:, some]
            total = total + basis @ basis.T
        found.append(total / (part.stop - part.start))
    count = [part.stop - part.start for part in structure.slices]
    return torch.stack(found), torch.tensor(count, dtype=torch.float32)


def pieces(part: slice) -> Iterator[slice]:
    """Yield a slice in pieces of ``ROWS``."""
    for first in range(part.start, part.stop, ROWS):
        yield slice(first, min(first + ROWS, part.stop))


def _course(
    products: Float[Tensor, "group basis basis"],
    scale: Float[Tensor, " group"],
    t: int,
    config: GateConfig,
) -> Float[Tensor, "group number"]:
    """Return how straight a group of parameters goes: cosines of steps and averages, and sizes.

    ``products`` are means over each group, and ``scale`` is its mean squared step.
    """
    squared = products.diagonal(dim1=1, dim2=2)
    length = (squared + TINY).sqrt()
    cosines = products / (length[:, :, None] * length[:, None])
    averages, drift = config.lags, config.drift
    earlier = cosines[:, 0, 1 : min(averages, 1 + LAG_COSINES)]
    every = slice(averages, drift)
    return torch.cat(
        [
            pad(earlier, (0, LAG_COSINES - earlier.shape[1])),
            cosines[:, 0, every],
            cosines[:, averages + _NEAR, averages + _FAR : drift],
            cosines[:, every, drift],
            _log_ratio(squared[:, every], scale[:, None]),
            _log_ratio(squared[:, :1], scale[:, None]),
            _log_ratio(squared[:, drift : drift + 1] * max(t, 1), scale[:, None]),
        ],
        dim=1,
    )


def _of_adam(
    adam: Adam, structure: Structure
) -> tuple[Float[Tensor, "1 param"], Float[Tensor, "tensor 3"]]:
    """Return sizes of gradients, and of their averages; both without units."""
    direction, gradient = (
        structure.means(of[None] ** 2)[0] for of in (adam.direction, adam.gradient)
    )
    one = torch.ones(())
    everywhere = _log_ratio((adam.direction**2).mean(), one)
    of_tensor = [
        _log_ratio(direction, one),
        everywhere.expand(len(direction)),
        _log_ratio(gradient, (adam.gradient**2).mean()),
    ]
    size = _log_ratio(adam.gradient**2, gradient[structure.tensor])
    return size[None], torch.stack(of_tensor, dim=1)


def _time(clock: Clock, t: int, phases: int) -> Float[Tensor, " number"]:
    phase = one_hot(torch.tensor(int(clock.phase[t]) + 1), phases + 1).float()
    return torch.cat([phase, torch.tensor(clock.numbers(t), dtype=torch.float32)])


def _log_ratio(squared: Tensor, scale: Tensor) -> Tensor:
    """Return the logarithm of a size relative to a scale, from the squares of both."""
    return (0.5 * torch.log((squared + TINY) / (scale + TINY))).clamp(-8, 8)


def _shared(
    values: Float[Tensor, " param"], place: Int[Tensor, " param"]
) -> Float[Tensor, " param"]:
    """Return for each parameter the mean over those with the same place."""
    return (torch.bincount(place, values) / torch.bincount(place))[place].to(values.dtype)
