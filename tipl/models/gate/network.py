"""A network for one scalar parameter at a time, shared by all parameters of all policies.

Its outputs are *coefficients* of the steps that the parameter made before. So it is persistence
before training, AR and EMA are special cases, and the forecast follows the sign of a parameter and
the scale of its steps. It is a mixture of linear filters (Jordan and Jacobs, 1994): each *expert*
is one filter for all parameters; the recent steps of a parameter, of its tensor and of the whole
policy set the weight of each expert. Each tensor has one more filter. This network is ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from tipl.horizons import HORIZONS
from tipl.structure import KINDS

LAG_COSINES = 10
"""Number of earlier steps that the last step is compared with."""

Input = Literal["steps", "averages", "drift", "sizes", "course", "kind", "phase", "time", "rate"]
"""A part of what the network sees.

``steps``, ``averages`` and ``drift`` are the basis of its filters; ``sizes``: how large the steps
of a parameter, its row, its column and its tensor are beside each other's; ``course``: how straight
its tensor and the whole policy go; ``rate``: of learning; the others are of the tensor and of the
snapshot.
"""


@dataclass(frozen=True, kw_only=True)
class GateConfig:
    """What the network sees, and its sizes."""

    horizons: tuple[int, ...] = HORIZONS
    """Numbers of snapshots ahead: one output each."""
    lags: int = 20
    """Number of last steps that the network sees, beside averages of all."""
    betas: tuple[float, ...] = (0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
    """Decays of the exponential moving averages of all steps."""
    phases: int = 0
    """Number of snapshots in an iteration of PPO; 0: that of the training runs."""
    width: int = 48
    """Number of units of a hidden layer."""
    experts: int = 8
    """Number of linear filters that are mixed."""
    without: tuple[Input, ...] = ()
    """Inputs that are replaced by zeros; docs/studies/gate_inputs.md says what each is worth. The
    released tipl-gate does without ``time``."""
    adam: bool = False
    """Whether the network sees Adam's moments, which the runs must store."""

    @property
    def drift(self) -> int:
        """Place of the mean step since phi_0 in the basis; Adam's direction follows."""
        return self.lags + len(self.betas)

    @property
    def basis(self) -> int:
        """Number of coefficients: of steps, averages, the mean step, and Adam's next direction."""
        return self.drift + 1 + self.adam

    @property
    def inputs(self) -> int:
        """Number of inputs of a parameter: basis, three step sizes, and a size of its gradient."""
        return self.basis + 3 + self.adam

    @property
    def contexts(self) -> int:
        """Number of inputs of a tensor: course, size, kind, phase, time, and three of Adam."""
        return self.course + 1 + len(KINDS) + (self.phases + 1) + 3 + 3 * self.adam

    @property
    def course(self) -> int:
        """Number of those inputs that say how straight the tensor and the policy go."""
        averages = len(self.betas)
        return 2 * (LAG_COSINES + 3 * averages + max(0, averages - 3) + 2)


class GateNetwork(nn.Module):
    """Predicts displacements of parameters from their past."""

    basis_scale: Tensor

    def __init__(self, config: GateConfig) -> None:
        super().__init__()
        self.config = config
        width, outputs = config.width, config.basis * len(config.horizons)
        self.context = nn.Sequential(
            nn.Linear(config.contexts, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.first = nn.Linear(config.inputs, width)
        self.first_context = nn.Linear(width, width, bias=False)
        self.second = nn.Linear(width, width)
        self.second_context = nn.Linear(width, width, bias=False)
        self.gate = nn.Linear(width, config.experts)
        self.experts = nn.Parameter(torch.zeros(config.experts, outputs))
        self.of_tensor = nn.Linear(width, outputs)
        nn.init.zeros_(self.of_tensor.weight)
        nn.init.zeros_(self.of_tensor.bias)
        # With this scale a coefficient of 1 is plausible at each horizon.
        self.register_buffer("basis_scale", _basis_scale(config), persistent=False)

    def forward(
        self,
        inputs: Float[Tensor, "*start param input"],
        contexts: Float[Tensor, "*start tensor context"],
        basis: Float[Tensor, "*start param basis"],
        tensor: Int[Tensor, "*start param"],
    ) -> Float[Tensor, "*start param horizon"]:
        """Return displacements, in the units of the basis, which are steps and averages.

        The inputs do not change with the sign of a parameter; ``tensor`` is the tensor of each.
        """
        hidden = self.context(contexts)

        def spread(values: Tensor) -> Tensor:
            place = tensor[..., None].expand(*tensor.shape, values.shape[-1])
            return values.gather(-2, place)

        z = torch.relu(self.first(inputs) + spread(self.first_context(hidden)))
        z = torch.relu(self.second(z) + spread(self.second_context(hidden)))
        filters = self.gate(z) @ self.experts + spread(self.of_tensor(hidden))
        filters = filters.unflatten(-1, self.basis_scale.shape) * self.basis_scale
        moved: Tensor = (basis[..., None, :] @ filters)[..., 0, :]
        return moved

    def of_one_tensor(
        self,
        inputs: Float[Tensor, "input param"],
        context: Float[Tensor, " context"],
        basis: Float[Tensor, "basis param"],
        horizons: list[int],
    ) -> Float[Tensor, "horizon param"]:
        """Return the same for parameters of one tensor and some places of horizons, in less time.

        Parameters come last here, so that what is added up lies side by side in memory.
        """
        hidden = self.context(context)
        count = len(self.experts)
        filters = torch.cat([self.experts, self.of_tensor(hidden)[None]])
        filters = filters.view(count + 1, *self.basis_scale.shape)[..., horizons]
        # The context is the same for all parameters of the tensor: one more bias.
        first = self.first.bias + self.first_context(hidden)
        second = self.second.bias + self.second_context(hidden)
        z = torch.addmm(first[:, None], self.first.weight, inputs).relu_()
        z = torch.addmm(second[:, None], self.second.weight, z).relu_()
        gates = torch.addmm(self.gate.bias[:, None], self.gate.weight, z)
        # Each filter's forecast, then their mixture: cheaper than mixing the filters.
        wanted = (filters * self.basis_scale[:, horizons]).transpose(
            1, 2
        )  # (filter, horizon, basis)
        each = (wanted.flatten(0, 1) @ basis).view(count + 1, len(horizons), -1)
        moved: Tensor = (each[:count] * gates[:, None]).sum(0).add_(each[count])
        return moved


def _basis_scale(config: GateConfig) -> Float[Tensor, "basis horizon"]:
    """Return how far a displacement plausibly goes with a step, an average or the mean step.

    A step predicts few further ones; an average with beta about 2 / (1 - beta) steps.
    """
    steps = [[min(h, 5) ** 0.5 for h in config.horizons]] * config.lags
    averages = [[min(h, 2 / (1 - beta)) for h in config.horizons] for beta in config.betas]
    rows = [*steps, *averages, [float(h) for h in config.horizons]]
    if config.adam:
        rows.append(steps[0])
    return torch.tensor(rows)
