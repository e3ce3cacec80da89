"""The training loop: batches, gradient steps, validation, checkpoints.

Batch n and its dropout are functions of (seed, n), so an interrupted training ends with the same
parameters as an undisturbed one: bit by bit on CPU, at a fixed number of threads. Under `torchrun`
each process takes its share of every batch.
"""

from __future__ import annotations

import contextlib
import gc
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.console import Console
from torch import Tensor, nn

from tipl.errors import TrainError
from tipl.threads import threads
from tipl.training.checkpoint import (
    Weights,
    append_log,
    cut_log,
    keep_settings,
    read_log,
    read_state,
    restore,
    save_state,
)
from tipl.training.config import LoopConfig
from tipl.training.parallel import Ranks, device_here, open_ranks
from tipl.training.progress import TrainingBar

E = TypeVar("E", bound="Examples")


@dataclass(frozen=True, kw_only=True)
class Examples:
    """Base of what a network is trained on: tensors whose first axis counts the examples."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self: E, rows: slice | Int[Tensor, " some"]) -> E:
        return self._each(lambda tensor: tensor[rows])

    def to(self: E, device: torch.device) -> E:
        """Return the same examples on a device."""
        return self._each(lambda tensor: tensor.to(device))

    def _each(self: E, change: Callable[[Tensor], Tensor]) -> E:
        return type(self)(**{f.name: change(getattr(self, f.name)) for f in fields(self)})


class Learner(ABC, Generic[E]):
    """A network, its batches and its loss: what the loop trains. Each kind of model has its own."""

    network: nn.Module
    """The network, as it is before training."""
    measure: ClassVar[str] = "error"
    """What the loss is called in the log."""

    def settings(self) -> Mapping[str, Any] | None:
        """Return all settings of the training, for ``train.json``; None: those of the loop."""
        return None

    def prepare(self, console: Console) -> None:
        """Read the examples. Called once, before the first batch; not if the training has ended."""

    @abstractmethod
    def batch(self, n: int) -> E:
        """Return batch n, a function of (seed, n) alone."""

    @abstractmethod
    def loss(
        self, network: Callable[..., Tensor], batch: E
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""] | Int[Tensor, ""]]:
        """Return a sum of errors over some examples and their count: the loss is the quotient.

        ``network`` is called in place of ``self.network``; ``batch`` may be a part of a batch.
        """

    def validation(self) -> Sequence[E]:
        """Return the examples of validation runs, in parts; none if there are no such runs."""
        return ()

    @abstractmethod
    def save(self, out: Path) -> None:
        """Write the forecaster into a folder, with the network as it is now."""


def train_network(
    build: Callable[[Ranks], Learner[Any]],
    config: LoopConfig,
    out: Path,
    *,
    defaults: Mapping[str, Any] | None = None,
    console: Console | None = None,
) -> None:
    """Train a network, or go on where its training stopped; do nothing if it has ended.

    Args:
        build: returns what is trained, given the processes that train together.
        config: how long and how.
        out: folder of the model.
        defaults: default settings, for those that an older training in the folder did not have.
        console: where progress is shown; None: nowhere.

    Raises:
        TrainError: the folder holds a training of other settings; the device, the precision or
            the compiler is missing; another process ended; or the loss is no longer finite.
    """
    config.check()
    quiet = Console(quiet=True)
    with (
        threads(config.threads),
        torch.random.fork_rng(devices=[]),
        open_ranks(config.device) as ranks,
    ):
        shown = (console if ranks.first else None) or quiet
        torch.manual_seed(config.seed)
        learner = build(ranks)
        settings = learner.settings() or vars(config)
        loop = _Loop(learner, config, out, ranks, shown)
        ranks.from_first(lambda: keep_settings(out, settings, config.may_differ, defaults))
        loop.run()
        ranks.from_first(lambda: None)  # the model is there when any process returns
        # The gradients' reducer holds the group of processes. If it outlives the group, torch waits
        # in its destructor for a thread that waits for Python, and the process never ends.
        del learner, loop
        gc.collect()


class _Loop(Generic[E]):
    def __init__(
        self, learner: Learner[E], config: LoopConfig, out: Path, ranks: Ranks, console: Console
    ) -> None:
        self._learner, self._config, self._out = learner, config, out
        self._ranks, self._console = ranks, console
        self._share = ranks.share(config.batch_size)
        self._device = _moved(learner.network, config.device)
        self._optimizer = torch.optim.AdamW(
            learner.network.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self._average: Weights | None = None
        if config.ema:
            self._average = {k: p.detach().clone() for k, p in learner.network.named_parameters()}

    def run(self) -> None:
        """Train from the last checkpoint to the end."""
        config, network = self._config, self._learner.network
        state = self._ranks.from_first(lambda: read_state(self._out))
        start = restore(state, network, self._optimizer, self._average)
        self._check_length(start)
        if self._ranks.first:
            cut_log(self._out, start)
        if start < config.n_batches:
            self._learner.prepare(self._console)
            self._network = self._wrapped()
            self._try_out()
            self._train(start)
        if self._ranks.first and config.keep == "last":
            with self._averaged():
                self._learner.save(self._out)
        network.eval()

    def _train(self, start: int) -> None:
        config, learner = self._config, self._learner
        if start == 0 and config.keep == "best":
            self._look(0, {})
        with TrainingBar(config.n_batches, start, self._console, learner.measure) as bar:
            total, count = 0.0, 0
            for n in range(start, config.n_batches):
                total, count = total + self.step(n), count + 1
                bar.count(total / count)
                if (n + 1) % config.save_every == 0 or n + 1 == config.n_batches:
                    line = {learner.measure: total / count, "batches_per_s": bar.speed}
                    self._look(n + 1, line)
                    bar.measure_again()
                    total, count = 0.0, 0

    def step(self, n: int) -> float:
        """Take gradient step n; return the loss of the whole batch before it."""
        config, network = self._config, self._learner.network
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate_at(n)
        loss = self._differentiate(n)
        if not math.isfinite(loss):
            raise TrainError(
                "the loss is no longer finite",
                got=loss,
                where=f"batch {n}",
                do="lower --learning-rate; the last checkpoint is kept",
            )
        nn.utils.clip_grad_norm_(network.parameters(), config.grad_clip)
        self._optimizer.step()
        if self._average is not None:
            parameters = dict(network.named_parameters())
            for name, mean in self._average.items():
                mean.lerp_(parameters[name].detach(), 1 - config.ema)
        return loss

    def _differentiate(self, n: int) -> float:
        """Compute the gradient of batch n, and return its loss; both are those of all shares."""
        config, ranks = self._config, self._ranks
        torch.manual_seed(_seed(config.seed, n, ranks.rank))  # dropout
        batch = self._learner.batch(n)[self._share].to(self._device)
        bfloat16 = config.dtype == "bfloat16"
        with torch.autocast(self._device.type, dtype=torch.bfloat16, enabled=bfloat16):
            error, count = self._learner.loss(self._network, batch)
        whole = ranks.sum(count.detach().to(error.dtype))
        self._optimizer.zero_grad()
        # DDP takes the mean of the gradients; the shares are parts of a sum.
        with ranks.talking():
            (error * ranks.world / whole).backward()  # type: ignore[no-untyped-call]
        return float(ranks.sum(error.detach()) / whole)

    def _look(self, n: int, line: dict[str, float]) -> None:
        """Validate, keep the model if it is the best so far, and write a checkpoint."""
        if not self._ranks.first:
            return
        config, out, learner = self._config, self._out, self._learner
        key = f"validation_{learner.measure}"
        with self._averaged():
            if (held_out := self._validate()) is not None:
                line = line | {key: held_out}
            best = min((row[key] for row in read_log(out) if key in row), default=math.inf)
            # The state before training is the first candidate, whatever its error.
            if config.keep == "best" and (n == 0 or line.get(key, -math.inf) < best):
                learner.save(out)
        append_log(out, {"batch": n, **line})
        save_state(out, learner.network, self._optimizer, n, self._average)

    @torch.no_grad()
    def _validate(self) -> float | None:
        """Return the error on validation runs, without dropout; None: there are none."""
        network, error, count = self._learner.network, 0.0, 0.0
        network.eval()
        for part in self._learner.validation():
            summed, counted = self._learner.loss(network, part.to(self._device))
            error, count = error + summed.item(), count + counted.item()
        network.train()
        return error / count if count else None

    @contextlib.contextmanager
    def _averaged(self) -> Iterator[None]:
        """Put the average of the weights in place of the weights for a while."""
        if self._average is None:
            yield
            return
        parameters = dict(self._learner.network.named_parameters())
        kept = {name: p.detach().clone() for name, p in parameters.items()}
        with torch.no_grad():
            for name, mean in self._average.items():
                parameters[name].copy_(mean)
            try:
                yield
            finally:
                for name, weights in kept.items():
                    parameters[name].copy_(weights)

    def _wrapped(self) -> Callable[..., Tensor]:
        network = self._learner.network.train()
        if self._ranks.world > 1:
            network = nn.parallel.DistributedDataParallel(network, broadcast_buffers=False)
        return torch.compile(network) if self._config.compile else network

    def _try_out(self) -> None:
        """Differentiate one batch, so that what this machine cannot do is known at the start."""
        config = self._config
        if (str(self._device), config.dtype, config.compile) == ("cpu", "float32", False):
            return
        try:
            self._differentiate(0)
        except Exception as error:  # torch raises anything here, compilers too
            raise _cannot(config, error) from error

    def _check_length(self, start: int) -> None:
        if start > self._config.n_batches:
            raise TrainError(
                "the folder holds a longer training than was asked for",
                expected=f"at most {self._config.n_batches} batches",
                got=start,
                where=self._out,
                do="raise --n-batches, or choose another --out",
            )


def _moved(network: nn.Module, wanted: str) -> torch.device:
    """Move a network to its device."""
    device = device_here(wanted)
    try:
        network.to(device)
        return torch.device(device)
    except (RuntimeError, AssertionError) as error:  # torch raises both
        raise TrainError(
            "this device cannot be used",
            expected="cpu, or a device that this build of torch and this machine have",
            got=f"{device!r}: {error}",
            do="choose another --device",
        ) from error


def _seed(*numbers: int) -> int:
    """Return one seed for several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0])


def _cannot(config: LoopConfig, error: Exception) -> TrainError:
    lines = [line for line in str(error).splitlines() if line.strip()]
    got = f"{type(error).__name__}: {' '.join(lines[:3])}"
    where = f"--device {config.device} --dtype {config.dtype}"
    if config.compile:
        return TrainError(
            "the network cannot be compiled here",
            expected="a C++ compiler; for cuda Triton and a C compiler",
            got=got,
            where=where,
            do="install what is missing (g++, say), or leave --compile out",
        )
    return TrainError(
        "this device cannot train the network in this precision",
        expected="a device that knows the precision and has memory for a batch",
        got=got,
        where=where,
        do="choose --dtype float32, or another --device",
    )
