"""Checks whether a run or a data set is whole, and says what is wrong."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from weighttraj.atomic import links_in
from weighttraj.dataset import Dataset
from weighttraj.errors import WeightTrajError
from weighttraj.format.fit import find_misfit
from weighttraj.format.schema import load_json
from weighttraj.opening import open_dataset, open_run
from weighttraj.remote.address import here
from weighttraj.run import Run, StoredArray
from weighttraj.store.catalog import check_manifest
from weighttraj.store.objects import ZipObjects, read_document
from weighttraj.store.zarr_run import MAX_METADATA, RunStore, member_documents, object_grid
from weighttraj.tools.pack import same_as_packed
from weighttraj.tools.tables import check_tables

MONOTONE = ("index/iteration", "index/gradient_step", "index/num_timesteps")


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


def check_manifest_quietly(path: Path, shown: Callable[..., Any] = iter) -> list[str]:
    """Return problems of the manifest, also when it cannot be read."""
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


def problems_of_run(path: Path) -> list[str]:
    """Return the problems of one run, every chunk of it decoded."""
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
    """Yield objects that are missing or strange, and metadata that are not as they were written."""
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
    present = set(object_names(store))
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
        if name == "policy/weights" and (
            bad := [i for i, r in enumerate(rows) if not np.isfinite(r).all()]
        ):
            yield f"{where}, {name}: not finite at row {start + bad[0]}"
        if name in MONOTONE:
            steps = np.diff(rows, prepend=rows[:1] if last is None else last)
            if (steps < 0).any():
                yield f"{where}, {name}: goes back at row {start + int(np.argmax(steps < 0))}"
            last = rows[-1:]


def _chunk_keys(store: RunStore, name: str) -> Iterator[str]:
    """Yield names of all chunks of an array's committed rows."""
    for index in itertools.product(*map(range, object_grid(store.documents[name]))):
        yield "/".join([name, "c", *map(str, index)])


def is_chunk(store: RunStore, name: str) -> bool:
    """Return whether an object is a chunk of committed rows."""
    array, _, index = name.rpartition("/c/")
    if array not in store.documents or re.fullmatch(r"\d{1,18}(/\d{1,18})*", index) is None:
        return False
    place, grid = [int(i) for i in index.split("/")], object_grid(store.documents[array])
    plain = "/".join(map(str, place)) == index and len(place) == len(grid)
    return plain and all(i < n for i, n in zip(place, grid, strict=True))


def object_names(store: RunStore) -> Iterator[str]:
    """Yield the names of all objects that lie in a run, expected or not."""
    if isinstance(store.objects, ZipObjects):
        yield from store.objects.names
        return
    folder = Path(store.path)
    for file in folder.rglob("*"):
        if file.is_symlink() or not file.is_dir():
            yield file.relative_to(folder).as_posix()
