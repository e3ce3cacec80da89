"""Is a run or data set whole? Says what is wrong, and mends what can be mended."""

from __future__ import annotations

import glob
import itertools
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from weighttraj.atomic import links_in, refuse_link, remove_abandoned, sync
from weighttraj.errors import DamageError, FormatError, WeightTrajError
from weighttraj.format.catalog import (
    MANIFEST,
    check_manifest,
    read_dataset_info,
    write_dataset_info,
    write_manifest,
)
from weighttraj.format.codecs import rows_in_block
from weighttraj.format.fit import find_misfit
from weighttraj.format.live import LiveStore
from weighttraj.format.objects import ZipObjects, read_document
from weighttraj.format.packing import same_as_packed
from weighttraj.format.reader import Dataset, Run, StoredArray, open_dataset, open_run
from weighttraj.format.returns import drop_returns, locked_path
from weighttraj.format.schema import AXES, RETURNS, Axis, load_json
from weighttraj.format.storage import MAX_METADATA, PACKED, RunStore, member_documents, object_grid
from weighttraj.format.tables import check_tables, write_tables
from weighttraj.format.writer import lock_run
from weighttraj.remote.address import here

MONOTONE = ("index/iteration", "index/gradient_step", "index/num_timesteps")

_DRAFT = re.compile(r"\..+\.\d+\.draft")
_DROPPED = "damaged returns dropped; weighttraj returns evaluates the snapshots again"


def verify(path: str | Path, *, deep: bool = False, console: Console | None = None) -> list[str]:
    """Problems of the data set, run or HDF5 file at a path; an empty list means that it is whole.

    Every byte is read. Of a complete data set, each object is compared with its hash in the
    manifest, each snapshot with its digest, and the tables with the runs. Of anything else, or with
    ``deep``, every chunk is decoded too, counters must not go back and weights must be finite.

    Args:
        path: data set, run or HDF5 file.
        deep: decode everything.
        console: where progress is shown; None: nowhere.

    Raises:
        FileNotFoundError: there is neither a data set nor a run at the path.
    """
    path = here(path)
    try:
        if (path / "dataset.json").is_file():
            return _verify_dataset(open_dataset(path), deep, console or Console(quiet=True))
        if path.suffix == ".h5":
            return [p for run in open_dataset(path) for p in _verify_arrays(run, deep=True)]
        return [*links_in(path), *_verify_run(open_run(path), deep=True)]
    except WeightTrajError as error:
        return [str(error)]


def seal(path: str | Path) -> Dataset:
    """Write the tables and, last, the manifest of a complete data set.

    Raises:
        FormatError: some of its runs are not complete.
    """
    dataset = open_dataset(path)
    open_runs = [run.id for run in dataset if run.info.status != "complete"]
    if open_runs or len(dataset) < len(dataset.info.runs):
        raise FormatError(
            "only a complete data set can be sealed",
            expected=f"{len(dataset.info.runs)} complete runs",
            got=f"{len(dataset)} runs, not complete: {open_runs}",
            where=path,
            do="give the command that collects it again: it goes on where it stopped",
        )
    write_tables(dataset)
    write_manifest(Path(dataset.path))
    return dataset


def unseal(path: str | Path) -> None:
    """Remove the manifest of a data set, before its runs are changed; ``seal`` writes it again.

    A complete data set stays complete: it opens and has all its runs. Until it is sealed,
    ``verify`` says that the manifest is missing. Where there is none, nothing is done.

    Raises:
        FileNotFoundError: there is no data set at the path.
        FormatError: it is none of this format.
    """
    path = here(path)
    read_dataset_info(path)
    (path / MANIFEST).unlink(missing_ok=True)
    sync(path)


def repair(path: str | Path, *, cut: bool = False) -> list[str]:
    """Mend what can be mended without the training; say what was done and what is left to do.

    Metadata of arrays are written again from the run's checked metadata, rows that were never
    committed and drafts of killed writers are removed, and the tables and manifest of a data set
    whose runs are whole are written anew.

    Args:
        path: data set or run.
        cut: drop damaged returns; drop damaged snapshots, and those after them. The run is then
            ``crashed``, and collecting its recipe again makes what was dropped, in the same bytes.

    Raises:
        FileNotFoundError: there is neither a data set nor a run at the path.
        FormatError: its own metadata is damaged; only a copy helps.
        StoreLockedError: a run is being written.
    """
    path = here(path)
    if not (path / "dataset.json").is_file():
        return _repair_run(path, cut)
    info = read_dataset_info(path)
    steps = {run.path: _repair_entry(path, run.path, cut) for run in info.runs}
    done = [step for entry in steps.values() for step in entry]
    if info.status == "complete":
        # A packed run of which nothing is to be said was just found whole.
        again = [entry for entry in steps if steps[entry] or not entry.endswith(PACKED)]
        damaged = [entry for entry in again if _problems_of(path / entry)]
        if damaged or read_dataset_info(path).status != "complete":
            return [*done, "the manifest is not written again: the data set is not whole"]
        if check_manifest_quietly(path) or check_tables(open_dataset(path)):
            seal(path)
            done.append(f"{path}: tables and manifest written anew")
    return done


def check_manifest_quietly(path: Path, shown: Callable[..., Any] = iter) -> list[str]:
    """Problems of the manifest, also when it cannot be read."""
    try:
        return check_manifest(path, shown)
    except WeightTrajError as error:
        return [str(error)]


def _verify_dataset(dataset: Dataset, deep: bool, console: Console) -> list[str]:
    bar = partial(track, console=console, disable=console.quiet, transient=True)
    complete, path = dataset.info.status == "complete", Path(dataset.path)
    problems = list(links_in(path))
    problems += check_manifest_quietly(path, partial(bar, description="files")) if complete else []
    for run in bar(dataset.runs, description="runs"):
        try:
            problems += _verify_run(run, deep=deep or not complete)
        except WeightTrajError as error:
            problems.append(str(error))
    if complete and not problems:
        problems += check_tables(dataset)
    return problems


def _problems_of(path: Path) -> list[str]:
    try:
        return [*links_in(path), *_verify_run(open_run(path), deep=True)]
    except (WeightTrajError, FileNotFoundError) as error:
        return [str(error)]


def _verify_run(run: Run, *, deep: bool) -> Iterator[str]:
    yield from _verify_objects(RunStore.open(run.path))
    yield from _verify_arrays(run, deep=deep)


def _verify_arrays(run: Run, *, deep: bool) -> Iterator[str]:
    if misfit := find_misfit(run.info.policy, run.layout, run.info.obs_norm):
        yield f"{run.path}, zarr.json: the policy does not fit its parameters: {misfit}"
    for name, array in run.arrays.items():
        if not deep and name != "policy/weights":
            continue
        try:
            yield from _verify_array(name, array, where=str(run.path))
        except WeightTrajError as error:
            yield str(error)


def _verify_objects(store: RunStore) -> Iterator[str]:
    """Objects that are missing or strange, and metadata that are not as they were written."""
    text = read_document(store.objects, "zarr.json", MAX_METADATA) or b""
    if json.dumps(json.loads(text), indent=1).encode() != text:
        yield f"{store.path}, zarr.json: not in the form in which it was written"
    documents = member_documents(store.documents)
    for name, content in documents.items():
        got = read_document(store.objects, name) or b""
        if got != content and not _is_earlier(store, name, got):
            yield (
                f"{store.path}, {name}: not what the run's metadata says; a writer was "
                "interrupted, or the file is damaged (weighttraj repair writes it again)"
            )
    present = set(_names(store))
    expected = {"zarr.json", *documents}
    for name in store.documents:
        if (count := math.prod(object_grid(store.documents[name]))) > len(present):
            yield f"{store.path}, {name}: {count} chunks expected, only {len(present)} objects"
            return
        expected |= set(_chunk_keys(store, name))
    yield from (f"{store.path}, {name}: missing" for name in sorted(expected - present))
    for name in sorted(present - expected) if store.info.status == "complete" else ():
        yield f"{store.path}, {name}: not part of what was committed (weighttraj repair removes it)"
    if isinstance(store.objects, ZipObjects) and not same_as_packed(Path(store.path)):
        yield f"{store.path}: bytes of the zip file's own directory are damaged"


def _is_earlier(store: RunStore, name: str, content: bytes) -> bool:
    """Whether metadata are those of an earlier commit: a run is being written at this moment."""
    array = name.removesuffix("/zarr.json")
    if store.info.status != "collecting" or array not in store.specs:
        return False
    try:
        document = load_json(content, name)
        rows, shape = document["shape"][0], store.documents[array]["shape"]
        document["shape"] = shape
        return bool(0 <= rows <= shape[0]) and document == store.documents[array]
    except (ValueError, TypeError, KeyError, IndexError):
        return False


def _verify_array(name: str, array: StoredArray, *, where: str) -> Iterator[str]:
    last = None
    for start, rows in array.pieces():
        if name == "policy/weights" and (bad := [i for i, r in enumerate(rows) if not _finite(r)]):
            yield f"{where}, {name}: not finite at row {start + bad[0]}"
        if name in MONOTONE:
            steps = np.diff(rows, prepend=rows[:1] if last is None else last)
            if (steps < 0).any():
                yield f"{where}, {name}: goes back at row {start + int(np.argmax(steps < 0))}"
            last = rows[-1:]


def _finite(row: np.ndarray) -> bool:
    return bool(np.isfinite(row).all())


def _chunk_keys(store: RunStore, name: str) -> Iterator[str]:
    """Names of all chunks of an array's committed rows."""
    for index in itertools.product(*map(range, object_grid(store.documents[name]))):
        yield "/".join([name, "c", *map(str, index)])


def _is_chunk(store: RunStore, name: str) -> bool:
    """Whether an object is a chunk of committed rows."""
    array, _, index = name.rpartition("/c/")
    if array not in store.documents or re.fullmatch(r"\d{1,18}(/\d{1,18})*", index) is None:
        return False
    place, grid = [int(i) for i in index.split("/")], object_grid(store.documents[array])
    plain = "/".join(map(str, place)) == index and len(place) == len(grid)
    return plain and all(i < n for i, n in zip(place, grid, strict=True))


def _names(store: RunStore) -> Iterator[str]:
    if isinstance(store.objects, ZipObjects):
        yield from store.objects.names
        return
    folder = Path(store.path)
    for file in folder.rglob("*"):
        if file.is_symlink() or not file.is_dir():
            yield file.relative_to(folder).as_posix()


def _repair_entry(dataset: Path, entry: str, cut: bool) -> list[str]:
    """Repair one run of a data set; a packed one that is damaged can only be made again."""
    path = refuse_link(dataset / entry, dataset)
    if not path.exists():
        return (
            [f"{path}: missing; collect the recipe again"] if not cut else _forget(dataset, entry)
        )
    if not entry.endswith(PACKED):
        return _repair_run(path, cut)
    problems = _problems_of(path)
    if not problems:
        return []
    if not cut:
        return [*problems, f"{path}: damaged; --cut drops it, so that it is collected again"]
    if _drop_packed_returns(path) and not _problems_of(path):
        return [f"{path}: {_DROPPED}"]
    path.rename(path.with_name(f".{path.name}.damaged"))
    return _forget(dataset, entry)


def _forget(dataset: Path, entry: str) -> list[str]:
    """Note that a run of a data set is to be collected again."""
    info = read_dataset_info(dataset)
    new = entry.removesuffix(PACKED)
    runs = tuple(replace(r, path=new) if r.path == entry else r for r in info.runs)
    (dataset / MANIFEST).unlink(missing_ok=True)
    write_dataset_info(dataset, replace(info, runs=runs, status="collecting"))
    return [f"{dataset / entry}: dropped; collect the recipe again"]


def _repair_run(path: Path, cut: bool) -> list[str]:
    if path.is_file():
        return _problems_of(path)
    with lock_run(path):
        before = {p for p in _problems_of(path) if "weighttraj repair" in p}
        store = LiveStore.open(path)
        _sweep(store)
        done = [f"mended: {problem}" for problem in sorted(before)]
        if _has_damaged_returns(store):
            if cut:
                drop_returns(store)
                store = LiveStore.open(path)
                _sweep(store)
            done.append(f"{path}: {_DROPPED if cut else 'damaged returns; --cut drops them'}")
        rows = {axis: _whole_rows(store, axis) for axis in AXES}
        if all(rows[axis] == store.info.committed(axis) for axis in AXES):
            return done
        if not cut:
            return [
                *done,
                f"{path}: damaged after row {rows['time']} of {store.info.n_committed}; --cut "
                "drops what follows, so that it is collected again",
            ]
        store.commit(
            replace(
                store.info,
                status="crashed",
                n_committed=rows["time"],
                n_committed_iterations=rows["iteration"],
            )
        )
        _sweep(store)
    return [*done, f"{path}: cut to {rows['time']} snapshots; collect the recipe again"]


def _has_damaged_returns(store: RunStore) -> bool:
    if store.info.evaluation is None:
        return False
    try:
        for name in RETURNS:
            store.read(name, slice(None))
    except DamageError:
        return True
    return False


def _drop_packed_returns(path: Path) -> bool:
    """Drop the returns of a packed run if they are damaged, and nothing else is; says so."""
    try:
        with lock_run(locked_path(path)):
            store = RunStore.open(path)
            if damaged := _has_damaged_returns(store):
                drop_returns(store)
            return damaged
    except (FormatError, FileNotFoundError):
        return False


def _sweep(store: LiveStore) -> None:
    """Remove files that belong to nothing that was committed."""
    documents = member_documents(store.documents)
    for name in _names(store):
        if not _is_chunk(store, name) and name not in documents and name != "zarr.json":
            (store.path / name).unlink()
    remove_abandoned(store.path)
    for draft in store.path.parent.glob(f".{glob.escape(store.path.name)}.*"):
        if _DRAFT.fullmatch(draft.name) and draft.is_dir() and not draft.is_symlink():
            shutil.rmtree(draft)


def _whole_rows(store: RunStore, axis: Axis) -> int:
    """Rows before the first damaged one, in whole blocks; returns can be got again."""
    n, block = store.info.committed(axis), store.info.block
    specs = [s for s in store.specs.values() if s.axis == axis and s.name not in RETURNS]
    for start in range(0, n, block):
        try:
            for spec in specs:
                step = rows_in_block([spec], block)  # old blocks of large rows are larger
                for first in range(start, min(start + block, n), step):
                    StoredArray(store, spec)[first : min(first + step, start + block)]
        except DamageError:
            return start
    return n


__all__ = ["repair", "seal", "unseal", "verify"]
