"""Trains TIPL on the training runs of a data set, in one process or in several."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from rich.console import Console
from torch import Tensor

from tipl.distributed import Ranks, device_here, open_ranks
from tipl.errors import TrainError
from tipl.forecast import TIPL, TIPLConfig
from tipl.models.gpt import GPT, GPTConfig
from tipl.prepare import Prepared, prepare
from tipl.progress import TrainingBar
from tipl.settings import check_heads, check_settings
from tipl.state import append_log, cut_log, keep_settings, read_state, restore, save_state
from tipl.step import StepConfig, Stepper, weight_prediction_error
from tipl.threads import threads
from tipl.tokens import Batch, TokenSampler

# What may differ from one start of a training to the next: it moves roundings at most.
MAY_DIFFER = ("out", "data", "device", "compile", "threads", "save_every", "n_batches")
# Of the training's time, for the error on validation runs. A forward pass is a third of a step.
VALIDATION_SHARE = 0.01


@dataclass(frozen=True, kw_only=True)
class TrainConfig(StepConfig):
    """One training.

    The paper fixes its length, 50 iterations of 10,000 batches, and the 64 windows of a batch.
    Sizes and optimizer are Decision Transformer's, on whose code the paper builds. Ours: the rank,
    the seed, and when to save.
    """

    data: str | Path
    """Data set; its training split is used."""
    out: Path
    """Folder of the model. A training that stopped goes on where it was saved last."""
    rank: int = 32
    """Coefficients of the Temporal SVD in a token, d."""
    n_batches: int = 500_000
    """Batches in the whole training."""
    block_size: int = 20
    """Snapshots in a window, K."""
    n_layer: int = 3
    """Transformer blocks."""
    n_head: int = 1
    """Attention heads."""
    n_embd: int = 128
    """Width of the Transformer."""
    dropout: float = 0.1
    """Dropout."""
    save_every: int = 1_000
    """Batches from one saved state, and one line of the log, to the next."""
    threads: int = 1
    """CPU threads of each process. Several help on idle cores only; `torchrun` uses more cores."""


def train(config: TrainConfig, *, console: Console | None = None) -> TIPL:
    """Train a model, or go on where the training stopped; a finished one is loaded.

    Batch n and its dropout are functions of (seed, n), so an interrupted training ends with the
    same parameters as an undisturbed one: bit by bit on CPU, at a fixed number of threads.

    Under `torchrun` each process takes its share of every batch, and the training is the same but
    for rounding. It can go on with another number of processes::

        torchrun --nproc-per-node 2 -m tipl.cli train --data DATA --out OUT

    Each line of the log has the mean training WPE since the line before, with dropout; and, where
    the data set has a validation split, the WPE one step ahead on its runs, without dropout. No
    model is chosen by it: the paper has none.

    Raises:
        TrainError: the data do not fit, the folder holds a training of other settings, the device,
            precision or compiler cannot be had, another process ended, or the loss is no longer
            finite.
    """
    _check_sizes(config)
    with threads(config.threads), open_ranks(config.device) as ranks:
        shown = console if ranks.first else None
        return _train(config, ranks, shown or Console(quiet=True))


def _train(config: TrainConfig, ranks: Ranks, console: Console) -> TIPL:
    prepared = ranks.from_first(
        lambda: prepare(config.data, rank=config.rank, window=config.block_size)
    )
    tipl_config = _model_config(config, prepared)
    sampler = _sampler(config, prepared)
    model = _model(config, tipl_config.gpt, sampler)
    stepper = Stepper(model, sampler, config, ranks)
    stepper.try_out()
    state = ranks.from_first(lambda: _open_folder(config, prepared))
    start = restore(state, model, stepper.optimizer)
    tiles = _tiles(config, prepared) if ranks.first else []
    with TrainingBar(config.n_batches, start, console) as bar:
        total, count = 0.0, 0
        for n in range(start, config.n_batches):
            total, count = total + stepper.step(n), count + 1
            bar.advance(total / count)
            if (n + 1) % config.save_every == 0 or n + 1 == config.n_batches:
                if ranks.first:
                    line = {"batch": n + 1, "wpe": total / count, "batches_per_s": bar.speed}
                    append_log(config.out, line | _validate(model, tiles))
                    save_state(config.out, model, stepper.optimizer, n + 1)
                bar.restart()
                total, count = 0.0, 0
    model.eval()
    forecaster = TIPL(model, tipl_config)
    # The model is there when any rank returns.
    ranks.from_first(lambda: forecaster.save(config.out))
    return forecaster


def _check_sizes(config: TrainConfig) -> None:
    sizes = ("rank", "n_batches", "batch_size", "block_size", "n_layer", "n_head", "n_embd")
    rates = ("learning_rate", "weight_decay", "warmup", "grad_clip", "dropout", "seed")
    least = dict.fromkeys((*sizes, "save_every", "threads"), 1) | dict.fromkeys(rates, 0)
    check_settings(vars(config), least, TrainError)
    check_heads(config.n_embd, config.n_head, TrainError)
    if config.dropout >= 1:
        raise TrainError(
            "a dropout of all makes no training",
            expected="dropout below 1",
            got=config.dropout,
            do="choose a smaller --dropout",
        )


def _model_config(config: TrainConfig, prepared: Prepared) -> TIPLConfig:
    gpt = GPTConfig(
        rank=config.rank,
        # The last snapshot has no successor, so the network never sees its index.
        max_timestep=prepared.longest - 1,
        block_size=config.block_size,
        n_layer=config.n_layer,
        n_head=config.n_head,
        n_embd=config.n_embd,
        dropout=config.dropout,
    )
    return TIPLConfig(gpt=gpt, every=prepared.every, parameters=prepared.parameters)


def _sampler(config: TrainConfig, prepared: Prepared) -> TokenSampler:
    return TokenSampler(
        prepared.train, window=config.block_size, batch_size=config.batch_size, seed=config.seed
    )


def _model(config: TrainConfig, gpt: GPTConfig, sampler: TokenSampler) -> GPT:
    """The network as it is before the first step, on its device.

    Ours: coefficients are standardised as Decision Transformer's states are, by their moments over
    all training runs.
    """
    torch.manual_seed(config.seed)
    model = GPT(gpt)
    mean, std = sampler.moments()
    model.input_mean.copy_(mean)
    model.input_std.copy_(std + 1e-6)
    device = device_here(config.device)
    try:
        model.to(device)
    except (RuntimeError, AssertionError) as error:  # torch raises both
        raise TrainError(
            "this device cannot be used",
            expected="cpu, or a device that this build of torch and this machine have",
            got=f"{device!r}: {error}",
            do="choose another --device",
        ) from error
    return model


def _open_folder(config: TrainConfig, prepared: Prepared) -> dict[str, Tensor]:
    """Check the folder and make it ready; returns the state to go on from, or nothing."""
    plain = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(config).items()}
    keep_settings(config.out, plain | {"runs": prepared.digests}, MAY_DIFFER, config)
    state = read_state(config.out)
    start = int(state["n"]) if state else 0
    if start > config.n_batches:
        raise TrainError(
            "the folder holds a longer training than was asked for",
            expected=f"at most {config.n_batches} batches",
            got=start,
            where=config.out,
            do="raise --n-batches, or choose another --out",
        )
    cut_log(config.out, start)
    return state


def _tiles(config: TrainConfig, prepared: Prepared) -> list[Batch]:
    """Windows of the validation runs, few enough to cost little."""
    if not prepared.validation:
        return []
    sampler = TokenSampler(
        prepared.validation, window=config.block_size, batch_size=config.batch_size, seed=0
    )
    most = max(1, int(3 * VALIDATION_SHARE * config.save_every)) * config.batch_size
    return sampler.tiles(most)


@torch.no_grad()
def _validate(model: GPT, tiles: list[Batch]) -> dict[str, float]:
    """WPE one step ahead, teacher forced, without dropout, for the log."""
    if not tiles:
        return {}
    total = 0.0
    for tile in tiles:
        batch = tile.to(model.input_mean.device)
        predicted = model(batch.tokens, batch.timesteps, batch.mask)
        total += weight_prediction_error(predicted, batch).item()
    return {"validation_wpe": total}
