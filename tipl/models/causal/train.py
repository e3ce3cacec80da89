"""Trains tipl-causal on the training runs of one or several data sets."""

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
from tipl.models.causal.data import CausalExamples, examples_of
from tipl.models.causal.forecaster import Causal
from tipl.models.causal.network import CausalConfig, CausalGPT
from tipl.settings import check_heads, check_settings
from tipl.training import LoopConfig
from tipl.training.starts import Example, StartsConfig, StartsLearner, train_on_starts

NETWORK = CausalConfig()
LOOP = LoopConfig(n_batches=4_000, batch_size=64, learning_rate=1e-3)
"""Minutes on one core."""


@dataclass(frozen=True, kw_only=True)
class CausalTrainConfig(StartsConfig):
    """What is trained on, and where the model goes."""

    network: CausalConfig = NETWORK
    """Sizes of the network."""
    training: LoopConfig = LOOP
    """How the network is trained."""

    def check(self) -> None:
        """Refuse numbers that make no training or no network."""
        super().check()
        sizes = ("horizons", "rank", "window", "block_size", "n_layer", "n_head", "n_embd")
        check_settings(vars(self.network), dict.fromkeys(sizes, 1) | {"phases": 0}, TrainError)
        check_heads(self.network.n_embd, self.network.n_head, TrainError)


class CausalLearner(StartsLearner[CausalExamples]):
    """The network of tipl-causal, its examples and its loss."""

    model = Causal
    examples_type = CausalExamples
    network: CausalGPT

    def examples_of(self, run: wt.Run, rng: np.random.Generator) -> Iterable[Example]:
        """Return the examples of one run."""
        return examples_of(run, self.model_config.network, self.config.starts, rng)

    def loss(
        self, network: Callable[..., Tensor], batch: CausalExamples
    ) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
        """Return squared error over squared displacement, summed, and the number of known cells."""
        moved = network(batch.tokens, batch.phases, batch.mask, batch.state).float()
        known = batch.energy.isfinite() & (batch.energy > 0)
        energy = torch.where(known, batch.energy, 1)
        # What leaves the basis is lost in any case.
        outside = energy - batch.target.square().sum(2)
        ratio = ((moved - batch.target).square().sum(2) + outside) / energy  # (start, horizon)
        return (ratio * known).sum(), known.sum().clamp(min=1)


def train_causal(config: CausalTrainConfig, *, console: Console | None = None) -> Causal:
    """Train tipl-causal: TIPL with a Temporal SVD of the path before the forecast alone.

    With the default settings it takes minutes on one core. A training that was stopped goes on with
    the same command; one that has ended is loaded.

    Example: tipl train causal --data hopper-v4-ppo-16x16-v1 --out data/my-causal

    Raises:
        TrainError: the data sets have no runs to train on, or different cadences; or as
            ``train_network``.
        RepresentationError: a run has too few directions.
    """
    train_on_starts(CausalLearner, config, console)
    return Causal.load(config.out)


def refit(old: Causal, runs: Sequence[wt.Run], config: RefitConfig) -> Causal:
    """Train a Transformer of the same sizes on other runs, for the null check."""
    return train_causal(refit_settings(CausalTrainConfig, LOOP, old.config.network, runs, config))
