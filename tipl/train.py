"""Trains TIPL on the training runs of a data set."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import Progress
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

import weighttraj as wt
from tipl.errors import TrainError
from tipl.forecast import TIPL, TIPLConfig
from tipl.models.gpt import GPT, GPTConfig
from tipl.representation import TemporalSVD
from tipl.tokens import Batch, TokenRun, TokenSampler


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training. The defaults are the paper's, or Decision Transformer's where it is silent."""

    data: Path
    """Data set; its training split is used."""
    out: Path
    """Folder of the model. A training that stopped goes on where it was saved last."""
    rank: int = 32
    """Coefficients of the Temporal SVD in a token, d."""
    n_batches: int = 500_000
    """Batches in the whole training."""
    batch_size: int = 64
    """Windows in a batch."""
    learning_rate: float = 1e-4
    """Of AdamW, after the warm-up."""
    weight_decay: float = 1e-4
    """Of AdamW, on all parameters."""
    warmup: int = 10_000
    """Batches over which the learning rate rises linearly."""
    grad_clip: float = 0.25
    """Gradients are clipped to this norm."""
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
    seed: int = 0
    """Seed of initialisation, batches and dropout."""
    save_every: int = 1_000
    """Batches from one saved state, and one line of the log, to the next."""
    device: str = "cpu"
    """Torch device."""


def train(config: TrainConfig, *, console: Console | None = None) -> TIPL:
    """Train a model, or go on where the training stopped; a finished one is loaded.

    Batch n and its dropout are functions of (seed, n), so an interrupted training ends with the
    same parameters as an undisturbed one.

    Raises:
        TrainError: the data do not fit, the folder holds a training of other settings, or the loss
            is no longer finite.
    """
    runs = wt.open_dataset(config.data).split("train").runs
    sampler = _sampler(config, runs)
    tipl_config = _model_config(config, runs)
    torch.manual_seed(config.seed)
    model = GPT(tipl_config.gpt)
    mean, std = sampler.moments()
    model.input_mean.copy_(mean)
    model.input_std.copy_(std + 1e-6)
    _to_device(model, config.device)
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    _check_folder(config, runs)
    start = _load_state(config.out, model, optimizer)
    if start > config.n_batches:
        raise TrainError(
            "the folder holds a longer training than was asked for",
            expected=f"at most {config.n_batches} batches",
            got=start,
            where=config.out,
            do="raise --n-batches, or choose another --out",
        )
    forecaster = TIPL(model, tipl_config)
    with Progress(console=console or Console(quiet=True)) as progress:
        bar = progress.add_task("training", total=config.n_batches, completed=start)
        total, count = 0.0, 0
        for n in range(start, config.n_batches):
            total, count = total + _step(n, config, model, optimizer, sampler), count + 1
            progress.advance(bar)
            if (n + 1) % config.save_every == 0 or n + 1 == config.n_batches:
                _log(config.out, {"batch": n + 1, "wpe": total / count})
                _save_state(config.out, model, optimizer, n + 1)
                progress.update(bar, description=f"training, WPE {total / count:.3g}")
                total, count = 0.0, 0
    model.eval()
    forecaster.save(config.out)
    return forecaster


def _to_device(model: GPT, device: str) -> None:
    try:
        model.to(device)
    except (RuntimeError, AssertionError) as error:  # torch raises both
        raise TrainError(
            "this device cannot be used",
            expected="cpu, or a device that this build of torch and this machine have",
            got=f"{device!r}: {error}",
            do="choose another --device",
        ) from error


def weight_prediction_error(
    predicted: Float[Tensor, "batch window rank"], batch: Batch
) -> Float[Tensor, ""]:
    """Mean squared error of the policy's weights within the subspace, over unpadded rows.

    Directions are orthonormal, so ``P * MSE(phi, phi~) = sum_k sigma_k^2 (u_k - u~_k)^2``: the
    paper's loss needs no decoding.
    """
    squared = (predicted - batch.targets) ** 2 * batch.weights[:, None, :]
    return squared.sum(-1)[batch.mask].mean()


def _step(
    n: int,
    config: TrainConfig,
    model: GPT,
    optimizer: torch.optim.Optimizer,
    sampler: TokenSampler,
) -> float:
    """Gradient step number n; returns its loss."""
    model.train()
    torch.manual_seed(config.seed * 2**32 + n)
    for group in optimizer.param_groups:
        group["lr"] = config.learning_rate * min(1.0, (n + 1) / max(1, config.warmup))
    batch = sampler.batch(n).to(config.device)
    loss = weight_prediction_error(model(batch.tokens, batch.timesteps, batch.mask), batch)
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    clip_grad_norm_(model.parameters(), config.grad_clip)
    optimizer.step()
    value = loss.item()
    if not math.isfinite(value):
        raise TrainError(
            "the loss is no longer finite",
            got=value,
            where=f"batch {n}",
            do="lower --learning-rate; the state saved last is kept",
        )
    return value


def _sampler(config: TrainConfig, runs: list[wt.Run]) -> TokenSampler:
    tokens = []
    for run in runs:
        weights = run.weights[:]
        tokens.append(TokenRun.of(TemporalSVD.fit(weights, config.rank), weights))
    return TokenSampler(
        tokens, window=config.block_size, batch_size=config.batch_size, seed=config.seed
    )


def _model_config(config: TrainConfig, runs: list[wt.Run]) -> TIPLConfig:
    every = {run.info.cadence.every if run.info.cadence else None for run in runs}
    if len(every) > 1:
        raise TrainError(
            "the training runs have different cadences",
            expected="one number of gradient steps between snapshots",
            got=sorted(map(str, every)),
            where=config.data,
            do="train on one data set of one cadence",
        )
    longest = max(len(run) for run in runs)
    if config.n_embd % config.n_head or config.block_size > longest:
        raise TrainError(
            "these sizes make no model for these runs",
            expected=f"n_embd a multiple of n_head, block_size at most {longest} snapshots",
            got=f"n_embd {config.n_embd}, n_head {config.n_head}, block_size {config.block_size}",
            do="change --n-embd, --n-head or --block-size",
        )
    gpt = GPTConfig(
        rank=config.rank,
        # The last snapshot has no successor, so the network never sees its index.
        max_timestep=longest - 1,
        block_size=config.block_size,
        n_layer=config.n_layer,
        n_head=config.n_head,
        n_embd=config.n_embd,
        dropout=config.dropout,
    )
    return TIPLConfig(gpt=gpt, every=every.pop())


def _check_folder(config: TrainConfig, runs: list[wt.Run]) -> None:
    """Keep the settings beside the model, and refuse to go on with others, or on other data."""
    plain = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(config).items()}
    plain["runs"] = {r.id: hashlib.sha256(r["digest"][:].tobytes()).hexdigest() for r in runs}
    file = config.out / "train.json"
    if file.exists():
        old = json.loads(file.read_text())
        may_differ = ("out", "data", "device", "save_every", "n_batches")
        other = {k: v for k, v in plain.items() if old.get(k) != v and k not in may_differ}
        if other:
            raise TrainError(
                "the folder holds a training with other settings or data",
                expected={k: old.get(k) for k in other},
                got=other,
                where=config.out,
                do="choose another --out, or delete the folder",
            )
    config.out.mkdir(parents=True, exist_ok=True)
    draft = config.out / ".train.json.draft"
    draft.write_text(json.dumps(plain, indent=1))
    draft.replace(file)


def _save_state(out: Path, model: GPT, optimizer: torch.optim.Optimizer, n: int) -> None:
    """Everything that a later process needs to go on, in one file, replaced atomically."""
    tensors = {f"model.{name}": t for name, t in model.state_dict().items()}
    for i, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{i}.{name}": t for name, t in state.items()}
    tensors["n"] = torch.tensor(n)
    draft = out / ".state.safetensors.draft"
    save_file(tensors, draft)
    draft.replace(out / "state.safetensors")


def _load_state(out: Path, model: GPT, optimizer: torch.optim.Optimizer) -> int:
    """Batches done so far."""
    file = out / "state.safetensors"
    if not file.exists():
        return 0
    tensors = load_file(file)
    named = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
    model.load_state_dict(named, strict=True)
    states: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if key.startswith("optimizer."):
            _, i, name = key.split(".", 2)
            states.setdefault(int(i), {})[name] = tensor
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": states, "param_groups": groups})
    return int(tensors["n"])


def _log(out: Path, line: dict[str, Any]) -> None:
    with (out / "log.jsonl").open("a") as file:
        file.write(json.dumps(line) + "\n")
