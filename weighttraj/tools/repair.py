"""Repairs runs and data sets, and writes the tables and the manifest of complete ones."""

from __future__ import annotations

import glob
import re
import shutil
from dataclasses import replace
from pathlib import Path

from weighttraj.atomic import refuse_link, remove_abandoned, sync
from weighttraj.dataset import Dataset
from weighttraj.errors import DamageError, FormatError
from weighttraj.format.schema import AXES, RETURNS, Axis
from weighttraj.opening import open_dataset
from weighttraj.remote.address import here
from weighttraj.run import StoredArray
from weighttraj.store.catalog import MANIFEST, read_dataset_info, write_dataset_info, write_manifest
from weighttraj.store.codecs import rows_in_block
from weighttraj.store.live import LiveStore, lock_run
from weighttraj.store.zarr_run import PACKED, RunStore, member_documents
from weighttraj.tools.returns import drop_returns, locked_path
from weighttraj.tools.tables import check_tables, write_tables
from weighttraj.tools.verify import check_manifest_quietly, is_chunk, object_names, problems_of_run


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
    whose runs are whole are written again.

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
        damaged = [entry for entry in again if problems_of_run(path / entry)]
        if damaged or read_dataset_info(path).status != "complete":
            return [*done, "the manifest is not written again: the data set is not whole"]
        if check_manifest_quietly(path) or check_tables(open_dataset(path)):
            seal(path)
            done.append(f"{path}: tables and manifest written anew")
    return done


def _repair_entry(dataset: Path, entry: str, cut: bool) -> list[str]:
    """Repair one run of a data set; a packed one that is damaged can only be made again."""
    path = refuse_link(dataset / entry, dataset)
    if not path.exists():
        return (
            [f"{path}: missing; collect the recipe again"] if not cut else _forget(dataset, entry)
        )
    if not entry.endswith(PACKED):
        return _repair_run(path, cut)
    problems = problems_of_run(path)
    if not problems:
        return []
    if not cut:
        return [*problems, f"{path}: damaged; --cut drops it, so that it is collected again"]
    if _drop_packed_returns(path) and not problems_of_run(path):
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
        return problems_of_run(path)
    with lock_run(path):
        before = {p for p in problems_of_run(path) if "weighttraj repair" in p}
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
    for name in object_names(store):
        if not is_chunk(store, name) and name not in documents and name != "zarr.json":
            (store.path / name).unlink()
    remove_abandoned(store.path)
    for draft in store.path.parent.glob(f".{glob.escape(store.path.name)}.*"):
        if _DRAFT.fullmatch(draft.name) and draft.is_dir() and not draft.is_symlink():
            shutil.rmtree(draft)


def _whole_rows(store: RunStore, axis: Axis) -> int:
    """Return rows before the first damaged one, in whole blocks; returns can be got again."""
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


_DRAFT = re.compile(r"\..+\.\d+\.draft")


_DROPPED = "damaged returns dropped; weighttraj returns evaluates the snapshots again"
