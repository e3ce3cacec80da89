"""Trains tipl-gate on the training runs of one or several data sets; minutes on one core."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

import weighttraj as wt
from tipl.baselines.horizons import fitted
from tipl.errors import TrainError
from tipl.gate.examples import GateExamples, gather
from tipl.gate.forecaster import Gate, GateModelConfig
from tipl.learn import LearnConfig, Learner, Tell, cadence_of, learn
from tipl.models.gate import GateConfig, GateNetwork, Input
from tipl.settings import check_settings


@dataclass(frozen=True, kw_only=True)
class GateTrainConfig(LearnConfig):
    """One training of tipl-gate. A start in a batch has 128 parameters."""

    lags: int = 20
    """Last steps that the network sees, beside averages of all."""
    width: int = 48
    """Units of its hidden layers."""
    experts: int = 8
    """Linear filters that it mixes."""
    without: tuple[Input, ...] = ()
    """Zeros instead of these inputs, to learn what they are worth."""
    adam: bool = False
    """It sees Adam's moments too, which the runs must store."""

    def check(self) -> None:
        """As of every training, and sizes of the network."""
        super().check()
        check_settings(vars(self), dict.fromkeys(("lags", "width", "experts"), 1), TrainError)


def train_gate(config: GateTrainConfig, *, console: Console | None = None) -> Gate:
    """Train tipl-gate, or go on where the training stopped; a finished one is loaded.

    The same seed gives the same model on the same machine.

    Raises:
        TrainError: as ``learn``.
    """
    learn(config, lambda runs: _GateLearner(config, runs), console=console)
    return Gate.load(config.out)


class _GateLearner(Learner[GateExamples]):
    network: GateNetwork

    def __init__(self, config: GateTrainConfig, runs: Sequence[wt.Run]) -> None:
        every, phases = cadence_of(runs)
        sizes = GateConfig(
            horizons=fitted(config.horizons),
            phases=phases,
            lags=config.lags,
            width=config.width,
            experts=config.experts,
            without=config.without,
            adam=config.adam,
        )
        self._train, self._model = config, GateModelConfig(network=sizes, every=every)
        self.network = GateNetwork(sizes)

    def gather(self, groups: Sequence[Sequence[wt.Run]], tell: Tell) -> GateExamples:
        train = self._train
        return gather(groups, self._model.network, starts=train.starts, seed=train.seed, tell=tell)

    def error(self, examples: GateExamples) -> Float[Tensor, ""]:
        return relative_error(self.network, examples)

    def save(self, out: Path) -> None:
        Gate(self.network, self._model).save(out)


def relative_error(network: GateNetwork, examples: GateExamples) -> Float[Tensor, ""]:
    """Squared error over mean squared displacement, mean over starts and horizons."""
    moved = network(
        examples.inputs.float(), examples.contexts.float(), examples.basis.float(), examples.tensor
    )
    known = examples.energy.isfinite() & (examples.energy > 0)
    target = examples.target.float().nan_to_num()
    squared = ((moved - target).square() * examples.weight[..., None]).sum(1)
    ratio = squared / torch.where(known, examples.energy, 1)
    error: Tensor = (ratio * known).sum() / known.sum().clamp(min=1)
    return error


__all__ = ["GateTrainConfig", "relative_error", "train_gate"]
