"""Trains tipl-gate on the training runs of one or several data sets; minutes on one core."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from torch import Tensor

import weighttraj as wt
from tipl.baselines.horizons import HORIZONS, fitted
from tipl.errors import TrainError
from tipl.gate.examples import Examples, gather
from tipl.gate.forecaster import Gate, GateModelConfig
from tipl.models.gate import GateConfig, GateNetwork
from tipl.prepare import digest_of
from tipl.progress import TrainingBar
from tipl.state import append_log, cut_log, keep_settings, read_log, read_state, restore, save_state
from weighttraj.threads import one_torch_thread

MAY_DIFFER = ("out", "data")
"""Settings that may change from one start of a training to the next."""


@dataclass(frozen=True, kw_only=True)
class GateTrainConfig:
    """One training."""

    data: tuple[Path, ...]
    """Data sets: paths or ids. The training split of each is learnt from, in equal shares; the
    runs of its validation split choose when to stop."""
    out: Path
    """Folder of the model. A training that stopped goes on where it was saved last."""
    horizons: tuple[int, ...] = HORIZONS
    """Snapshots ahead."""
    starts: int = 600
    """Starts of each run that are learnt from, about."""
    n_batches: int = 4_000
    """Batches in the whole training."""
    batch_size: int = 32
    """Starts in a batch, of 128 parameters each."""
    learning_rate: float = 3e-3
    """Of AdamW at its highest; it rises over the first tenth and falls along a cosine."""
    weight_decay: float = 1e-3
    """Of AdamW."""
    grad_clip: float = 1.0
    """Gradients are clipped to this norm."""
    validate_every: int = 200
    """Batches from one look at the validation runs to the next; the best state is kept."""
    seed: int = 0
    """Of starts, parameters, initialisation and batches."""
    lags: int = 20
    """Last steps that the network sees, beside averages of all."""
    width: int = 48
    """Units of its hidden layers."""
    experts: int = 8
    """Linear filters that it mixes."""


def train_gate(config: GateTrainConfig, *, console: Console | None = None) -> Gate:
    """Train tipl-gate, or go on where the training stopped; a finished one is loaded.

    The loss is the mean over starts and horizons of the squared error over the mean squared
    displacement: 1 is persistence. The same seed gives the same model on the same machine.

    Raises:
        TrainError: the data sets have no runs to train on, or different cadences; or the folder
            holds a training with other settings.
    """
    with one_torch_thread(), torch.random.fork_rng(devices=[]):
        return _Training(config, console or Console(quiet=True)).run()


class _Training:
    def __init__(self, config: GateTrainConfig, console: Console) -> None:
        self._config, self._console = config, console
        datasets = [wt.open_dataset(data) for data in config.data]
        self._train = [dataset.split("train").runs for dataset in datasets]
        self._validation = [
            [run for run in dataset if run.split == "validation"] for dataset in datasets
        ]
        runs = [run for group in self._train for run in group]
        every = _one_cadence(runs)
        phases = max(int(run.phase.max()) + 1 for run in runs)
        network = GateConfig(
            horizons=fitted(config.horizons),
            phases=phases,
            lags=config.lags,
            width=config.width,
            experts=config.experts,
        )
        self._model_config = GateModelConfig(network=network, every=every)
        self._settings = asdict(config) | {
            "data": [str(data) for data in config.data],
            "out": str(config.out),
            "runs": [{run.id: digest_of(run) for run in group} for group in self._train],
        }

    def run(self) -> Gate:
        config = self._config
        keep_settings(config.out, self._settings, MAY_DIFFER)
        torch.manual_seed(config.seed)
        network = GateNetwork(self._model_config.network)
        optimizer = torch.optim.AdamW(network.parameters(), weight_decay=config.weight_decay)
        start = restore(read_state(config.out), network, optimizer)
        cut_log(config.out, start)
        if start < config.n_batches or not (config.out / "config.json").is_file():
            self._go_on(network, optimizer, start)
        return Gate.load(config.out)

    def _go_on(self, network: GateNetwork, optimizer: torch.optim.Optimizer, start: int) -> None:
        config = self._config
        examples, held_out = self._gather(self._train), None
        if any(self._validation):
            held_out = self._gather(self._validation)
        if start == 0:  # persistence is the first candidate
            self._look(network, optimizer, held_out, 0, float("nan"))
        with TrainingBar(config.n_batches, start, self._console, "relative error") as bar:
            total, count = 0.0, 0
            for n in range(start, config.n_batches):
                total, count = total + self._step(network, optimizer, examples, n), count + 1
                bar.advance(total / count)
                if (n + 1) % config.validate_every == 0 or n + 1 == config.n_batches:
                    self._look(network, optimizer, held_out, n + 1, total / count)
                    bar.restart()
                    total, count = 0.0, 0

    def _gather(self, groups: Sequence[Sequence[wt.Run]]) -> Examples:
        columns = (TextColumn("reading runs"), BarColumn(), MofNCompleteColumn())
        with Progress(*columns, console=self._console, disable=self._console.quiet) as progress:
            bar = progress.add_task("", total=sum(map(len, groups)))
            return gather(
                groups,
                self._model_config.network,
                starts=self._config.starts,
                seed=self._config.seed,
                tell=lambda _: progress.advance(bar),
            )

    def _step(
        self,
        network: GateNetwork,
        optimizer: torch.optim.Optimizer,
        examples: Examples,
        n: int,
    ) -> float:
        config = self._config
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * _schedule(n, config.n_batches)
        rows = _draw(examples, config.batch_size, np.random.default_rng([config.seed, n]))
        loss = relative_error(network, examples[rows])
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), config.grad_clip)
        optimizer.step()
        return loss.item()

    def _look(
        self,
        network: GateNetwork,
        optimizer: torch.optim.Optimizer,
        held_out: Examples | None,
        n: int,
        error: float,
    ) -> None:
        """Judge on validation runs, keep the model if it is the best so far, save the state."""
        out = self._config.out
        line: dict[str, float] = {"batch": n, "error": error}
        if held_out is not None:
            line["validation_error"] = validation_error(network, held_out)
        best = [row["validation_error"] for row in read_log(out) if "validation_error" in row]
        if line.get("validation_error", -math.inf) < min(best, default=math.inf):
            Gate(network, self._model_config).save(out)
        append_log(out, {k: v for k, v in line.items() if math.isfinite(v)})
        save_state(out, network, optimizer, n)


def relative_error(network: GateNetwork, examples: Examples) -> Float[Tensor, ""]:
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


@torch.no_grad()
def validation_error(network: GateNetwork, examples: Examples) -> float:
    """The same of all examples."""
    network.eval()
    parts = torch.split(torch.arange(len(examples)), 64)
    errors = [relative_error(network, examples[rows]).item() * len(rows) for rows in parts]
    network.train()
    return sum(errors) / len(examples)


def _draw(examples: Examples, count: int, rng: np.random.Generator) -> Tensor:
    """So many examples: each data set is as likely as any other."""
    groups = int(examples.group[-1]) + 1
    ends = np.searchsorted(examples.group.numpy(), np.arange(groups + 1))
    chosen = rng.integers(groups, size=count)
    sizes = ends[chosen + 1] - ends[chosen]
    return torch.from_numpy(ends[chosen] + (rng.uniform(size=count) * sizes).astype(np.int64))


def _schedule(n: int, total: int) -> float:
    """Share of the learning rate at batch n."""
    return min(1.0, (n + 1) / max(1, total // 10)) * 0.5 * (1 + math.cos(math.pi * n / total))


def _one_cadence(runs: Sequence[wt.Run]) -> int | None:
    cadences = {run.info.cadence.every if run.info.cadence else None for run in runs}
    if len(cadences) != 1:
        raise TrainError(
            "the runs have different cadences",
            expected="one number of gradient steps from one snapshot to the next",
            got=sorted(map(str, cadences)),
            do="train on runs of one cadence",
        )
    return cadences.pop()


__all__ = ["GateTrainConfig", "relative_error", "train_gate", "validation_error"]
