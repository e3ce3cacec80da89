"""The torch modules of the two small networks, and their training. Tensors in, tensors out."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class Streams(nn.Module):
    """Two streams of fully connected layers, one for values and one for differences, then joined.

    Args:
        inputs: numbers in, half of them for each stream.
        width: units of a layer.
        outputs: numbers out.
    """

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.values = _layers(inputs // 2, width)
        self.differences = _layers(inputs // 2, width)
        self.head = _zero(nn.Linear(2 * width, outputs))

    def forward(self, x: Float[Tensor, "row input"]) -> Float[Tensor, "row output"]:
        """Outputs; 0 before training."""
        values, differences = x.chunk(2, dim=-1)
        joined = torch.cat([self.values(values), self.differences(differences)], dim=-1)
        return self.head(joined)  # type: ignore[no-any-return]


class Perceptron(nn.Module):
    """Fully connected layers.

    Args:
        inputs: numbers in.
        width: units of a layer.
        outputs: numbers out.
    """

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.body = _layers(inputs, width)
        self.head = _zero(nn.Linear(width, outputs))

    def forward(self, x: Float[Tensor, "row input"]) -> Float[Tensor, "row output"]:
        """Outputs; 0 before training."""
        return self.head(self.body(x))  # type: ignore[no-any-return]


class PerParameter(nn.Module):
    """One network for every parameter of its group, with the scales of its inputs and outputs.

    Args:
        networks: one for each group of parameters.
        inputs: numbers in.
        horizons: how far to look.
    """

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
        """Displacements in units of the scale's."""
        x = (x - self.input_mean) / self.input_std
        out = x.new_zeros(len(x), len(self.output_scale))
        for number, network in enumerate(self.networks):
            mine = (group == number).nonzero()[:, 0]
            if len(mine):
                out = out.index_copy(0, mine, network(x[mine]))
        return out * self.output_scale * scale[:, None]


@dataclass(frozen=True, kw_only=True)
class Examples:
    """What a network is trained on; a row is a parameter at a start."""

    x: Float[Tensor, "row input"]
    """Inputs."""
    scale: Float[Tensor, " row"]
    """What outputs are multiplied by, over the RMS step around the start."""
    group: Int[Tensor, " row"]
    """Which network takes the row."""
    target: Float[Tensor, "row horizon"]
    """Displacements over the RMS step around the start; NaN: the run ends before."""
    weight: Float[Tensor, " row"]
    """How much a row counts; 1 on average."""

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, rows: Int[Tensor, " some"]) -> Examples:
        return Examples(**{name: value[rows] for name, value in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How a small network is trained: under a minute on one core."""

    steps: int = 2000
    """Gradient steps."""
    batch_size: int = 4096
    """Rows in a batch."""
    learning_rate: float = 3e-3
    """At the start; it falls to 0 along a cosine."""
    clip: float = 1.0
    """Largest norm of the gradient."""


def standardise(network: PerParameter, examples: Examples) -> None:
    """Set the buffers: inputs of mean 0 and deviation 1, outputs of the size of the targets."""
    network.input_mean.copy_(examples.x.mean(0))
    network.input_std.copy_(examples.x.std(0).clamp(min=1e-8))
    roots = network.output_scale
    targets = (examples.target / roots).square().nanmean().sqrt()
    size = examples.scale.square().mean().sqrt().clamp(min=1e-8)
    network.output_scale.copy_(roots * (targets / size))


def loss_of(
    network: PerParameter, examples: Examples, roots: Float[Tensor, " horizon"]
) -> Float[Tensor, ""]:
    """Mean squared error of displacements over the RMS step and the root of the horizon.

    So starts count alike, early or late, and horizons too.
    """
    predicted = network(examples.x, examples.scale, examples.group)
    known = examples.target.isfinite()
    error = torch.where(known, predicted - examples.target.nan_to_num(), 0) / roots
    return (error.square() * examples.weight[:, None]).sum() / known.sum().clamp(min=1)


def train(
    network: PerParameter,
    examples: Examples,
    validation: Examples | None,
    horizons: tuple[int, ...],
    config: TrainingConfig,
    seed: int,
) -> None:
    """Train in place.

    Args:
        network: fresh, its buffers set.
        examples: rows to learn from.
        validation: rows of other runs: after each tenth of the training the network is judged on
            them, and the best one is kept; None: the last one is.
        horizons: of the targets.
        config: how.
        seed: of the batches.
    """
    roots = torch.tensor(horizons).float().sqrt()
    rng = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)
    best, kept = float("inf"), copy.deepcopy(network.state_dict())
    for step in range(1, config.steps + 1):
        rows = torch.randint(len(examples), (config.batch_size,), generator=rng)
        optimizer.zero_grad()
        loss_of(network, examples[rows], roots).backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), config.clip)
        optimizer.step()
        schedule.step()
        if validation is not None and step % max(1, config.steps // 10) == 0:
            with torch.no_grad():
                loss = float(loss_of(network, validation, roots))
            if loss < best:
                best, kept = loss, copy.deepcopy(network.state_dict())
    if validation is not None:
        network.load_state_dict(kept)


def _layers(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())


def _zero(layer: nn.Linear) -> nn.Linear:
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


__all__ = [
    "Examples",
    "PerParameter",
    "Perceptron",
    "Streams",
    "TrainingConfig",
    "loss_of",
    "standardise",
    "train",
]
