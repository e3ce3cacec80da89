"""Trains TIPL on the training runs of a data set, in one process or in several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxtyping import Float, Int
from rich.console import Console
from torch import Tensor

import weighttraj as wt
from tipl.checks.copies import RefitConfig, as_dataset
from tipl.errors import TrainError
from tipl.models.tipl.data import Prepared, TokenSampler, Windows, prepare
from tipl.models.tipl.forecaster import TIPL, TIPLConfig
from tipl.models.tipl.network import GPT, GPTConfig
from tipl.settings import check_heads, check_settings
from tipl.training import Learner, LoopConfig, train_network
from tipl.training.config import defaults_of, flat
from tipl.training.parallel import Ranks

VALIDATION_SHARE = 0.01
"""Share of the training's time for validation. A forward pass takes a third of a step."""
NETWORK = GPTConfig()
"""Decision Transformer's sizes."""
LOOP = LoopConfig(
    n_batches=500_000,
    batch_size=64,
    learning_rate=1e-4,
    warmup=10_000,
    schedule="constant",
    weight_decay=1e-4,
    grad_clip=0.25,
    keep="last",
    save_every=1_000,
)
"""The paper's length and batch; the optimizer is Decision Transformer's."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """What is trained on, and where the model goes.

    The paper fixes its length, 50 iterations of 10,000 batches, and the 64 windows of a batch.
    Sizes and optimizer are Decision Transformer's, on whose code the paper builds. Our choices: the
    rank, the seed, and when to save.
    """

    data: str | Path
    """Data set; its training split is used."""
    out: Path
    """Folder of the model. A training that stopped goes on from its last checkpoint."""
    network: GPTConfig = NETWORK
    """Sizes of the network."""
    training: LoopConfig = LOOP
    """How it is trained."""

    def check(self) -> None:
        """Refuse sizes that make no network.

        Raises:
            TrainError: a size is too small or too large, or does not fit another one.
        """
        sizes = ("rank", "block_size", "n_layer", "n_head", "n_embd")
        least = dict.fromkeys(sizes, 1) | {"dropout": 0, "max_timestep": 0}
        check_settings(vars(self.network), least, TrainError)
        check_heads(self.network.n_embd, self.network.n_head, TrainError)
        if self.network.dropout >= 1:
            raise TrainError(
                "nothing is left after a dropout of 1",
                expected="dropout below 1",
                got=self.network.dropout,
                do="choose a smaller --dropout",
            )


def train(config: TrainConfig, *, console: Console | None = None) -> TIPL:
    """Train TIPL, the Transformer of the paper, on one data set.

    A training of the paper's length (500,000 batches) takes half a day on one core, a first curve
    minutes: see --n-batches. A training that was stopped goes on with the same command; one that
    has ended is loaded.

    Example: tipl train tipl --data inverted-pendulum-v4-ppo-v1 --out data/my-tipl --n-batches 2000

    With two processes: torchrun --standalone --nproc-per-node 2 -m tipl train tipl --data DATA
    --out OUT. Each process takes its share of every batch; only rounding and dropout differ.

    Each line of the log has the mean WPE on training windows since the line before, with dropout,
    and the WPE one step ahead on validation runs, if there are any, without dropout. By default the
    latter does not choose the model, because the paper has no validation runs.

    Raises:
        TrainError: the data do not fit, or as ``train_network``.
    """
    config.check()
    train_network(
        lambda ranks: TIPLLearner(config, ranks),
        config.training,
        config.out,
        defaults=defaults_of(config),
        console=console,
    )
    return TIPL.load(config.out)


class TIPLLearner(Learner[Windows]):
    """The Transformer, windows of coefficients, and the paper's loss."""

    network: GPT
    measure = "wpe"

    def __init__(self, config: TrainConfig, ranks: Ranks) -> None:
        sizes, training = config.network, config.training
        self._config = config
        self.prepared = ranks.from_first(
            lambda: prepare(config.data, rank=sizes.rank, window=sizes.block_size)
        )
        self._sampler = TokenSampler(
            self.prepared.train,
            window=sizes.block_size,
            batch_size=training.batch_size,
            seed=training.seed,
        )
        self.model_config = _model_config(config, self.prepared)
        self.network = GPT(self.model_config.gpt)
        # Coefficients are standardised as Decision Transformer's states are (our choice: by their
        # moments over all training runs).
        mean, std = self._sampler.moments()
        self.network.input_mean.copy_(mean)
        self.network.input_std.copy_(std + 1e-6)
        if sizes.residual:
            self.network.step_std.copy_(self._sampler.step_size())

    def settings(self) -> dict[str, Any]:
        """Return what train.json says of the training."""
        return flat(self._config) | {"runs": self.prepared.checksums}

    def batch(self, n: int) -> Windows:
        """Return random windows of the training runs."""
        return self._sampler.batch(n)

    def loss(
        self, network: Callable[..., Tensor], batch: Windows
    ) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
        """Return the summed squared error of the weights, and the number of predicted snapshots."""
        predicted = network(batch.tokens, batch.timesteps, batch.mask)
        return weight_prediction_error(predicted.float(), batch), batch.mask.sum()

    def validation(self) -> Sequence[Windows]:
        """Return windows of the validation runs, few enough to cost little time."""
        if not self.prepared.validation:
            return ()
        training = self._config.training
        sampler = TokenSampler(
            self.prepared.validation,
            window=self._config.network.block_size,
            batch_size=training.batch_size,
            seed=0,
        )
        most = max(1, int(3 * VALIDATION_SHARE * training.save_every))
        return sampler.tiles(most * training.batch_size)

    def save(self, out: Path) -> None:
        """Write the model."""
        TIPL(self.network, self.model_config).save(out)


def weight_prediction_error(
    predicted: Float[Tensor, "batch window rank"], batch: Windows
) -> Float[Tensor, ""]:
    """Return the WPE of policy weights within the subspace, summed over rows without padding.

    Directions are orthonormal, so ``P * MSE(phi, phi~) = sum_k sigma_k^2 (u_k - u~_k)^2``: the
    paper's loss needs no decoding. The singular values are those of each window's run.
    """
    squared = (predicted - batch.targets) ** 2 * batch.weights[:, None, :]
    return (squared.sum(-1) * batch.mask).sum()


def _model_config(config: TrainConfig, prepared: Prepared) -> TIPLConfig:
    # The last snapshot has no successor, so the network never sees its index.
    needed = prepared.longest - 1
    wanted = config.network.max_timestep
    if wanted and wanted < needed:
        raise TrainError(
            "some snapshots would have no time embedding",
            expected=f"max_timestep of at least {needed}, or 0",
            got=wanted,
            where=config.data,
            do="raise --max-timestep, or leave it out",
        )
    gpt = replace(config.network, max_timestep=wanted or needed)
    return TIPLConfig(gpt=gpt, every=prepared.every, parameters=prepared.parameters)


def refit(old: TIPL, runs: Sequence[wt.Run], config: RefitConfig) -> TIPL:
    """Train a Transformer of the same sizes on other runs, for the null check."""
    loop = replace(
        LOOP,
        n_batches=config.batches,
        warmup=max(1, config.batches // 10),
        seed=config.seed,
    )
    return train(
        TrainConfig(
            data=as_dataset(runs, config.folder / "walks"),
            out=config.folder / "refit",
            network=replace(old.config.gpt, max_timestep=0),  # that of the walks
            training=loop,
        )
    )
