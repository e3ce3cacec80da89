"""From the history of a policy's weights to what the network sees.

Everything is relative: steps are divided by the local scale of their tensor, and parameters are
turned so that an average of their steps is positive. So the numbers are the same for a policy with
other signs or another order of its hidden units, or with steps twice as long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import one_hot, softsign

from tipl.gate.adam import Adam
from tipl.gate.history import History
from tipl.models.gate import KINDS, LAG_COSINES, GateConfig, Input
from tipl.structure import Clock, Structure

TINY = 1e-30
"""Added to squares, so that what does not move is divided by something."""
_REFERENCE = 2
"""The average whose sign turns a parameter: beta 0.9."""
_NEAR, _FAR = 1, 3
"""A short average is compared with all from this one on."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """What the network sees of one start."""

    inputs: Float[Tensor, "param input"]
    """Of each parameter."""
    contexts: Float[Tensor, "tensor context"]
    """Of each tensor."""
    basis: Float[Tensor, "param basis"]
    """Steps, averages and drift, as they are."""


def features(
    history: History,
    structure: Structure,
    clock: Clock,
    config: GateConfig,
    adam: Adam | None = None,
) -> Features:
    """What the network sees at the snapshot where the history ends.

    Args:
        history: of the weights.
        structure: of the policy.
        clock: of the run.
        config: of the network.
        adam: moments at the snapshot, if the network sees them.
    """
    t, steps, averages, drift = history.t, history.steps, history.averages, history.drift
    squares = history.squares
    own = structure.means(squares[None])[0]  # (tensor,)
    everyone = squares.mean()
    scale = (own + TINY).sqrt()[structure.tensor]
    basis = torch.cat([steps, averages, drift[None]])
    if adam is not None:
        basis = torch.cat([basis, (adam.direction * scale)[None]])  # as long as a step of late
    turn = torch.sign(averages[_REFERENCE]) / scale
    inputs = basis * turn
    # A random walk's drift falls with the root of time.
    inputs[config.drift] *= max(t, 1) ** 0.5
    sizes = torch.stack(
        [squares, *(_shared(squares, place) for place in (structure.row, structure.column))]
    )
    inputs = torch.cat([inputs, _log_ratio(sizes, scale**2)])
    tensors = _course(steps, averages, drift, own, t, structure.means)
    policy = _course(steps, averages, drift, everyone[None], t, lambda x: x.mean(1, keepdim=True))
    time = _time(clock, t, config.phases)
    count = len(own)
    contexts = torch.cat(
        [
            tensors.T,
            policy.T.expand(count, -1),
            _log_ratio(own, everyone)[:, None],
            one_hot(structure.kind, len(KINDS)).float(),
            time.expand(count, -1),
        ],
        dim=1,
    )
    if adam is not None:
        gradient, further = _of_adam(adam, structure)
        inputs, contexts = torch.cat([inputs, gradient]), torch.cat([contexts, further], dim=1)
    inputs = softsign(inputs)
    for name in config.without:
        _hide(name, config, basis, inputs, contexts)
    return Features(inputs=inputs.T, contexts=contexts, basis=basis.T)


def _hide(
    name: Input,
    config: GateConfig,
    basis: Float[Tensor, "basis param"],
    inputs: Float[Tensor, "input param"],
    contexts: Float[Tensor, "tensor context"],
) -> None:
    """Put zeros in the place of a part."""
    averages, drift, sizes = config.lags, config.drift, config.basis
    size = config.course
    kind = size + 1
    phase = kind + len(KINDS)
    time = phase + config.phases + 1
    nothing = slice(0)
    rows, columns = {
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
    basis[rows] = 0  # inputs begin with the basis
    inputs[rows] = 0
    contexts[:, columns] = 0


Means = Callable[[Float[Tensor, "any param"]], Float[Tensor, "any group"]]


def _course(
    steps: Float[Tensor, "lag param"],
    averages: Float[Tensor, "beta param"],
    drift: Float[Tensor, " param"],
    scale: Float[Tensor, " group"],
    t: int,
    means: Means,
) -> Float[Tensor, "number group"]:
    """How straight a group of parameters goes: cosines between its steps and averages; and sizes.

    Args:
        steps: the last ones.
        averages: of all.
        drift: mean step since phi_0.
        scale: mean squared step of each group.
        t: number of the snapshot.
        means: over the parameters of each group.
    """
    last, earlier = steps[:1], steps[1 : 1 + LAG_COSINES]
    missing = LAG_COSINES - len(earlier)
    if missing:
        earlier = torch.cat([earlier, torch.zeros(missing, steps.shape[1])])
    near, far = averages[_NEAR : _NEAR + 1], averages[_FAR:]
    squared_averages, squared_drift = means(averages**2), means(drift[None] ** 2)
    squared_last = means(last**2)

    def cosine(product: Tensor, one: Tensor, other: Tensor) -> Tensor:
        return product / ((one + TINY).sqrt() * (other + TINY).sqrt())

    return torch.cat(
        [
            cosine(means(last * earlier), squared_last, means(earlier**2)),
            cosine(means(last * averages), squared_last, squared_averages),
            cosine(
                means(near * far),
                squared_averages[_NEAR : _NEAR + 1],
                squared_averages[_FAR:],
            ),
            cosine(means(averages * drift), squared_averages, squared_drift),
            _log_ratio(squared_averages, scale),
            _log_ratio(squared_last, scale),
            _log_ratio(squared_drift * max(t, 1), scale),
        ]
    )


def _of_adam(
    adam: Adam, structure: Structure
) -> tuple[Float[Tensor, "1 param"], Float[Tensor, "tensor 3"]]:
    """Sizes of gradients, and of what is left of them in their average: all without units."""
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
    rate = float(clock.rate[t])
    rest = torch.tensor([np.log1p(t) / 4, rate, np.log(rate + 1e-3) / 3], dtype=torch.float32)
    return torch.cat([phase, rest])


def _log_ratio(squared: Tensor, scale: Tensor) -> Tensor:
    """Logarithm of a size relative to a scale; both are squared."""
    return (0.5 * torch.log((squared + TINY) / (scale + TINY))).clamp(-8, 8)


def _shared(
    values: Float[Tensor, " param"], place: Int[Tensor, " param"]
) -> Float[Tensor, " param"]:
    """For each parameter the mean over those that share its place."""
    return (torch.bincount(place, values) / torch.bincount(place))[place].to(values.dtype)


__all__ = ["Features", "features"]
