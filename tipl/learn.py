"""Trains a network on starts of runs: what is the same for every model of ours.

Each start counts with its own relative error, the squared error over the squared displacement, so
that 1 is persistence. The runs of the validation split choose the state that is kept, persistence
among the candidates. Batch n is a function of (seed, n), so an interrupted training ends with the
same parameters as an undisturbed one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from torch import Tensor, nn

import weighttraj as wt
from tipl.baselines.horizons import HORIZONS
from tipl.errors import TrainError
from tipl.prepare import digest_of
from tipl.progress import TrainingBar
from tipl.settings import check_settings
from tipl.state import append_log, cut_log, keep_settings, read_log, read_state, restore, save_state
from tipl.threads import threads
from weighttraj.progress import LoggedProgress

MAY_DIFFER = ("out", "data")
"""Settings that may change from one start of a training to the next."""
LOOK_AT = 64
"""Examples of validation runs that are judged at a time."""

E = TypeVar("E", bound="Examples")
Tell = Callable[[wt.Run], None]
"""Hears of each run that was read."""


@runtime_checkable
class Examples(Protocol):
    """Starts that are learnt from."""

    @property
    def group(self) -> Int[Tensor, " start"]:
        """Data set of each, from 0, rising."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self: E, rows: Int[Tensor, " some"], /) -> E: ...


@dataclass(frozen=True, kw_only=True)
class LearnConfig:
    """One training."""

    data: tuple[str | Path, ...]
    """Data sets: paths or ids. The training split of each is learnt from, in equal shares; the
    runs of its validation split choose which state is kept."""
    out: Path
    """Folder of the model. A training that stopped goes on where it was saved last."""
    horizons: tuple[int, ...] = HORIZONS
    """Snapshots ahead."""
    starts: int = 600
    """Starts of each run that are learnt from, about."""
    n_batches: int = 4_000
    """Batches in the whole training."""
    batch_size: int = 32
    """Starts in a batch."""
    learning_rate: float = 3e-3
    """Of AdamW at its highest; it rises over the first tenth and falls along a cosine."""
    weight_decay: float = 1e-3
    """Of AdamW."""
    grad_clip: float = 1.0
    """Gradients are clipped to this norm."""
    validate_every: int = 200
    """Batches from one look at the validation runs to the next; the best state is kept."""
    seed: int = 0
    """Of starts, initialisation and batches."""

    def check(self) -> None:
        """Refuse numbers that make no training.

        Raises:
            TrainError: one is too small.
        """
        at_least_1 = ("horizons", "starts", "n_batches", "batch_size", "validate_every")
        at_least_0 = ("learning_rate", "weight_decay", "grad_clip", "seed")
        least = dict.fromkeys(at_least_1, 1) | dict.fromkeys(at_least_0, 0)
        check_settings(vars(self), least, TrainError)


class Learner(ABC, Generic[E]):
    """A network, and how it learns."""

    network: nn.Module
    """Persistence before training."""

    @abstractmethod
    def gather(self, groups: Sequence[Sequence[wt.Run]], tell: Tell) -> E:
        """Examples from the runs of each data set.

        Raises:
            TrainError: no run is long enough for each horizon.
        """

    @abstractmethod
    def error(self, examples: E) -> Float[Tensor, ""]:
        """Squared error over squared displacement, mean over starts and horizons."""

    @abstractmethod
    def save(self, out: Path) -> None:
        """Write the forecaster into a folder."""


def learn(
    config: LearnConfig,
    build: Callable[[Sequence[wt.Run]], Learner[E]],
    *,
    console: Console | None = None,
) -> None:
    """Train, or go on where the training stopped; nothing is done if it had ended.

    Args:
        config: on what, and how long.
        build: makes what is trained; is told of the training runs.
        console: where progress is shown; None: nowhere.

    Raises:
        TrainError: the data sets have no runs to train on, or different cadences; a number is too
            small; or the folder holds a training with other settings.
    """
    config.check()
    with threads(), torch.random.fork_rng(devices=[]):
        _Training(config, build, console or Console(quiet=True)).run()


def cadence_of(runs: Sequence[wt.Run]) -> tuple[int | None, int]:
    """Gradient steps from one snapshot to the next, and snapshots in an iteration.

    Raises:
        TrainError: the runs differ.
    """
    cadences = {run.info.cadence.every if run.info.cadence else None for run in runs}
    if len(cadences) != 1:
        raise TrainError(
            "the runs have different cadences",
            expected="one number of gradient steps from one snapshot to the next",
            got=sorted(map(str, cadences)),
            do="train on runs of one cadence",
        )
    return cadences.pop(), max(int(run.phase.max()) + 1 for run in runs)


def draw_starts(length: int, count: int, rng: np.random.Generator) -> list[int]:
    """Starts from 1 to the last but one, each once; half evenly in time, half on a logarithmic
    scale: the learning phase is short."""
    last = length - 2
    if last < 1:
        return []
    u = rng.uniform(size=count)
    even, early = 1 + u * last, np.exp(u * np.log(last + 1))
    drawn = np.where(np.arange(count) % 2, even, early).astype(int)
    return np.unique(np.clip(drawn, 1, last)).tolist()  # type: ignore[no-any-return]


def too_short(horizons: Sequence[int]) -> TrainError:
    """The error of runs that end before the last horizon."""
    return TrainError(
        "the runs are too short to train for each horizon",
        expected=f"runs of more than {max(horizons) + 2} snapshots",
        do="train for fewer horizons, or collect longer runs",
    )


class _Training(Generic[E]):
    def __init__(
        self,
        config: LearnConfig,
        build: Callable[[Sequence[wt.Run]], Learner[E]],
        console: Console,
    ) -> None:
        self._config, self._console = config, console
        datasets = [wt.open_dataset(data) for data in config.data]
        self._train = [dataset.split("train").runs for dataset in datasets]
        self._held_out = [
            [run for run in dataset if run.split == "validation"] for dataset in datasets
        ]
        settings = asdict(config) | {
            "data": [str(data) for data in config.data],
            "out": str(config.out),
            "runs": [{run.id: digest_of(run) for run in group} for group in self._train],
        }
        torch.manual_seed(config.seed)
        self._learner = build([run for group in self._train for run in group])
        keep_settings(config.out, settings, MAY_DIFFER, config)
        self._optimizer = torch.optim.AdamW(
            self._learner.network.parameters(), weight_decay=config.weight_decay
        )

    def run(self) -> None:
        config = self._config
        start = restore(read_state(config.out), self._learner.network, self._optimizer)
        cut_log(config.out, start)
        if start == config.n_batches:
            return
        examples = self._gather(self._train)
        held_out = self._gather(self._held_out) if any(self._held_out) else None
        if start == 0:  # persistence is the first candidate
            self._look(held_out, 0, {})
        with TrainingBar(config.n_batches, start, self._console, "relative error") as bar:
            total, count = 0.0, 0
            for n in range(start, config.n_batches):
                total, count = total + self._step(examples, n), count + 1
                bar.advance(total / count)
                if (n + 1) % config.validate_every == 0 or n + 1 == config.n_batches:
                    self._look(held_out, n + 1, {"error": total / count})
                    bar.restart()
                    total, count = 0.0, 0

    def _gather(self, groups: Sequence[Sequence[wt.Run]]) -> E:
        columns = (TextColumn("reading runs"), BarColumn(), MofNCompleteColumn())
        with LoggedProgress(
            *columns, console=self._console, disable=self._console.quiet
        ) as progress:
            bar = progress.add_task("", total=sum(map(len, groups)))
            return self._learner.gather(groups, lambda _: progress.advance(bar))

    def _step(self, examples: E, n: int) -> float:
        config, network = self._config, self._learner.network
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * _schedule(n, config.n_batches)
        rows = _draw(examples, config.batch_size, np.random.default_rng([config.seed, n]))
        loss = self._learner.error(examples[rows])
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), config.grad_clip)
        self._optimizer.step()
        return loss.item()

    def _look(self, held_out: E | None, n: int, line: dict[str, float]) -> None:
        """Judge on validation runs, keep the model if it is the best so far, save the state."""
        out = self._config.out
        if held_out is not None:
            line = line | {"validation_error": self._judge(held_out)}
        best = [row["validation_error"] for row in read_log(out) if "validation_error" in row]
        if line.get("validation_error", -math.inf) < min(best, default=math.inf):
            self._learner.save(out)
        append_log(out, {"batch": n, **line})
        save_state(out, self._learner.network, self._optimizer, n)

    @torch.no_grad()
    def _judge(self, examples: E) -> float:
        self._learner.network.eval()
        parts = torch.split(torch.arange(len(examples)), LOOK_AT)
        errors = [self._learner.error(examples[rows]).item() * len(rows) for rows in parts]
        self._learner.network.train()
        return sum(errors) / len(examples)


def _draw(examples: Examples, count: int, rng: np.random.Generator) -> Int[Tensor, " count"]:
    """So many examples: each data set is as likely as any other."""
    groups = np.unique(examples.group.numpy())
    ends = np.searchsorted(examples.group.numpy(), [*groups, groups[-1] + 1])
    chosen = rng.integers(len(groups), size=count)
    sizes = ends[chosen + 1] - ends[chosen]
    return torch.from_numpy(ends[chosen] + (rng.uniform(size=count) * sizes).astype(np.int64))


def _schedule(n: int, total: int) -> float:
    """Share of the learning rate at batch n."""
    return min(1.0, (n + 1) / max(1, total // 10)) * 0.5 * (1 + math.cos(math.pi * n / total))


__all__ = [
    "Examples",
    "LearnConfig",
    "Learner",
    "Tell",
    "cadence_of",
    "draw_starts",
    "learn",
    "too_short",
]
