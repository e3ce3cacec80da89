"""The torch modules of the two small networks, what they are trained on, and their loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from tipl.training import Examples


class Streams(nn.Module):
    """Two streams of fully connected layers, one for values and one for differences, then joined.

    Each stream takes half of the inputs.
    """

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.values = _layers(inputs // 2, width)
        self.differences = _layers(inputs // 2, width)
        self.head = _zero(nn.Linear(2 * width, outputs))

    def forward(self, x: Float[Tensor, "row input"]) -> Float[Tensor, "row output"]:
        """Return the outputs, which are 0 before training."""
        values, differences = x.chunk(2, dim=-1)
        joined = torch.cat([self.values(values), self.differences(differences)], dim=-1)
        return self.head(joined)  # type: ignore[no-any-return]


class Perceptron(nn.Module):
    """Fully connected layers."""

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.body = _layers(inputs, width)
        self.head = _zero(nn.Linear(width, outputs))

    def forward(self, x: Float[Tensor, "row input"]) -> Float[Tensor, "row output"]:
        """Return the outputs, which are 0 before training."""
        return self.head(self.body(x))  # type: ignore[no-any-return]


class PerParameter(nn.Module):
    """A network for each group of parameters, with the scales of their inputs and outputs."""

    input_mean: Tensor
    input_std: Tensor
    output_scale: Tensor

    def __init__(self, networks: list[nn.Module], inputs: int, horizons: tuple[int, ...]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)
        self.register_buffer("input_mean", torch.zeros(inputs))
        self.register_buffer("input_std", torch.ones(inputs))
        self.register_buffer("output_scale", torch.tensor(horizons).float().sqrt())

    def forward(
        self,
        x: Float[Tensor, "row input"],
        scale: Float[Tensor, " row"],
        group: Int[Tensor, " row"],
    ) -> Float[Tensor, "row horizon"]:
        """Return displacements, in the unit of ``scale``."""
        x = (x - self.input_mean) / self.input_std
        out = x.new_zeros(len(x), len(self.output_scale))
        for number, network in enumerate(self.networks):
            mine = (group == number).nonzero()[:, 0]
            if len(mine):
                out = out.index_copy(0, mine, network(x[mine]))
        return out * self.output_scale * scale[:, None]


@dataclass(frozen=True, kw_only=True)
class ParameterRows(Examples):
    """What a network is trained on; a row is a parameter at a start."""

    x: Float[Tensor, "row input"]
    """Inputs."""
    scale: Float[Tensor, " row"]
    """Factor of the outputs, over the RMS step around the start."""
    group: Int[Tensor, " row"]
    """Number of the network that takes the row."""
    target: Float[Tensor, "row horizon"]
    """Displacements over the RMS step around the start; NaN where the run ends before."""
    weight: Float[Tensor, " row"]
    """Weight of the row in the loss; 1 on average."""


def standardise(network: PerParameter, examples: ParameterRows) -> None:
    """Set the buffers: inputs of mean 0 and deviation 1, outputs of the size of the targets."""
    network.input_mean.copy_(examples.x.mean(0))
    network.input_std.copy_(examples.x.std(0).clamp(min=1e-8))
    roots = network.output_scale
    targets = (examples.target / roots).square().nanmean().sqrt()
    size = examples.scale.square().mean().sqrt().clamp(min=1e-8)
    network.output_scale.copy_(roots * (targets / size))


def loss_of(
    network: Callable[..., Tensor], rows: ParameterRows, roots: Float[Tensor, " horizon"]
) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
    """Return squared errors over the RMS step and the root of the horizon, summed, and their count.

    All starts and all horizons count alike.
    """
    predicted = network(rows.x, rows.scale, rows.group)
    known = rows.target.isfinite()
    error = torch.where(known, predicted - rows.target.nan_to_num(), 0) / roots.to(rows.x.device)
    return (error.square() * rows.weight[:, None]).sum(), known.sum().clamp(min=1)


def _layers(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())


def _zero(layer: nn.Linear) -> nn.Linear:
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
