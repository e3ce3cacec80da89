"""A data set: several runs and what is known of them all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal

from weighttraj import frames, overview
from weighttraj.errors import FormatError
from weighttraj.format.schema import DatasetInfo
from weighttraj.remote.address import Place
from weighttraj.run import Run

if TYPE_CHECKING:
    import pandas as pd

    from weighttraj.load.windows import SnapshotDataset, WindowDataset


class Dataset:
    """A data set, or a selection of its runs."""

    def __init__(self, path: Place, info: DatasetInfo, runs: Sequence[Run]) -> None:
        self.path = path
        self.info = info
        self.runs = list(runs)

    def split(self, name: Literal["train", "validation", "test"]) -> Dataset:
        """Return the runs of one split.

        Raises:
            FormatError: if the split has no runs.
        """
        runs = [run for run in self.runs if run.split == name]
        if not runs:
            part = self.info.part
            raise FormatError(
                "the data set holds no run of this split",
                expected=f"one of {sorted({run.split for run in self.runs if run.split})}",
                got=repr(name),
                where=f"{self.path}{f', which holds {part} runs of the whole' if part else ''}",
                do=f"collect the other runs of {self.info.id}: weighttraj collect RECIPE"
                if part
                else "name the split of each seed in the recipe",
            )
        return Dataset(self.path, self.info, runs)

    def select(self, **wanted: Any) -> Dataset:
        """Return the runs that fit every condition.

        Args:
            wanted: ``env``, ``algorithm``, ``seed``, ``split``, ``status``, ``id``,
                ``final_return``, ``final_mean_return`` or a hyper-parameter such as
                ``learning_rate``, each with the value it must have, a collection it must be in,
                or a function that says whether a value fits. A run without it does not fit.

        >>> ds.select(env="InvertedPendulum-v4", seed=range(10))  # doctest: +SKIP
        >>> ds.select(final_return=lambda value: value > 900, n_epochs=10)  # doctest: +SKIP

        Raises:
            KeyError: no run knows of such a property.
        """
        if asked := wanted.keys() - _FACTS.keys():
            known = _FACTS.keys() | set().union(*map(_hyperparameters, self.runs))
            if self.runs and (unknown := sorted(asked - known)):
                raise KeyError(
                    f"runs of {self.info.id} have no {unknown}; they have {sorted(known)}"
                )
        runs = [run for run in self.runs if all(_has(run, k, v) for k, v in wanted.items())]
        return Dataset(self.path, self.info, runs)

    def to_pandas(self) -> pd.DataFrame:
        """Return a table with a row for each run, indexed by run id.

        Columns: split, seed, environment, numbers of snapshots and parameters, returns and
        hyper-parameters. Needs the extra ``files``.
        """
        return frames.runs_frame(self.runs)

    def to_torch(
        self,
        window: int = 20,
        *,
        stride: int = 1,
        fields: Sequence[str] = ("weights",),
        evaluated: bool = False,
    ) -> WindowDataset:
        """Return windows of consecutive snapshots as a torch ``Dataset``. Needs the extra ``sb3``.

        Args:
            window: snapshots in a window.
            stride: snapshots from one window's end to the next one's.
            fields: what an item holds: ``weights``, ``returns``, ``mean_return``, ``obs_norm``, a
                counter such as ``num_timesteps``, or any array with a row for each snapshot.
            evaluated: only windows whose last snapshot has a mean return.
        """
        from weighttraj.load.windows import WindowDataset

        return WindowDataset(
            self.runs, window=window, stride=stride, fields=fields, evaluated=evaluated
        )

    def to_torch_snapshots(
        self,
        *,
        stride: int = 1,
        fields: Sequence[str] = ("weights",),
        evaluated: bool = False,
    ) -> SnapshotDataset:
        """Return single snapshots as a torch ``Dataset``. Needs the extra ``sb3``.

        Arguments are those of ``to_torch``.
        """
        from weighttraj.load.windows import SnapshotDataset

        return SnapshotDataset(self.runs, stride=stride, fields=fields, evaluated=evaluated)

    def __len__(self) -> int:
        return len(self.runs)

    def __getitem__(self, run: int | str) -> Run:
        """Return the run of a position, or of an id such as ``seed0003``.

        Raises:
            IndexError: if there are fewer runs.
            KeyError: if no run has this id.
        """
        if isinstance(run, str):
            ids = [each.id for each in self.runs]
            if run not in ids:
                raise KeyError(f"no run {run!r}; there are {ids}")
            return self.runs[ids.index(run)]
        return self.runs[run]

    def __iter__(self) -> Iterator[Run]:
        return iter(self.runs)

    def __repr__(self) -> str:
        return overview.as_text(self)

    def _repr_html_(self) -> str:
        return overview.as_html(self)


_FACTS: dict[str, Callable[[Run], Any]] = {
    "id": lambda run: run.id,
    "split": lambda run: run.split,
    "seed": lambda run: _seed(run),
    "status": lambda run: run.info.status,
    "env": lambda run: run.info.env.id if run.info.env else None,
    "algorithm": lambda run: run.info.algorithm.name if run.info.algorithm else None,
    "final_return": lambda run: run.final_return,
    "final_mean_return": lambda run: run.final_mean_return,
}
"""What ``select`` can ask of a run, beside its hyper-parameters."""


def _seed(run: Run) -> int | None:
    listed = run._entry.seed if run._entry else None
    return run.info.seed if listed is None else listed


def _hyperparameters(run: Run) -> dict[str, Any]:
    return run.info.algorithm.hyperparameters if run.info.algorithm else {}


def _has(run: Run, name: str, wanted: Any) -> bool:
    """Return whether a run has a property that fits."""
    if name in _FACTS:
        return _fits(_FACTS[name](run), wanted)
    values = _hyperparameters(run)
    return name in values and _fits(values[name], wanted)


def _fits(value: Any, wanted: Any) -> bool:
    if value is None and callable(wanted):
        return False
    if callable(wanted):
        return bool(wanted(value))
    if isinstance(wanted, list | tuple | set | frozenset | range):
        return value in wanted or value == wanted
    return bool(value == wanted)
