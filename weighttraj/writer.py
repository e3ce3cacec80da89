"""Writes one run: append, commit in blocks, continue."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from weighttraj.errors import FormatError, ReplayError, SnapshotError
from weighttraj.format.schema import (
    AXES,
    ArraySpec,
    Axis,
    PolicySpec,
    Provenance,
    RunInfo,
    Status,
    to_json,
    with_progress,
)
from weighttraj.format.values import as_array
from weighttraj.remote.address import new_path
from weighttraj.store.live import LiveStore, lock_run

Moments = tuple[np.ndarray, np.ndarray, float]
"""Statistics of a normaliser: mean, variance, count."""


class RunWriter:
    """Writes the snapshots of one training run, from any trainer.

    Snapshots are committed in blocks of ``info.block``, or of as many as fit into 256 MiB if the
    snapshots are large. Readers see committed snapshots only, so
    a process that is killed loses at most the block it was filling. Used as a context manager, it
    marks the run ``complete``, or ``crashed`` when an exception passes; both commit what is left.

    With ``resume=True`` a run that was interrupted is continued by doing it again: snapshots up to
    the last committed one are compared with the stored ones and not written, later ones are
    appended. Trainers such as Stable-Baselines3 cannot be resumed bit by bit; a seed can be
    repeated.

    Args:
        path: folder of the run, ``<data set>/runs/<run id>.zarr``.
        info: metadata. Its status and counts are the writer's business.
        resume: continue the run at the path, if there is one.

    Raises:
        StoreExistsError: the path exists, and ``resume`` is False.
        StoreLockedError: another process is writing this run.
        FormatError: the run at the path has other arrays than ``info`` says, or is complete.
    """

    def __init__(self, path: str | Path, info: RunInfo, *, resume: bool = False) -> None:
        path = new_path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = lock_run(path)
        try:
            self._is_new = not (resume and path.exists())
            if not self._is_new:
                self._store = _reopen(path, info)
            else:
                info = replace(info, evaluation=None)  # of another run, if there is one
                self._store = LiveStore.create(path, with_progress(info, **_NOTHING))
        except BaseException:
            self._lock.release()
            raise
        self._provenance = info.provenance
        info = self._store.info
        self.path = path
        self.replayed_from = info.n_committed
        """Committed snapshots found at the start: that many are compared, not written."""
        specs = list(self._store.specs.values())
        self._specs = {axis: [s for s in specs if s.axis == axis] for axis in AXES}
        self._committed_digests = self._store.read("digest", slice(0, info.n_committed))
        self._at_start = {axis: info.committed(axis) for axis in AXES}
        self._compared: dict[Axis, int] = dict.fromkeys(AXES, 0)
        self._blocks: dict[Axis, _Block] = {axis: self._tail(axis) for axis in AXES}
        self._closed = False
        if info.status != "collecting":  # say so before any chunk changes
            self._store.commit(with_progress(info, status="collecting", **self._at_start))

    @property
    def info(self) -> RunInfo:
        """Metadata as last committed."""
        return self._store.info

    def append(
        self,
        weights: ArrayLike | Any,
        *,
        num_timesteps: int | Any,
        iteration: int | Any = -1,
        epoch: int | Any = -1,
        gradient_step: int | Any = -1,
        phase: int | Any = -1,
        learning_rate: float | Any = float("nan"),
        obs_norm: Moments | Any | None = None,
        ret_norm: Moments | Any | None = None,
        train: Mapping[str, float | Any] | None = None,
        critic: ArrayLike | Any | None = None,
        moments: tuple[ArrayLike, ArrayLike] | Any | None = None,
    ) -> None:
        """Append one snapshot.

        Arrays may be NumPy arrays or tensors of any real type; they are stored as float32 or
        float64. Every value is checked when it arrives, whatever its type: nothing that the
        stored type cannot hold is accepted.

        Args:
            weights: flat parameters (param,), in the order of ``info.layout``.
            num_timesteps: environment steps so far.
            iteration: rollouts and updates begun so far; 0 before training, -1: not recorded.
            epoch: passes over the rollout finished in this iteration; -1: not recorded.
            gradient_step: optimizer steps so far; -1: not recorded.
            phase: which part of the iteration ends here, from 0; -1: none, or not recorded.
            learning_rate: of the gradient step that led here.
            obs_norm: (mean, var, count) of the observation normaliser, float64 of an observation's
                shape and a number; required if ``info.obs_norm``.
            ret_norm: the same of the reward normaliser, scalars; required if ``info.ret_norm``.
            train: diagnostics known at this moment; NaN is stored for those left out.
            critic: critic's parameters (critic_param,); required if ``info.critic_layout``.
            moments: Adam's first and second moments; required if ``info.optimizer_moments``.

        Raises:
            SnapshotError: a value has another shape than the run's, does not consist of real
                numbers, is not finite, or is missing.
            ReplayError: a continued run does not repeat what it had committed.
        """
        flat = as_array(weights, "float32", "policy/weights")
        values: dict[str, Any] = {
            "policy/weights": flat,
            "index/learning_rate": learning_rate,
            "index/iteration": iteration,
            "index/epoch": epoch,
            "index/gradient_step": gradient_step,
            "index/num_timesteps": num_timesteps,
            "index/phase": phase,
            **{f"train/{name}": value for name, value in (train or {}).items()},
            **_moments("obs_norm", obs_norm),
            **_moments("ret_norm", ret_norm),
            **({} if critic is None else {"critic/weights": critic}),
            **_named("moments", _ADAM, moments),
        }
        digest = hashlib.sha256(np.ascontiguousarray(flat, "<f4").data).digest()
        values["digest"] = np.frombuffer(digest, np.uint8)
        self._append("time", values)

    def append_iteration(self, probe_observations: ArrayLike | Any) -> None:
        """Append one row of the iteration-indexed arrays: network inputs of its rollout.

        Args:
            probe_observations: inputs of the network, shape (probe, ...) with the shape of an
                observation after the first axis.

        Raises:
            SnapshotError: if the shape is another one.
        """
        self._append("iteration", {"probe/observations": probe_observations})

    def describe_again(self, policy: PolicySpec) -> None:
        """Replace the description of the policy: it turned out that it acts otherwise."""
        self._store.commit(replace(self._store.info, policy=policy))

    def note_move(self, by: str) -> None:
        """Note in the metadata what changed the weights beside the gradient steps."""
        info = self._store.info
        if by not in info.moved_by:
            self._store.commit(replace(info, moved_by=(*info.moved_by, by)))

    def flush(self, status: Status = "collecting") -> None:
        """Write and commit everything appended so far."""
        store = self._store
        for axis, block in self._blocks.items():
            for spec in self._specs[axis] if block.rows else []:
                store.write(spec.name, block.first, [row[spec.name] for row in block.rows])
        time, iteration = (self._blocks[a].first + len(self._blocks[a].rows) for a in AXES)
        store.commit(with_progress(store.info, status=status, time=time, iteration=iteration))
        for axis, block in self._blocks.items():
            full = len(block.rows) // store.info.block * store.info.block
            self._blocks[axis] = _Block(block.first + full, block.rows[full:])

    def close(self, status: Status = "complete") -> None:
        """Commit what is left, mark the run and release the lock. Closing twice does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if status == "complete" and self._compared["time"] < self.replayed_from:
                raise ReplayError(
                    "a continued run ended before the snapshots it had committed",
                    expected=f"at least {self.replayed_from} snapshots",
                    got=self._compared["time"],
                    where=self.path,
                    do="continue with the settings the run was started with",
                )
            self.flush(status)
        finally:
            self._lock.release()

    def discard(self) -> None:
        """Delete the run if this writer began it, else mark it ``crashed``; release the lock."""
        if not self._is_new:
            self.close("crashed")
        elif not self._closed:
            self._closed = True
            try:
                shutil.rmtree(self.path)
            finally:
                self._lock.release()

    def __enter__(self) -> RunWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close("complete" if kind is None else "crashed")

    def _append(self, axis: Axis, values: Mapping[str, Any]) -> None:
        if self._closed:
            raise SnapshotError("the run is closed", where=self.path, do="open a new RunWriter")
        rows = _rows(self._specs[axis], values)
        unknown = sorted(values.keys() - rows.keys())
        if unknown:
            raise SnapshotError(
                "values that this run does not store",
                expected=sorted(rows),
                got=unknown,
                where=self.path,
                do="describe them in the RunInfo before the run starts",
            )
        n = self._compared[axis]
        if n < self._at_start[axis]:
            self._compare(n, rows)
            self._compared[axis] = n + 1
            return
        # The only change, so an interrupt leaves a whole row or none.
        self._blocks[axis].rows.append(rows)
        if len(self._blocks[axis].rows) >= self._store.info.block:
            self.flush()

    def _compare(self, n: int, rows: Mapping[str, np.ndarray]) -> None:
        if "digest" in rows and not np.array_equal(rows["digest"], self._committed_digests[n]):
            raise ReplayError(
                "the run does not repeat its committed snapshots",
                expected=f"digest {self._committed_digests[n].tobytes().hex()[:16]}...",
                got=f"digest {rows['digest'].tobytes().hex()[:16]}..., "
                f"{explain_difference(self.info.provenance, self._provenance)}",
                where=f"{self.path}, snapshot {n}",
                do="continue on the machine, with the versions and the thread count that "
                "run.info.provenance names, or collect under a new run id",
            )

    def _tail(self, axis: Axis) -> _Block:
        """Return the last, partly filled block: it will be written again as a whole."""
        n = self._store.info.committed(axis)
        first = n // self._store.info.block * self._store.info.block
        tail = {s.name: self._store.read(s.name, slice(first, n)) for s in self._specs[axis]}
        rows = [{name: np.asarray(v[i]) for name, v in tail.items()} for i in range(n - first)]
        return _Block(first, rows)


@dataclass(frozen=True)
class _Block:
    """Rows that are not committed, or share a block with such rows."""

    first: int
    """Row of the run that ``rows[0]`` is; it begins a block."""
    rows: list[dict[str, np.ndarray]]
    """Each row, by array."""


_NOTHING: dict[str, Any] = {"status": "collecting", "time": 0, "iteration": 0}
_ADAM = ("optimizer/exp_avg", "optimizer/exp_avg_sq")
_MAY_BE_NAN = ("train/", "index/learning_rate", "eval/")


def _reopen(path: Path, info: RunInfo) -> LiveStore:
    store = LiveStore.open(path)
    old = store.info
    if old.status == "complete":
        raise FormatError(
            "the run is complete; nothing can be added",
            where=path,
            do="choose another run id or path",
        )
    before, now = to_json(old), to_json(info)
    names = [n for n in now if n not in _MAY_DIFFER and now[n] != before[n]]
    if names:
        raise FormatError(
            "the run was started with other settings",
            expected={name: before[name] for name in names},
            got={name: now[name] for name in names},
            where=path,
            do="continue with the settings of the start, or choose another path",
        )
    return store


_MAY_DIFFER = (
    "status",
    "n_committed",
    "n_committed_iterations",
    "provenance",
    "profile",
    "block",  # moves no value, and large snapshots have a smaller one
    "evaluation",  # snapshots that are appended have no returns yet
    "moved_by",  # known once something has moved the weights
)


def explain_difference(stored: Provenance, now: Provenance) -> str:
    """Return what about two trainings could make them differ in bits, in words.

    >>> explain_difference(Provenance(threads=1), Provenance(threads=4))
    'in other circumstances: threads 1, now 4'
    """
    names = sorted(stored.packages | now.packages)
    pairs = {
        **{name: (stored.packages.get(name), now.packages.get(name)) for name in names},
        "platform": (stored.platform, now.platform),
        "cpu": (stored.cpu, now.cpu),
        "threads": (stored.threads, now.threads),
    }
    other = [f"{name} {old}, now {new}" for name, (old, new) in pairs.items() if old != new]
    if not other:
        return "in the same circumstances: versions, processor and threads are equal"
    return f"in other circumstances: {'; '.join(other)}"


def _moments(name: str, moments: Moments | Any | None) -> dict[str, Any]:
    return _named(name, (f"{name}/mean", f"{name}/var", f"{name}/count"), moments)


def _named(what: str, names: Sequence[str], values: Any) -> dict[str, Any]:
    """Return the values by the arrays that they belong to; nothing where there are none."""
    if values is None:
        return {}
    if not isinstance(values, list | tuple) or len(values) != len(names):
        raise SnapshotError(
            f"the snapshot's {what} has another number of values than the run stores",
            expected=f"a tuple of {len(names)}: {', '.join(names)}",
            got=f"{type(values).__name__} of {len(values) if hasattr(values, '__len__') else 1}",
            do=f"pass {what}=({', '.join(n.rpartition('/')[2] for n in names)})",
        )
    return dict(zip(names, values, strict=True))


def _rows(specs: Sequence[ArraySpec], values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """What is stored of one snapshot or iteration, array by array; one loop, since it is hot."""
    rows = {}
    for spec in specs:
        value, optional = values.get(spec.name), spec.name.startswith(_MAY_BE_NAN)
        if value is None and not optional:
            raise SnapshotError(
                "the snapshot lacks a value that this run stores",
                expected=f"{spec.name}, {spec.dtype} {spec.inner}",
                got=f"only {sorted(values)}",
                do="pass it to append",
            )
        if value is None:
            value = np.full(spec.inner, spec.fill)
        row = as_array(value, spec.dtype, spec.name)
        if row.shape != spec.inner:
            raise SnapshotError(
                "a value of the snapshot has the wrong shape",
                expected=spec.inner,
                got=row.shape,
                where=spec.name,
                do="pass what the run's layout and normaliser describe",
            )
        if row.dtype.kind == "i" and row.min(initial=-1) < -1:
            raise SnapshotError(
                "a counter of the snapshot is negative",
                expected="at least 0, or -1 for not recorded",
                got=value,
                where=spec.name,
                do="count from 0",
            )
        if not optional and row.dtype.kind == "f" and not np.isfinite(row).all():
            check_finite(spec.name, row)
        rows[spec.name] = row
    return rows


def check_finite(name: str, row: np.ndarray) -> np.ndarray:
    """Return a row of finite numbers.

    Raises:
        SnapshotError: some are NaN or infinite.
    """
    bad = np.flatnonzero(~np.isfinite(row))
    if bad.size:
        raise SnapshotError(
            "a value of the snapshot is not finite",
            expected="finite numbers",
            got=f"{bad.size} of {row.size} NaN or infinite, the first at {bad[0]}",
            where=name,
            do="the training has diverged: lower the learning rate; "
            "the snapshots before this one are kept",
        )
    return row
