"""Fills ``eval/returns`` and ``eval/lengths`` of the runs of a data set, and goes on when stopped.

Each block of snapshots that has been played is written to a journal, one line a snapshot, in the
hidden folder ``.returns`` of the data set. When all snapshots of a run are played, the run gets its
arrays and the journal goes.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import math
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from weighttraj.atomic import acquired, appending, lock_of, refuse_link, replace_file
from weighttraj.dataset import Dataset
from weighttraj.engine import Engine, Tell, engine_of
from weighttraj.errors import PolicyError
from weighttraj.format import Evaluation
from weighttraj.learning import learning_phase
from weighttraj.opening import open_dataset, open_run
from weighttraj.policies.batch import load_policies
from weighttraj.policies.rollout import EpisodeReturns, Evaluator, env_of
from weighttraj.policies.simulators import GymnasiumSimulator
from weighttraj.progress import LoggedProgress
from weighttraj.remote.address import here
from weighttraj.run import Run
from weighttraj.store.catalog import DATASET, MANIFEST, read_dataset_info
from weighttraj.store.objects import MAX_DOCUMENT_BYTES
from weighttraj.store.zarr_run import PACKED
from weighttraj.text import printable
from weighttraj.tools.repair import seal, unseal
from weighttraj.tools.returns import store_returns

Mode = Literal["deterministic", "sampled"]

_TELL_EVERY = 0.5
"""Seconds."""

BLOCK = 32
"""Snapshots that are played, and written to the journal, at a time."""


@dataclass(frozen=True, kw_only=True)
class ReturnsConfig:
    """Which snapshots are evaluated, and in which episodes."""

    episodes: int = 10
    """Episodes for each action mode; episode i starts from reset(seed=seed + i)."""
    every: int = 10
    """Every how many snapshots; the last one is always evaluated."""
    first: int = 0
    """Also each of the first N snapshots: policies change most at the start."""
    learning: int = 0
    """Also every N-th snapshot of each run's learning phase, which ends where the return has come
    95 % of the way from its first to its final value; 0: none."""
    modes: tuple[Mode, ...] = ("deterministic", "sampled")
    """Actions: the distribution's mode, samples, or both."""
    seed: int = 0
    """Seed of the first episode."""

    def __post_init__(self) -> None:
        least = (self.episodes, self.every, self.first + 1, self.learning + 1, self.seed + 1)
        wrong = min(least) < 1
        if wrong or not self.modes or len(set(self.modes)) < len(self.modes):
            raise PolicyError(
                "these settings evaluate nothing",
                expected="episodes and every at least 1, first, learning and seed at least 0, "
                "one or two different modes",
                got=self,
                do="change these settings",
            )

    def rows(self, snapshots: int) -> list[int]:
        """Return the snapshots to be evaluated of a run, leaving its learning phase aside."""
        chosen = {*range(0, snapshots, self.every), *range(min(self.first, snapshots))}
        return sorted(chosen | {snapshots - 1}) if snapshots else []

    def evaluation(self, simulator: str) -> Evaluation:
        """Return what the run's metadata say of it."""
        seeds = tuple(range(self.seed, self.seed + self.episodes))
        return Evaluation(
            seeds=seeds * len(self.modes),
            deterministic=tuple(mode == "deterministic" for mode in self.modes for _ in seeds),
            every=self.every,
            first=self.first,
            learning=self.learning,
            simulator=simulator,
            packages={
                name: importlib.metadata.version(name)
                for name in ("gymnasium", "mujoco", "numpy", "torch")
            },
        )


@dataclass(frozen=True, kw_only=True)
class _Task:
    """Snapshots of one run to be played."""

    path: Path
    rows: list[int]
    config: ReturnsConfig


def fill_returns(
    path: str | Path,
    config: ReturnsConfig | None = None,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    imports: Sequence[str] = (),
    replace: bool = False,
    console: Console | None = None,
) -> Dataset:
    """Evaluate stored policies and store their returns in the runs of a data set, or in one run.

    What is stored already, or was played before an interruption, is not played again. Runs that are
    still being collected are left for later. The result does not depend on the number of workers.

    Args:
        path: data set or run. Of a run in a data set, that run only is evaluated, and the tables
            and the manifest of the data set are written again.
        config: which snapshots and episodes; None: the defaults.
        workers: processes; 1 means this one.
        scheduler: address of a Dask scheduler whose workers do it instead, or ``local``; see
            ``weighttraj.engine``.
        imports: modules that register environments; every worker imports them.
        replace: drop returns of another evaluation (other episodes, versions of the physics).
        console: where progress is shown; None: nowhere.

    Returns:
        The data set, opened again.

    Raises:
        FileNotFoundError: there is no data set at the path.
        EngineError: there are no workers, or no scheduler answers.
        PolicyError: a run has returns of another evaluation, or cannot be evaluated.
        StoreLockedError: somebody else is doing the same.
        KeyboardInterrupt: it was stopped; what was played stays.
    """
    path, config = here(path).absolute(), config or ReturnsConfig()
    console = console or Console(quiet=True)
    dataset = open_dataset(path)  # before a lock is put beside it: is there one?
    path = Path(dataset.path)
    if path.suffix == ".h5":
        raise PolicyError(
            "returns are not stored in an HDF5 file",
            expected="a data set in a folder, or a run",
            got="an HDF5 file",
            where=path,
            do=f"weighttraj import {path} --out FOLDER, and evaluate the runs there",
        )
    owner = _owner(path)
    home = owner or path.parent
    with engine_of(workers, scheduler, imports) as engine, _only_one((owner or path).resolve()):
        runs = _finished(open_dataset(path), console)
        every = [_Work(run, home, config, replace=replace) for run in runs]
        works = [work for work in every if work.missing or work.unsaved]
        _say_broken(every, console)
        if works and owner:
            unseal(owner)
        _play(works, engine, console)
        # Also when a run got its returns before a kill, and the tables did not.
        if owner and _is_unsealed(owner):
            seal(owner)
    return open_dataset(path)


def _owner(path: Path) -> Path | None:
    """Return the data set at a path, or the one that a run at the path is listed in; None: none."""
    if (path / DATASET).is_file():
        return path
    above = path.parent.parent
    if path.parent.name == "runs" and (above / DATASET).is_file():
        listed = {above / entry.path for entry in read_dataset_info(above).runs}
        return above if path in listed else None
    return None


def _is_unsealed(path: Path) -> bool:
    return read_dataset_info(path).status == "complete" and not (path / MANIFEST).is_file()


_SAME = ("seeds", "deterministic", "normalizer", "simulator")
"""What must be equal for returns of two evaluations to stand in one array."""

_Played = dict[int, tuple[np.ndarray, np.ndarray]]
"""Returns and lengths, each (episode,), by snapshot."""


class _Work:
    """What is still to be done for one run.

    Args:
        run: the run.
        dataset: folder of the data set.
        config: the settings.
        replace: forget returns of another evaluation.
    """

    def __init__(self, run: Run, dataset: Path, config: ReturnsConfig, *, replace: bool) -> None:
        self.run, self.config = run, config
        with Evaluator(env_of(run), episodes=1) as evaluator:
            self.evaluation = config.evaluation(evaluator.simulator)
        self._journal = _Journal(dataset, f"{run.id}.jsonl", self._header())
        self._finite: dict[int, bool] = {}
        self.played = self._stored(replace=replace) | self._journal.rows
        self.unsaved = len(self._journal.rows)
        packed = Path(run.path).suffix == PACKED
        if self.missing and run.info.evaluation is not None and not packed:
            raise PolicyError(
                "the run has other returns, and those of a folder are not replaced",
                expected="a run without returns, or a packed one",
                got=run.info.evaluation,
                where=run.path,
                do="pack the run (weighttraj.pack), remove its folder, and give the command again",
            )

    @property
    def missing(self) -> list[int]:
        """Snapshots that are still to be played, as far as they are known."""
        missing = self._to_play(self.config.rows(len(self.run)))
        if missing or not self.config.learning:
            return missing
        # Only now the returns tell how far the learning phase goes.
        return self._to_play(range(0, self._learned() + 1, self.config.learning))

    def _to_play(self, rows: Sequence[int]) -> list[int]:
        """Return the snapshots that were not played and can be: their weights are finite."""
        rows = [row for row in rows if row not in self.played]
        unknown = [row for row in rows if row not in self._finite]
        for start in range(0, len(unknown), BLOCK):
            block = unknown[start : start + BLOCK]
            finite = [bool(np.isfinite(row).all()) for row in self.run.weights[block]]
            self._finite |= dict(zip(block, finite, strict=True))
        return [row for row in rows if self._finite[row]]

    @property
    def broken(self) -> list[int]:
        """Snapshots whose weights are not finite, as far as they were asked for."""
        return sorted(row for row, finite in self._finite.items() if not finite)

    def begin(self) -> None:
        """Begin the journal; store what an earlier one holds, if that is all."""
        self._journal.begin()
        if not self.missing:
            self.save()

    def tasks(self) -> Iterator[_Task]:
        """Yield the missing snapshots in blocks."""
        missing = self.missing
        for start in range(0, len(missing), BLOCK):
            rows = missing[start : start + BLOCK]
            yield _Task(path=Path(self.run.path), rows=rows, config=self.config)

    def add(self, rows: list[int], played: EpisodeReturns) -> None:
        """Keep the outcome of a block; store everything in the run if nothing is missing."""
        new = {row: (played.returns[i], played.lengths[i]) for i, row in enumerate(rows)}
        self._journal.append(new)
        self.played |= new
        if not self.missing:
            self.save()

    def save(self) -> None:
        """Store what was played in the run."""
        shape = (len(self.run), len(self.evaluation.seeds))
        returns, lengths = np.full(shape, np.nan), np.full(shape, -1, np.int64)
        for row, (row_returns, row_lengths) in self.played.items():
            returns[row], lengths[row] = row_returns, row_lengths
        store_returns(Path(self.run.path), self.evaluation, returns, lengths)
        self._journal.remove()

    def _learned(self) -> int:
        """Return where the learning phase ends, by sampled actions if there are any.

        Only the snapshots outside the dense part tell: the answer must not change as it is played.
        """
        deterministic = np.array(self.evaluation.deterministic)
        columns = ~deterministic if not deterministic.all() else deterministic
        means = np.full(len(self.run), np.nan)
        for row in self.config.rows(len(self.run)):
            if row in self.played:  # else its weights are not finite
                means[row] = self.played[row][0][columns].mean()
        return learning_phase(means)

    def _stored(self, *, replace: bool) -> _Played:
        before = self.run.info.evaluation
        if before is None:
            return {}
        differs = [
            name for name in _SAME if getattr(before, name) != getattr(self.evaluation, name)
        ]
        physics = ("mujoco", "gymnasium")
        differs += [p for p in physics if before.packages.get(p) != self.evaluation.packages[p]]
        if differs and replace:
            return {}
        if differs:
            raise PolicyError(
                "the run has returns of another evaluation",
                expected=f"the same {', '.join(_SAME)}, and versions of {' and '.join(physics)}",
                got=f"another {', '.join(differs)}: {before}",
                where=self.run.path,
                do="give the settings that it was evaluated with, or replace=True (--replace) "
                "to evaluate it anew",
            )
        returns, lengths = self.run["eval/returns"][:], self.run["eval/lengths"][:]
        known = np.flatnonzero((lengths != -1).all(1))
        return {int(row): (returns[row], lengths[row]) for row in known}

    def _header(self) -> dict[str, Any]:
        """Return what a journal must begin with to be of this run and these settings."""
        digest = self.run["digest"][-1].tobytes().hex() if len(self.run) else ""
        told = asdict(self.evaluation) | {"digest": digest, "snapshots": len(self.run)}
        del told["learning"]  # as `every` and `first`, it does not change how episodes are played
        header: dict[str, Any] = json.loads(json.dumps(told | {"every": None, "first": None}))
        return header


class _Journal:
    """Snapshots that were played, a line of crc32 and JSON each.

    A line that a kill cut short, or that is damaged, is dropped, and what follows it.

    Args:
        dataset: folder of the data set. It may be a stranger's: no part of the path is a link.
        name: of the file.
        header: its first line; a journal with another one is begun again.

    Raises:
        FormatError: the journal, or its folder, is a link.
    """

    def __init__(self, dataset: Path, name: str, header: dict[str, Any]) -> None:
        self._root, self._header = dataset, header
        self._path = refuse_link(dataset / ".returns" / name, dataset)
        self.rows = self._read()

    def begin(self) -> None:
        """Write the journal again, with the lines that are whole."""
        replace_file(self._path, _line(self._header), root=self._root)
        self.append(self.rows)

    def _read(self) -> _Played:
        if not self._path.is_file():
            return {}
        rows: _Played = {}
        first = _line(self._header)
        with self._path.open("rb") as file:
            if file.readline(len(first)) != first:
                return {}
            while line := file.readline(MAX_DOCUMENT_BYTES):
                entry = _entry(line)
                if entry is None or not self._fits(entry):
                    break  # what follows a damaged line is played again
                returns = np.array([np.nan if x is None else x for x in entry.returns])
                rows[entry.t] = (returns, np.array(entry.lengths, np.int64))
        return rows

    def _fits(self, entry: _Entry) -> bool:
        """Return whether a line is of a snapshot of the run, and has a column for each episode."""
        episodes = len(self._header["seeds"])
        columns = len(entry.returns) == len(entry.lengths) == episodes
        return columns and 0 <= entry.t < self._header["snapshots"]

    def append(self, rows: _Played) -> None:
        """Write lines; when this returns they survive a power cut."""
        with appending(self._path, root=self._root) as file:
            for row, (returns, lengths) in rows.items():
                numbers = [None if np.isnan(x) else float(x) for x in returns]
                entry = {"t": row, "returns": numbers, "lengths": lengths.tolist()}
                file.write(_line(entry))

    def remove(self) -> None:
        """Remove it, and the folder if no other journal is in it."""
        self._path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._path.parent.rmdir()


class _Entry(msgspec.Struct):
    """One line of a journal."""

    t: int
    """The snapshot."""
    returns: list[float | None]
    """Return of each episode; None: the simulation became unstable."""
    lengths: list[Annotated[int, msgspec.Meta(ge=-1, lt=2**31)]]
    """Steps of each episode."""


def _entry(line: bytes) -> _Entry | None:
    """Parse a line of a journal; None: it is damaged."""
    checksum, _, text = line.removesuffix(b"\n").partition(b" ")
    if checksum != f"{zlib.crc32(text):08x}".encode() or not line.endswith(b"\n"):
        return None
    try:
        return msgspec.json.decode(text, type=_Entry)
    except (msgspec.DecodeError, RecursionError):
        return None


def _line(entry: dict[str, Any]) -> bytes:
    text = json.dumps(entry).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _finished(dataset: Dataset, console: Console) -> list[Run]:
    """Return finished runs. Skip folders that are already packed: they are about to be deleted."""
    left: dict[str, list[str]] = {}
    done = []
    for run in dataset:
        if run.info.status == "collecting":
            left.setdefault("still being collected", []).append(run.id)
        elif Path(f"{run.path}{PACKED}").is_file():
            left.setdefault("packed, but their folders are still there", []).append(run.id)
        else:
            done.append(run)
    for why, ids in left.items():
        console.print(f"{why}, so left for later: {', '.join(ids)}")
    return done


def _say_broken(works: Sequence[_Work], console: Console) -> None:
    for work in works:
        if broken := work.broken:
            console.print(
                f"{work.run.id}: {len(broken)} snapshots have weights that are NaN or infinite, "
                f"the first at t = {broken[0]}, so they are not evaluated"
            )


def _play(works: Sequence[_Work], engine: Engine, console: Console) -> None:
    """Play all tasks of all runs."""
    if slow := sorted({env_of(work.run).id for work in works if _is_slow(work)}):
        names = printable(", ".join(slow))  # ids of environments, a stranger's perhaps
        console.print(f"{names}: no batched physics, so Gymnasium's own loop, slowly", markup=False)
    for work in works:
        work.begin()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("policies,"),
        TimeElapsedColumn(),
        TextColumn("so far,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with LoggedProgress(*columns, console=console) as progress:
        bar = progress.add_task("returns", total=0)
        # What is missing of a learning phase is known once the other snapshots have been played.
        while tasks := {(t.path, t.rows[0]): (work, t) for work in works for t in work.tasks()}:
            total = progress.tasks[bar].completed + sum(len(t.rows) for _, t in tasks.values())
            progress.update(bar, total=total)
            # Nothing is lost with a worker that is stopped at once.
            blocks = [task for _, task in tasks.values()]
            for task, played in engine.run(play_rows, blocks, lambda: None, wait=False):
                if isinstance(played, Exception):
                    raise played
                tasks[task.path, task.rows[0]][0].add(task.rows, played)
                progress.advance(bar, len(task.rows))


def _is_slow(work: _Work) -> bool:
    return work.evaluation.simulator == GymnasiumSimulator.name


def play_rows(task: _Task, tell: Tell) -> EpisodeReturns:
    """Returns and lengths (snapshot, episode) of some snapshots, both modes side by side."""
    run, config = open_run(task.path), task.config
    policies = load_policies(run, task.rows)
    tick = _seldom(tell)  # it may be time to stop
    with Evaluator(env_of(run), episodes=config.episodes, seed=config.seed) as evaluator:
        played = [
            evaluator(policies, deterministic=mode == "deterministic", tick=tick)
            for mode in config.modes
        ]
    returns, lengths = (np.concatenate(parts, axis=1) for parts in zip(*played, strict=True))
    return EpisodeReturns(returns, lengths)


def _seldom(tell: Tell) -> Callable[[], None]:
    """Return a function that calls ``tell`` at most every half second: it may be a message."""
    told = -math.inf

    def tick() -> None:
        nonlocal told
        if time.monotonic() - told > _TELL_EVERY:
            told = time.monotonic()
            tell()

    return tick


@contextlib.contextmanager
def _only_one(path: Path) -> Iterator[None]:
    lock = acquired(
        lock_of(path.with_name(f".{path.name}.lock")),  # the one that a collection holds
        "another process is changing this data set",
        where=path,
        do="wait for its collection or evaluation to end, or stop it",
    )
    try:
        yield
    finally:
        lock.release()
