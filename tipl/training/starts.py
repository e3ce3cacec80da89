"""Trainings on starts of runs: what a model sees at a snapshot, and what followed.

The loss is the mean over starts of the squared error over the squared displacement, so that 1 is
persistence. Every data set has an equal share of each batch.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Int
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from torch import Tensor

import weighttraj as wt
from tipl.errors import RepresentationError, TrainError
from tipl.forecaster import every_of
from tipl.horizons import fitted, too_short
from tipl.runs import checksum_of, fault_of, warn_left_out, weights_of
from tipl.saved import SavedNetwork
from tipl.settings import check_settings
from tipl.training.config import LoopConfig, defaults_of, flat
from tipl.training.loop import Examples, Learner, train_network
from weighttraj.progress import LoggedProgress

LOOK_AT = 64
"""Number of validation examples in a part."""

Example = dict[str, Tensor]
"""One start: tensors by name, among them ``energy`` (horizon,), the squared displacement, which is
NaN where the run ends before."""


E = TypeVar("E", bound="StartExamples")


@dataclass(frozen=True, kw_only=True)
class StartExamples(Examples):
    """Base of the examples that are starts of runs."""

    group: Int[Tensor, " start"]
    """Number of the data set, from 0, rising."""

    @classmethod
    def of(cls: type[E], found: Sequence[Example]) -> E:
        """Put examples of one start each together."""
        return cls(**{name: torch.stack([one[name] for one in found]) for name in found[0]})


@dataclass(frozen=True, kw_only=True)
class StartsConfig:
    """One training on starts of runs."""

    data: tuple[str | Path, ...]
    """Data sets: paths or ids. The training split of each is trained on, in equal shares; the
    runs of the validation split choose which state is kept."""
    out: Path
    """Folder of the model. A stopped training continues from its last checkpoint."""
    starts: int = 600
    """Approximate number of starts of each run that are trained on."""
    training: LoopConfig
    """How the network is trained."""
    network: Any
    """Sizes of the network, ``horizons`` and ``phases`` among them."""

    def check(self) -> None:
        """Refuse numbers that make no training."""
        check_settings(vars(self), {"starts": 1}, TrainError)


class StartsLearner(Learner[E]):
    """Base of the learners that are trained on starts: it reads the runs and draws the batches."""

    model: ClassVar[type[SavedNetwork[Any, Any]]]
    """The forecaster that is made of the network."""
    examples_type: type[E]
    """What batches are."""

    def __init__(self, config: StartsConfig) -> None:
        self.config, self.horizons = config, fitted(config.network.horizons)
        datasets = [wt.open_dataset(data) for data in config.data]
        self.train = [dataset.split("train").runs for dataset in datasets]
        self.held_out = [
            [run for run in dataset if run.split == "validation"] for dataset in datasets
        ]
        every, phases = cadence_of([run for group in self.train for run in group])
        sizes = replace(
            config.network, horizons=self.horizons, phases=config.network.phases or phases
        )
        self.model_config = self.model.config_type(network=sizes, every=every)
        self.network = self.model.build(self.model_config)

    @abstractmethod
    def examples_of(self, run: wt.Run, rng: np.random.Generator) -> Iterable[Example]:
        """Return the examples of one run."""

    def settings(self) -> dict[str, Any]:
        """Return what train.json says of the training."""
        runs = [{run.id: checksum_of(run) for run in group} for group in self.train]
        return flat(self.config) | {"runs": runs}

    def prepare(self, console: Console) -> None:
        """Read the examples of the training runs and of the validation runs."""
        examples = self._gather(self.train, console)
        if examples is None:
            raise too_short(self.horizons)
        self._examples = examples
        self._validation = self._gather(self.held_out, console) if any(self.held_out) else None
        group = examples.group.numpy()
        self._groups = np.unique(group)
        self._ends = np.searchsorted(group, [*self._groups, self._groups[-1] + 1])

    def batch(self, n: int) -> E:
        """Return random starts; each data set is as likely as any other."""
        training = self.config.training
        rng = np.random.default_rng([training.seed, n])
        chosen = rng.integers(len(self._groups), size=training.batch_size)
        first, sizes = self._ends[chosen], np.diff(self._ends)[chosen]
        rows = first + (rng.uniform(size=training.batch_size) * sizes).astype(np.int64)
        return self._examples[torch.from_numpy(rows)]

    def validation(self) -> Sequence[E]:
        """Return all examples of the validation runs, in parts."""
        held_out = self._validation
        if held_out is None:
            return ()
        return [held_out[i : i + LOOK_AT] for i in range(0, len(held_out), LOOK_AT)]

    def save(self, out: Path) -> None:
        """Write the model."""
        self.model(self.network, self.model_config).save(out)

    def _gather(self, groups: Sequence[Sequence[wt.Run]], console: Console) -> E | None:
        columns = (TextColumn("reading runs"), BarColumn(), MofNCompleteColumn())
        with LoggedProgress(*columns, console=console) as progress:
            bar = progress.add_task("", total=sum(map(len, groups)))
            found = gather(
                groups,
                self.examples_of,
                seed=self.config.training.seed,
                progress=lambda _: progress.advance(bar),
            )
        reached = [one["energy"].isfinite() for one in found]
        if not reached or not torch.stack(reached).any(0).all():
            return None
        return self.examples_type.of(found)


def train_on_starts(
    learner: type[StartsLearner[Any]], config: StartsConfig, console: Console | None
) -> None:
    """Train what a learner makes of a config, or go on where its training stopped."""
    config.check()
    train_network(
        lambda *_: learner(config),
        config.training,
        config.out,
        defaults=defaults_of(config),
        console=console,
    )


def gather(
    groups: Sequence[Sequence[wt.Run]],
    examples_of: Callable[[wt.Run, np.random.Generator], Iterable[Example]],
    *,
    seed: int,
    progress: Callable[[wt.Run], None] = lambda _: None,
) -> list[Example]:
    """Return the examples of the runs of each data set; leave out runs that have none.

    Args:
        groups: the runs of each data set.
        examples_of: returns the examples of one run.
        seed: seed of starts and parameters.
        progress: progress callback, called with each run that was read.
    """
    found: list[Example] = []
    faults: dict[str, str] = {}
    for group, runs in enumerate(groups):
        for number, run in enumerate(runs):
            rng = np.random.default_rng([seed, group, number])
            mine = _examples_or_fault(run, rng, examples_of)
            if isinstance(mine, str):
                faults[run.id] = mine
                warn_left_out(run.id, mine)
            else:
                found += [one | {"group": torch.tensor(group)} for one in mine]
            progress(run)
    if faults and len(faults) == sum(map(len, groups)):
        raise TrainError(
            "none of the runs can be trained on",
            expected="runs of at least 3 snapshots, with finite weights that change",
            got="; ".join(f"{run}: {why}" for run, why in faults.items()),
            do="collect other runs for this split",
        )
    return found


def _examples_or_fault(
    run: wt.Run,
    rng: np.random.Generator,
    examples_of: Callable[[wt.Run, np.random.Generator], Iterable[Example]],
) -> list[Example] | str:
    """Return the examples of a run, or in words why there are none."""
    if (why := fault_in_training(run)) is not None:
        return why
    try:
        found = list(examples_of(run, rng))
    except RepresentationError as error:
        return error.message.partition("\n")[0]
    return found or "no start of it can be trained on"


def fault_in_training(run: wt.Run) -> str | None:
    """Return why no start of a run can be trained on, in words; None: some can."""
    if len(run) < 3:
        return f"it has {len(run)} snapshots, and a start needs one before and one after it"
    return fault_of(weights_of(run))


def cadence_of(runs: Sequence[wt.Run]) -> tuple[int | None, int]:
    """Return the gradient steps between two snapshots, and the snapshots of an iteration."""
    cadences = {every_of(run) for run in runs}
    if len(cadences) != 1:
        raise TrainError(
            "the runs have different cadences",
            expected="one number of gradient steps from one snapshot to the next",
            got=sorted(map(str, cadences)),
            do="train on runs of one cadence",
        )
    phases = (int(run.phase.max(initial=-1)) + 1 for run in runs)
    return cadences.pop(), max(phases)


def draw_starts(length: int, count: int, rng: np.random.Generator) -> list[int]:
    """Return starts from 1 to the last snapshot but one, each once.

    Half of them are drawn uniformly and half on a logarithmic scale: the learning phase is short.
    """
    last = length - 2
    if last < 1:
        return []
    u = rng.uniform(size=count)
    even, early = 1 + u * last, np.exp(u * np.log(last + 1))
    drawn = np.where(np.arange(count) % 2, even, early).astype(int)
    return np.unique(np.clip(drawn, 1, last)).tolist()  # type: ignore[no-any-return]
