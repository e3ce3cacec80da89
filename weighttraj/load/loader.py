"""Batches in an order that a restart takes up where it stopped."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
import torch
from jaxtyping import Int64
from torch.utils.data import DataLoader, Dataset, Sampler

from weighttraj.errors import LoaderError
from weighttraj.load.windows import Batch, RunDataset


class LoaderState(TypedDict):
    """Where a loader stands: plain JSON values."""

    seed: int
    """Seed of the order."""
    epoch: int
    """Passes over the data set that ended."""
    batch: int
    """Batches of this epoch that were handed out."""
    batch_size: int
    """Items in a batch."""
    shuffle: bool
    """Whether the order is a shuffled one."""
    drop_last: bool
    """Whether a last, smaller batch is left out."""
    items: int
    """Length of the data set."""
    data: str
    """The data set's fingerprint."""


class ResumableLoader:
    """torch's ``DataLoader`` over windows or snapshots, with a place that survives a restart.

    The order is a function of (seed, epoch). Iterating gives the batches of one epoch and goes on
    where the last iteration stopped: after a ``break`` with the next batch, at an epoch's end
    with the next epoch. Torch's global random state is not touched.

    Args:
        data: windows or snapshots.
        batch_size: items in a batch.
        seed: seed of the order, at least 0.
        shuffle: whether to shuffle; otherwise each epoch has the data set's own order.
        drop_last: whether to leave out a last batch that is not full.
        options: of torch's ``DataLoader``, such as ``num_workers``, ``persistent_workers``,
            ``multiprocessing_context``, ``pin_memory``.

    Raises:
        LoaderError: the batch size or the seed is out of range.
    """

    def __init__(
        self,
        data: RunDataset,
        batch_size: int = 64,
        *,
        seed: int = 0,
        shuffle: bool = True,
        drop_last: bool = False,
        **options: Any,
    ) -> None:
        self.data = data
        self._plan = _Plan(len(data), batch_size, seed, shuffle, drop_last)
        self._loader: DataLoader[Any] = DataLoader(
            _Batches(data),
            sampler=self._plan,
            batch_size=None,
            collate_fn=_as_it_is,
            generator=torch.Generator().manual_seed(seed),
            **options,
        )
        self._iteration = 0

    @property
    def epoch(self) -> int:
        """Passes over the data set that ended."""
        return self._plan.epoch

    def state_dict(self) -> LoaderState:
        """Return where the loader stands. Batches that workers hold ready are not counted.

        Taken inside the loop, it counts the batch in hand. After an epoch's last batch it is the
        end of that epoch: a loader that takes it up has none left in it, then begins the next.

        Raises:
            DamageError: a run's digests are damaged.
        """
        plan = self._plan
        return LoaderState(
            seed=plan.seed,
            epoch=plan.epoch,
            batch=plan.batch,
            batch_size=plan.batch_size,
            shuffle=plan.shuffle,
            drop_last=plan.drop_last,
            items=plan.n,
            data=self.data.fingerprint,
        )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on after the last batch that was handed out; the seed is the state's.

        Raises:
            LoaderError: it is no state of a loader, or of one with another data set, batch size,
                shuffle or drop_last.
        """
        own: Mapping[str, Any] = {**self.state_dict()}
        _check_state(state, own)
        other = [name for name in _SETTINGS if state[name] != own[name]]
        if other:
            raise LoaderError(
                "the state is of a loader over other data, or with other settings",
                expected={name: own[name] for name in other},
                got={name: state[name] for name in other},
                where=self.data,
                do="make the data set and the loader as they were, or start without the state",
            )
        plan = self._plan
        plan.seed, plan.epoch, plan.batch = (state[name] for name in _PLACE)
        self._iteration += 1

    def __len__(self) -> int:
        """Batches in a whole epoch."""
        return len(self._plan)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches left in this epoch.

        Raises:
            LoaderError: another iteration was begun, or a state loaded, since this one was.
            CacheError: the cache's folder cannot be used.
            DamageError: a run is damaged.
        """
        self._iteration += 1
        mine = self._iteration
        batches = iter(self._loader)
        while (batch := next(batches, None)) is not None:
            self._plan.batch += 1  # before it is handed out: a state taken with it counts it
            yield batch
            # Before the next is fetched: persistent workers have one queue for all iterations.
            self._check_current(mine)
        self._plan.epoch, self._plan.batch = self._plan.epoch + 1, 0

    def _check_current(self, iteration: int) -> None:
        if iteration != self._iteration:
            raise LoaderError(
                "this iteration is over: another was begun, or a state was loaded, since",
                where=self.data,
                do="make a loader for each loop that runs at the same time",
            )


class _Plan(Sampler[list[int]]):
    """Where a loader stands, and the batches of indices that are left in its epoch."""

    def __init__(self, n: int, batch_size: int, seed: int, shuffle: bool, drop_last: bool) -> None:
        if batch_size < 1 or seed < 0:
            raise LoaderError(
                "no loader can be made of this",
                expected="batch_size at least 1, seed at least 0",
                got=f"batch_size {batch_size}, seed {seed}",
                do="change them",
            )
        self.n, self.batch_size, self.seed = n, batch_size, seed
        self.shuffle, self.drop_last = shuffle, drop_last
        self.epoch = self.batch = 0

    def __iter__(self) -> Iterator[list[int]]:
        order = epoch_order(self.n, self.seed, self.epoch) if self.shuffle else np.arange(self.n)
        for i in range(self.batch, len(self)):
            yield order[i * self.batch_size : (i + 1) * self.batch_size].tolist()

    def __len__(self) -> int:
        return self.n // self.batch_size if self.drop_last else -(-self.n // self.batch_size)


class _Batches(Dataset[Batch]):
    """A data set whose items are whole batches, so that a worker copies each row once."""

    def __init__(self, data: RunDataset) -> None:
        self.data = data

    def __getitem__(self, indices: Sequence[int]) -> Batch:
        return self.data.batch(indices)


def epoch_order(n: int, seed: int, epoch: int) -> Int64[np.ndarray, " n"]:
    """Return a shuffled order of n items, the same with every version of numpy.

    Numpy promises the streams of its bit generators for all versions, but not those of
    ``Generator.permutation``.
    """
    bits = np.random.PCG64([seed, epoch]).random_raw(n)
    return np.argsort(bits, kind="stable")


_PLACE = ("seed", "epoch", "batch")
_SETTINGS = ("batch_size", "shuffle", "drop_last", "items", "data")


def _check_state(state: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    typed = all(type(state.get(name)) is type(value) for name, value in own.items())
    if not typed or min(state[name] for name in _PLACE) < 0:
        raise LoaderError(
            "this is no state of a ResumableLoader",
            expected=f"what state_dict() gave: {sorted(own)}",
            got=dict(state),
            do="pass what state_dict() gave",
        )


def _as_it_is(batch: Any) -> Any:
    return batch
