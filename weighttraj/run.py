"""A run as it is read: arrays, metadata, returns. Only committed snapshots are seen."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Int64

from weighttraj import frames
from weighttraj.errors import DamageError, FormatError, RowError
from weighttraj.format.layout import ParamLayout
from weighttraj.format.schema import RETURNS, ArraySpec, Evaluation, RunEntry, RunInfo
from weighttraj.remote.address import Place
from weighttraj.store.codecs import BLOCK_BYTES
from weighttraj.text import printable

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from weighttraj.collect.into import Target
    from weighttraj.policies.policy import Policy


PIECE_BYTES = 64 << 20
"""Bytes of an array that are read at a time where all of it is read, about."""


@runtime_checkable
class ArrayStore(Protocol):
    """What a run is read from: a Zarr group (``storage``) or an HDF5 file (``hdf5``)."""

    @property
    def path(self) -> Place:
        """Where it lies."""

    @property
    def info(self) -> RunInfo:
        """Metadata."""

    @property
    def specs(self) -> dict[str, ArraySpec]:
        """Arrays, by name."""

    def read(self, name: str, key: Any) -> np.ndarray:
        """Read part of an array, within the committed rows; raises DamageError."""

    def chunk_rows(self, name: str) -> int:
        """Return rows of an array that are decoded together."""


@dataclass(frozen=True, kw_only=True)
class NormStats:
    """Statistics of a normaliser at one time."""

    mean: np.ndarray
    """float64, shape of an observation; () for rewards."""
    var: np.ndarray
    """float64, shape of an observation; () for rewards."""
    count: float
    """Samples so far; trainers start it slightly above 0."""


class StoredArray:
    """One array of a run, read when it is indexed. Rows are the committed ones.

    Integers, slices that go forward, lists of integers and masks are read as numpy would; rows of
    ``policy/weights`` read whole are also compared with the digests of their snapshots.
    """

    def __init__(self, store: ArrayStore, spec: ArraySpec) -> None:
        self._store = store
        self._spec = spec

    @property
    def shape(self) -> tuple[int, ...]:
        """Committed rows and the shape of a row."""
        return (self._store.info.committed(self._spec.axis), *self._spec.inner)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Element type."""
        return np.dtype(self._spec.dtype)

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions."""
        return self._spec.dims

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> np.ndarray:
        """Read rows (and, after a comma, columns).

        Raises:
            IndexError: outside the committed rows.
            DamageError: a chunk is missing or damaged, or a digest does not match.
        """
        rows, *rest = (key or (...,)) if isinstance(key, tuple) else (key,)
        if rows is Ellipsis:  # what follows are the last dimensions
            if len(rest) >= len(self.shape):
                rows, *rest = rest
            else:
                rows, rest = slice(None), rest and [..., *rest]
        index = _rows(rows, len(self), f"{self._store.path}, array {self._spec.name!r}")
        values = self._store.read(self._spec.name, (index, *rest) if rest else index)
        if self._spec.name == "policy/weights" and not rest:
            self._check(index, values)
        return values

    def pieces(self, unit: int = 1) -> Iterator[tuple[int, np.ndarray]]:
        """Yield all rows, some at a time, so that memory stays small: (first row, rows).

        A piece has about 64 MiB, or the rows that are decoded together if these have up to
        256 MiB; in any case at least one row.

        Args:
            unit: every piece but the last has a multiple of so many rows.
        """
        row = self.dtype.itemsize * max(1, math.prod(self.shape[1:]))
        together = self._store.chunk_rows(self._spec.name)
        if unit == 1 and together * row <= BLOCK_BYTES:
            unit = together
        step = unit * max(1, PIECE_BYTES // (unit * row))
        for start in range(0, len(self), step):
            yield start, self[start : start + step]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def __repr__(self) -> str:
        return f"<{self._spec.name} {self.dtype} {dict(zip(self.dims, self.shape, strict=True))}>"

    def _check(self, index: Any, values: np.ndarray) -> None:
        expected = np.atleast_2d(self._store.read("digest", index))
        rows = np.ascontiguousarray(np.atleast_2d(values), "<f4")
        size, content = rows.shape[1] * rows.itemsize, rows.reshape(-1).view(np.uint8).data
        starts = range(0, len(content), size)
        got = b"".join([hashlib.sha256(content[i : i + size]).digest() for i in starts])
        if got == expected.tobytes():
            return
        bad = int(np.flatnonzero(np.frombuffer(got, np.uint8) != expected.reshape(-1))[0]) // 32
        raise DamageError(
            "a snapshot does not match its digest",
            expected=expected[bad].tobytes().hex(),
            got=got[32 * bad : 32 * bad + 32].hex(),
            where=f"{self._store.path}, row {bad} of the rows read",
            do="restore the run from a copy, or collect it again",
        )


class Run:
    """One training run: its trajectory of weights and what belongs to each snapshot.

    Opened by ``open_run`` or as one of ``Dataset.runs``, where it is read when it is first used.
    """

    def __init__(
        self, path: Place, opener: Callable[[], ArrayStore], entry: RunEntry | None = None
    ) -> None:
        self.path = path
        self._opener = opener
        self._entry = entry

    @cached_property
    def _store(self) -> ArrayStore:
        store = self._opener()
        if self._entry is not None and store.info.run_id != self._entry.id:
            raise FormatError(
                "a run is not the one that the data set lists",
                expected=self._entry.id,
                got=store.info.run_id,
                where=self.path,
                do="restore the run from a copy",
            )
        return store

    @property
    def split(self) -> str:
        """Part of the data set: train, validation, test, or empty."""
        return self._entry.split if self._entry else ""

    @property
    def info(self) -> RunInfo:
        """Metadata."""
        return self._store.info

    @property
    def id(self) -> str:
        """Id, unique in the data set."""
        return self._entry.id if self._entry else self.info.run_id

    @property
    def seed(self) -> int | None:
        """Seed of the training; None: not recorded."""
        return self.info.seed

    @property
    def layout(self) -> ParamLayout:
        """Order of the parameters in a snapshot."""
        return self.info.layout

    @property
    def weights(self) -> StoredArray:
        """Policy weights, float32 (time, param)."""
        return self["policy/weights"]

    @property
    def num_timesteps(self) -> Int64[np.ndarray, " time"]:
        """Environment steps at each snapshot."""
        return self["index/num_timesteps"][:]

    @property
    def iteration(self) -> Int64[np.ndarray, " time"]:
        """Iteration of each snapshot: 0 before training, then from 1."""
        return self["index/iteration"][:]

    @property
    def phase(self) -> Int64[np.ndarray, " time"]:
        """Which part of its iteration ends at each snapshot, from 0; -1 before training."""
        return self["index/phase"][:]

    @property
    def learning_rate(self) -> Float64[np.ndarray, " time"]:
        """Learning rate of the gradient step that led to each snapshot."""
        return self["index/learning_rate"][:]

    @property
    def arrays(self) -> dict[str, StoredArray]:
        """All arrays, by name."""
        return {name: StoredArray(self._store, spec) for name, spec in self._store.specs.items()}

    def __getitem__(self, name: str) -> StoredArray:
        """Return any array by name, such as ``train/approx_kl``; ``run.arrays`` lists them."""
        try:
            return StoredArray(self._store, self._store.specs[name])
        except KeyError:
            names = ", ".join(self._store.specs)
            raise KeyError(f"run {self.id} stores no {name!r}; it stores {names}") from None

    def __len__(self) -> int:
        """Return the number of committed snapshots."""
        return self.info.n_committed

    def keys(self) -> list[str]:
        """Return names of all arrays."""
        return list(self._store.specs)

    def at(self, num_timesteps: int) -> int:
        """Return the last snapshot taken at or before so many environment steps.

        >>> run.at(num_timesteps=100_000)  # doctest: +SKIP
        240

        Raises:
            IndexError: there is none.
        """
        t = int(np.searchsorted(self.num_timesteps, num_timesteps, side="right")) - 1
        if t < 0:
            raise IndexError(f"run {self.id} has no snapshot at or before step {num_timesteps}")
        return t

    @property
    def final_return(self) -> float:
        """Mean return of the last training episodes (SB3's ``ep_rew_mean``); NaN: not stored."""
        if "train/ep_rew_mean" not in self._store.specs:
            return float("nan")
        values = self["train/ep_rew_mean"][:]
        finite = values[np.isfinite(values)]
        return float(finite[-1]) if len(finite) else float("nan")

    @property
    def evaluation(self) -> Evaluation | None:
        """How the stored returns were got; None: no returns are stored."""
        return self.info.evaluation

    @property
    def returns(self) -> StoredArray:
        """Return of each episode that each snapshot played, float64 (time, episode).

        ``run["eval/lengths"]``, int32, are its steps. NaN and -1: this snapshot was not evaluated.
        NaN and a length: the simulation became unstable after so many steps.

        Raises:
            FormatError: no returns are stored.
        """
        self._evaluated()
        return self[RETURNS[0]]

    def mean_return(self, deterministic: bool = True) -> Float64[np.ndarray, " time"]:
        """Return the mean return of each snapshot over the episodes of one mode.

        NaN: the snapshot was not evaluated, or an episode has no return.

        Args:
            deterministic: of the episodes whose actions were the distribution's mode; else of
                those whose actions were sampled.

        Raises:
            FormatError: no returns are stored, or of no such episode.
        """
        means: np.ndarray = self.returns[:, self._episodes(deterministic)].mean(axis=1)
        return means

    @property
    def final_mean_return(self) -> float:
        """Mean return of the last evaluated snapshot; NaN: none was, or it has no mean.

        Of the deterministic episodes, if there are any, else of the sampled ones.
        """
        if self.evaluation is None:
            return float("nan")
        mode = any(self.evaluation.deterministic)
        lengths = self[RETURNS[1]][:, self._episodes(mode)]
        rows = np.flatnonzero((lengths >= 0).all(axis=1))
        return float(self.mean_return(mode)[rows[-1]]) if rows.size else float("nan")

    def obs_norm(self, t: int) -> NormStats | None:
        """Return statistics of the observation normaliser at snapshot t; None: the run has none."""
        return self._stats("obs_norm", t) if self.info.obs_norm is not None else None

    def ret_norm(self, t: int) -> NormStats | None:
        """Return statistics of the reward normaliser at snapshot t; None: the run has none."""
        return self._stats("ret_norm", t) if self.info.ret_norm else None

    def to_pandas(self) -> pd.DataFrame:
        """Return a table with a row for each snapshot, indexed by snapshot.

        Columns: counters (``num_timesteps``, ``iteration``, ...), diagnostics
        (``train.approx_kl``, ...) and mean returns. Needs the extra ``files``.
        """
        return frames.snapshots_frame(self)

    def to_xarray(self) -> xr.Dataset:
        """Return all arrays as one xarray data set, read when they are used.

        Needs the extra ``files``.
        """
        return frames.run_dataset(self)

    def load_policy(self, t: int = -1) -> Policy:
        """Return the policy of snapshot t, which acts as the agent did. Needs the extra ``sb3``.

        Args:
            t: snapshot, from 0; below 0 it counts from the end.

        Raises:
            PolicyError: the run's policy cannot be rebuilt; the message says why.
            IndexError: there is no such snapshot.
        """
        from weighttraj.policies.policy import load_policy

        return load_policy(self, t)

    def load_into(
        self,
        target: Target,
        t: int = -1,
        *,
        normalizer: bool = True,
        keep_buffers: bool = False,
    ) -> None:
        """Load the weights of snapshot t, and its observation normaliser, into your own model.

        This works for every policy, also for those that ``load_policy`` cannot rebuild. Either
        everything is loaded or nothing. The critic is loaded if the run stores it and the target
        has it. The optimizer and statistics of rewards are left as they are. Needs the extra
        ``sb3``.

        Args:
            target: a Stable-Baselines3 model, whose environment holds the normaliser; a module; or
                tensors by name. Names, shapes and types must be those of ``run.layout``.
            t: snapshot, from 0; below 0 it counts from the end.
            normalizer: load the statistics of the observation normaliser too. False: leave that of
                the target alone.
            keep_buffers: accept a target with buffers, such as the statistics of a batch
                normalisation. No run stores them: they stay as they are.

        Raises:
            PolicyError: the target is another network, or has another normaliser; nothing was
                changed.
            IndexError: there is no such snapshot.
        """
        from weighttraj.collect.into import load_into

        load_into(self, target, t, normalizer=normalizer, keep_buffers=keep_buffers)

    def _evaluated(self) -> Evaluation:
        if self.evaluation is None:
            raise FormatError(
                "the run stores no returns",
                where=self.path,
                do="weighttraj returns DATASET evaluates its snapshots and stores them",
            )
        return self.evaluation

    def _episodes(self, deterministic: bool) -> list[int]:
        """Return columns of the episodes of one mode."""
        modes = self._evaluated().deterministic
        columns = [i for i, mode in enumerate(modes) if mode == deterministic]
        if not columns:
            raise FormatError(
                "the returns are of no such episode",
                expected="deterministic" if deterministic else "sampled",
                got=f"{len(modes)} episodes, all {'sampled' if deterministic else 'deterministic'}",
                where=self.path,
                do=f"ask for mean_return(deterministic={not deterministic}), or evaluate again",
            )
        return columns

    def _stats(self, group: str, t: int) -> NormStats:
        mean, var, count = (self[f"{group}/{name}"][t] for name in ("mean", "var", "count"))
        return NormStats(mean=mean, var=var, count=float(count))

    def __repr__(self) -> str:
        info = self.info
        what = [info.algorithm.name] if info.algorithm else []
        what += [info.env.id] if info.env else []
        return printable(
            f"<Run {self.id}: {' '.join(what)} seed {info.seed}, weights "
            f"(time {len(self)}, param {self.layout.size}), {info.status}>"
        )


def _rows(key: Any, n: int, where: str) -> Any:
    """Return a row selection with non-negative bounds inside the committed rows."""
    if isinstance(key, slice):
        start, stop, step = key.indices(n)
        if step < 1:
            raise RowError(
                "slices go forward only",
                expected="a step of at least 1",
                got=f"step {step}",
                where=where,
                do="read forward, and reverse the array",
            )
        return slice(start, max(start, stop), step)
    index = np.asarray(key)
    if index.dtype == bool and index.shape == (n,):
        return np.flatnonzero(index)
    if not index.size and index.ndim == 1:
        index = index.astype(np.int64)
    whole = index.dtype.kind in "iu" and index.ndim <= 1
    if not whole or ((index < -n) | (index >= n)).any():
        raise RowError(
            "there are no such rows",
            expected=f"some of the {n} committed rows: a number, a list of numbers, a slice, or a "
            "mask of them all",
            got=repr(key),
            where=where,
            do="choose committed rows",
        )
    index = np.where(index < 0, index + n, index)
    return int(index) if index.ndim == 0 else index
