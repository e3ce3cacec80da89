"""One gradient step, on any device, alone or together with other ranks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from tipl.distributed import Ranks
from tipl.errors import TrainError
from tipl.models.dropout import keep_factors
from tipl.models.gpt import GPT
from tipl.tokens import Batch, TokenSampler


@dataclass(frozen=True, kw_only=True)
class StepConfig:
    """How the parameters are moved. Defaults: Decision Transformer's, where the paper is silent."""

    batch_size: int = 64
    """Windows in a batch, over all processes."""
    learning_rate: float = 1e-4
    """Of AdamW, after the warm-up."""
    weight_decay: float = 1e-4
    """Of AdamW, on all parameters."""
    warmup: int = 10_000
    """Batches over which the learning rate rises linearly."""
    grad_clip: float = 0.25
    """Gradients are clipped to this norm."""
    seed: int = 0
    """Seed of initialisation, batches and dropout."""
    device: str = "cpu"
    """Torch device. ``cuda`` under `torchrun`: a GPU of its own for each process."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of products: bfloat16 by autocast, the parameters stay float32."""
    compile: bool = False
    """Compile the network with torch.compile: needs a C++ compiler, and Triton for cuda."""


class Stepper:
    """Moves the parameters of a model, batch by batch.

    Ours, where the paper is silent: AdamW on all parameters alike, a linear warm-up, and the
    gradient clipped as a whole, all as in Decision Transformer; the loss is the mean over all
    unpadded rows of the batch, and each window weighs errors with its own run's singular values.

    Args:
        model: the network, on its device.
        sampler: batches by their number.
        config: how to move.
        ranks: the processes that share each batch.
    """

    def __init__(self, model: GPT, sampler: TokenSampler, config: StepConfig, ranks: Ranks) -> None:
        self.model, self._sampler, self._config, self._ranks = model, sampler, config, ranks
        self._device = model.input_mean.device
        self._network: Callable[..., Tensor] = torch.compile(model) if config.compile else model
        self._rows = ranks.share(config.batch_size)
        parameters = list(model.parameters())
        self.optimizer = torch.optim.AdamW(
            parameters, lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
        )
        # All gradients and the loss lie in one vector: one sum over ranks, one norm, one product.
        self._sums = torch.zeros(sum(p.numel() for p in parameters) + 1, device=self._device)
        self._gradient = self._sums[:-1]
        pieces = torch.split(self._gradient, [p.numel() for p in parameters])
        for p, piece in zip(parameters, pieces, strict=True):
            p.grad = piece.view_as(p)

    def step(self, n: int) -> float:
        """Gradient step number n; returns its loss.

        Raises:
            TrainError: the loss is no longer finite, or another rank has ended.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self._config.learning_rate * min(
                1.0, (n + 1) / max(1, self._config.warmup)
            )
        self._differentiate(n)
        self._ranks.add(self._sums)
        loss = self._sums[-1].item()
        if not math.isfinite(loss):
            raise TrainError(
                "the loss is no longer finite",
                got=loss,
                where=f"batch {n}",
                do="lower --learning-rate; the state saved last is kept",
            )
        norm = torch.linalg.vector_norm(self._gradient)
        self._gradient.mul_((self._config.grad_clip / (norm + 1e-6)).clamp(max=1.0))
        self.optimizer.step()
        return loss

    def try_out(self) -> None:
        """Differentiate one batch, so that what this machine cannot do is known at the start.

        Raises:
            TrainError: the compiler, the precision or the device cannot be had.
        """
        config = self._config
        if (str(self._device), config.dtype, config.compile) == ("cpu", "float32", False):
            return
        try:
            self._differentiate(0)
        except Exception as error:  # torch raises anything here, compilers too
            raise TrainError(
                "the network cannot be compiled here"
                if config.compile
                else "this device cannot train the network in this precision",
                expected="a C++ compiler; for cuda Triton and a C compiler"
                if config.compile
                else "a device that knows the precision and has memory for a batch",
                got=_first_lines(error),
                where=f"--device {config.device} --dtype {config.dtype}",
                do="install what is missing (g++, say), or leave --compile out"
                if config.compile
                else "choose --dtype float32, or another --device",
            ) from error

    def _differentiate(self, n: int) -> None:
        """The gradient and the loss of this rank's share of batch n."""
        config = self._config
        keep = keep_factors(
            self.model.config.dropout,
            self.model.config.dropped,
            seed=config.seed,
            n=n,
            batch=config.batch_size,
            rows=self._rows,
        )
        if keep is not None:
            keep = tuple(factors.to(self._device) for factors in keep)
        batch = self._sampler.batch(n).share(self._rows).to(self._device)
        with torch.autocast(
            self._device.type, dtype=torch.bfloat16, enabled=config.dtype == "bfloat16"
        ):
            predicted = self._network(batch.tokens, batch.timesteps, batch.mask, keep)
        loss = weight_prediction_error(predicted.float(), batch)
        self._sums.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        self._sums[-1] = loss.detach()


def weight_prediction_error(
    predicted: Float[Tensor, "batch window rank"], batch: Batch
) -> Float[Tensor, ""]:
    """Mean squared error of the policy's weights within the subspace, over unpadded rows.

    Directions are orthonormal, so ``P * MSE(phi, phi~) = sum_k sigma_k^2 (u_k - u~_k)^2``: the
    paper's loss needs no decoding. Of a share of a batch: its part of the mean.
    """
    squared = (predicted - batch.targets) ** 2 * batch.weights[:, None, :]
    return (squared.sum(-1) * batch.mask).sum() / batch.rows


def _first_lines(error: Exception) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {' '.join(lines[:3])}"
