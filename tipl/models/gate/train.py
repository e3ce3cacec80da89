"""Trains tipl-gate on the training runs of one or several data sets; minutes on one core."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.console import Console
from torch import Tensor

import weighttraj as wt
from tipl.checks.copies import RefitConfig, refit_settings
from tipl.errors import TrainError
from tipl.models.gate.data import GateExamples, examples_of
from tipl.models.gate.forecaster import Gate
from tipl.models.gate.network import GateConfig, GateNetwork
from tipl.settings import check_settings
from tipl.training import LoopConfig
from tipl.training.starts import Example, StartsConfig, StartsLearner, train_on_starts

NETWORK = GateConfig()
LOOP = LoopConfig(n_batches=4_000, batch_size=32, learning_rate=3e-3)
"""Minutes on one core."""


@dataclass(frozen=True, kw_only=True)
class GateTrainConfig(StartsConfig):
    """What is trained on, and where the model goes. Each start in a batch has 128 parameters."""

    network: GateConfig = NETWORK
    """Sizes of the network."""
    training: LoopConfig = LOOP
    """How the network is trained."""

    def check(self) -> None:
        """Refuse numbers that make no training or no network."""
        super().check()
        least = dict.fromkeys(("horizons", "lags", "width", "experts"), 1) | {"phases": 0}
        check_settings(vars(self.network), least, TrainError)
        if len(self.network.betas) < 3 or not all(0 <= beta < 1 for beta in self.network.betas):
            raise TrainError(
                "the network cannot average steps like this",
                expected="at least three betas, each from 0 to below 1",
                got=self.network.betas,
                do="change --betas, or leave it out",
            )


class GateLearner(StartsLearner[GateExamples]):
    """The network of tipl-gate, its examples and its loss."""

    model = Gate
    examples_type = GateExamples
    network: GateNetwork

    def examples_of(self, run: wt.Run, rng: np.random.Generator) -> Iterable[Example]:
        """Return the examples of one run."""
        return examples_of(run, self.model_config.network, self.config.starts, rng)

    def loss(
        self, network: Callable[..., Tensor], batch: GateExamples
    ) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
        """Return the summed relative error, and the number of known cells."""
        return relative_error(network, batch)


def train_gate(config: GateTrainConfig, *, console: Console | None = None) -> Gate:
    """Train tipl-gate, one small network that forecasts each parameter of a policy.

    With the default settings it takes minutes on one core. A training that was stopped goes on with
    the same command; one that has ended is loaded. The same seed gives the same model on the same
    machine.

    Example: tipl train gate --data hopper-v4-ppo-16x16-v1 --out data/my-gate

    Then: tipl evaluate data/my-gate persistence --data hopper-v4-ppo-16x16-v1

    Raises:
        TrainError: the data sets have no runs to train on, or different cadences; or as
            ``train_network``.
    """
    train_on_starts(GateLearner, config, console)
    return Gate.load(config.out)


def relative_error(
    network: Callable[..., Tensor], examples: GateExamples
) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
    """Return squared error over mean squared displacement, summed over starts and horizons.

    Returns:
        The sum, and how many starts and horizons are known.
    """
    moved = network(
        examples.inputs.float(), examples.contexts.float(), examples.basis.float(), examples.tensor
    ).float()  # (start, param, horizon)
    known = examples.energy.isfinite() & (examples.energy > 0)
    target = examples.target.float().nan_to_num()
    squared = ((moved - target).square() * examples.weight[..., None]).sum(1)
    ratio = squared / torch.where(known, examples.energy, 1)  # (start, horizon)
    return (ratio * known).sum(), known.sum().clamp(min=1)


def refit(old: Gate, runs: Sequence[wt.Run], config: RefitConfig) -> Gate:
    """Train a network of the same sizes on other runs, for the null check."""
    return train_gate(refit_settings(GateTrainConfig, LOOP, old.config.network, runs, config))
