"""Brings a data set here, or a part of it; goes on where it was stopped, and checks every byte."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from filelock import FileLock, Timeout
from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from weighttraj.atomic import refuse_existing, replace_file
from weighttraj.dataset import Dataset
from weighttraj.errors import DamageError, FormatError, RegistryError, RemoteError, StoreLockedError
from weighttraj.format import RunEntry
from weighttraj.locate import VARIABLE, folders
from weighttraj.opening import open_dataset
from weighttraj.progress import LoggedProgress
from weighttraj.remote.address import RemotePath
from weighttraj.remote.failures import BrokenOffError, NoPartsError
from weighttraj.remote.store import RemoteStore, store_at
from weighttraj.remote.wait import for_each
from weighttraj.store.catalog import (
    DATASET,
    MANIFEST,
    ManifestLine,
    parse_manifest,
    write_dataset_info,
)
from weighttraj.store.zarr_run import PACKED
from weighttraj.tools.pack import cut
from weighttraj.tools.repair import seal

REQUEST = ".request.json"
"""File in an unfinished download: which part of the runs was asked for."""
SOURCE = ".source.json"
"""File in a downloaded data set that says where it is from; no object of the data set."""
_ODD = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
TRIES = 5
"""Times that a file is gone on with after an answer broke off without a byte."""


@dataclass(frozen=True)
class Source:
    """Where a data set was downloaded from."""

    repository: str
    """Address without a revision."""
    revision: str | None = None
    """Revision that was asked for; None: none was."""
    commit: str | None = None
    """Commit that this was, on the hub."""


def download(
    address: str,
    out: str | Path | None = None,
    *,
    runs: Collection[str] | None = None,
    steps: tuple[int, int] | None = None,
    arrays: Collection[str] | None = None,
    revision: str | None = None,
    console: Console | None = None,
) -> Dataset:
    """Download a data set, or some of its runs, steps or arrays.

    Every file is compared with its hash in the manifest, every snapshot of a part with its digest.
    Stopped at any moment, the same call goes on with what is there; the data set appears under
    its name when it is whole. A part becomes a data set of its own, which names the whole.

    Args:
        address: ``hf://org/name``, ``s3://bucket/prefix``, ``https://``...
        out: folder to be made; None: where it is found by its id from then on.
        runs: ids of the runs that are wanted; None: all.
        steps: first and last environment step of the snapshots that are wanted; None: all.
        arrays: groups of arrays that are wanted beside the weights: ``critic``, ``optimizer``,
            ``probe``, ``train``, ``ret_norm``, ``eval``; None: all.
        revision: branch, tag or commit, of a data set on the hub.
        console: where progress is shown; None: nowhere.

    Raises:
        FileNotFoundError: there is no data set at the address.
        RegistryError: it has no run of such an id, or the address is none.
        StoreExistsError: the folder exists, and is not this data set.
        StoreLockedError: another process is downloading it.
        DamageError: a file there is not what the manifest says.
        RemoteError: it cannot be reached; what came is kept.
    """
    place = RemotePath.parse(address, revision)
    if runs is not None and not runs:
        raise RegistryError(
            "no run was named",
            expected="ids of runs",
            got="an empty list",
            where=place,
            do="name some; without a list all come",
        )
    dataset = open_dataset(place, runs=runs)
    assert isinstance(dataset.path, RemotePath)  # noqa: S101
    store, at = store_at(dataset.path.root), dataset.path
    manifest = store.read((at / MANIFEST).part)
    lines = parse_manifest(None if manifest is None else manifest.content, at)
    content = manifest.content if manifest else b""
    _check_listed(_entries(dataset), lines, at)
    target = Path(out) if out is not None else home() / name_of(place)
    part = runs is not None or steps is not None or arrays is not None
    here = target / MANIFEST
    if not part and here.is_file() and here.read_bytes() == content:
        return open_dataset(target)
    refuse_existing(target)
    draft = target.with_name(f".{target.name}.download")
    with _kept(draft):
        _go_on(draft, _request(content, steps, arrays))
        if steps is None and arrays is None:
            chosen = {entry.path for entry in _entries(dataset)} if part else None
            wanted = [line for line in lines if chosen is None or _is_of(line, chosen)]
            _fetch_all(store, at, wanted, draft, console)
        else:
            _cut_all(dataset, draft, steps, arrays, console)
        if part:
            _list_part(dataset, draft, steps, arrays)
        else:
            replace_file(draft / MANIFEST, content)
        open_dataset(draft)  # raises where it would not open; then it does not get its name
        source = Source(at.repository, revision, at.commit)
        replace_file(draft / SOURCE, json.dumps(asdict(source)).encode())
        draft.rename(target)
    return open_dataset(target)


def download_folder(
    place: RemotePath,
    target: Path,
    *,
    needed: Collection[str] = (),
    console: Console | None = None,
) -> None:
    """Download the files that a manifest at an address lists, and check them.

    Args:
        place: where ``upload_folder`` wrote them.
        target: folder to be made.
        needed: files that the manifest must list.
        console: where progress is shown; None: nowhere.

    Raises:
        FileNotFoundError: there is no manifest at the address.
        StoreLockedError: another process is downloading it.
        DamageError: a file there is not what the manifest says.
        RemoteError: it cannot be reached; what came is kept.
    """
    store = store_at(place.root)
    manifest = store.read((place / MANIFEST).part)
    if manifest is None:
        raise FileNotFoundError(f"nothing is published at {place}: it has no {MANIFEST}")
    lines = parse_manifest(manifest.content, place)
    _require(set(needed) - {line.path for line in lines}, place)
    draft = target.with_name(f".{target.name}.download")
    with _kept(draft):
        _fetch_all(store, place, lines, draft, console)
        replace_file(draft / MANIFEST, manifest.content)
        draft.rename(target)


def home() -> Path:
    """Return where data sets are put that are downloaded.

    Raises:
        RegistryError: no folder is named for them, and the user has no home.
    """
    if not os.environ.get(VARIABLE) and os.path.expanduser("~") == "~":
        raise RegistryError(
            "there is no home folder to keep data sets in",
            do=f"set {VARIABLE} to a folder, or give --out",
        )
    return folders()[0]


def name_of(place: RemotePath) -> str:
    """Return what a data set is called here: ``org/name`` on the hub, else the last part.

    Raises:
        RegistryError: no folder can have this name.
    """
    name = place.root.host if place.scheme == "hf" and not place.part else place.name
    if len(name) > 200 or name in ("", "..") or name[0] == "." or _ODD.search(name):
        raise RegistryError(
            "the last part of the address is no name for a folder here",
            expected="up to 200 characters without control characters, not beginning with a dot",
            got=repr(name),
            where=place,
            do="name the folder: --out, or out=",
        )
    return name


def source_of(path: Path) -> Source | None:
    """Return where a data set on this machine was downloaded from; None: it was not."""
    try:
        return Source(**json.loads((path / SOURCE).read_bytes()))
    except (FileNotFoundError, NotADirectoryError, ValueError, TypeError):
        return None


def _entries(dataset: Dataset) -> list[RunEntry]:
    """Return the lines of the list of runs that are those of the runs opened."""
    ids = {run.id for run in dataset}
    return [entry for entry in dataset.info.runs if entry.id in ids]


def _check_listed(
    entries: Collection[RunEntry], lines: list[ManifestLine], place: RemotePath
) -> None:
    """Refuse a manifest that leaves out what the list of runs names, before anything is fetched."""
    listed = {line.path for line in lines}
    folders = {path.removesuffix("/zarr.json") for path in listed if path.endswith("/zarr.json")}
    there = listed | folders | {path.removesuffix(PACKED) for path in listed}
    _require({DATASET, *(entry.path for entry in entries)} - there, place)


def _require(missing: Collection[str], place: RemotePath) -> None:
    if missing:
        raise DamageError(
            "the manifest leaves out files that have to be there",
            expected=f"lines of {', '.join(sorted(missing)[:5])}",
            got=f"{len(missing)} of them are missing",
            where=place / MANIFEST,
            do="tell those who published it; nothing was downloaded",
        )


def _fetch_all(
    store: RemoteStore,
    at: RemotePath,
    lines: list[ManifestLine],
    draft: Path,
    console: Console | None,
) -> None:
    with _progress(console, sum(line.size for line in lines)) as (progress, task):

        def fetch(line: ManifestLine) -> None:
            _fetch(store, (at / line.path).part, line, draft / line.path, progress, task)

        for_each(lines, fetch)
    _sweep(draft, {line.path for line in lines})


def _fetch(
    store: RemoteStore,
    name: str,
    line: ManifestLine,
    file: Path,
    progress: Progress,
    task: TaskID,
) -> None:
    """Fetch one file, from the byte on that is missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.is_file() and _sha256(file).hexdigest() == line.sha256:
        progress.advance(task, line.size)
        return
    part = file.with_name(f".{file.name}.part")
    digest = ""
    for fresh in (False, True):
        if fresh:
            part.unlink(missing_ok=True)  # what was there is of other bytes
        try:
            digest = _append(store, name, line, part, progress, task)
        except NoPartsError:
            if fresh:
                raise
            progress.advance(task, -part.stat().st_size)
            continue
        if digest == line.sha256:
            part.replace(file)
            return
        progress.advance(task, -line.size)
    part.unlink()
    raise DamageError(
        "a file at the address is not what the manifest says",
        expected=f"{line.size} bytes, sha256 {line.sha256}",
        got=f"sha256 {digest}",
        where=store.root.text(name),
        do="tell those who published it; nothing of this file was kept",
    )


def _append(
    store: RemoteStore, name: str, line: ManifestLine, part: Path, progress: Progress, task: TaskID
) -> str:
    """Add to a file what it lacks; returns the hash of all of it."""
    if part.is_file() and part.stat().st_size > line.size:
        part.unlink()
    digest = _sha256(part) if part.is_file() else hashlib.sha256()
    done = part.stat().st_size if part.is_file() else 0
    progress.advance(task, done)
    failed = 0
    with part.open("ab") as file:
        while done < line.size:
            before = done
            try:
                for piece in store.pieces(name, done):
                    file.write(piece)
                    digest.update(piece)
                    done += len(piece)
                    progress.advance(task, len(piece))
                    if done > line.size:
                        break
            except FileNotFoundError as error:
                raise DamageError(
                    "a file that the manifest lists is not at the address",
                    where=store.root.text(name),
                    do="tell those who published it",
                ) from error
            except BrokenOffError:
                failed = 0 if done > before else failed + 1
                if failed == TRIES:
                    raise
            else:
                break
    return digest.hexdigest()


def _is_of(line: ManifestLine, chosen: set[str]) -> bool:
    """Return whether a file is one of these runs, or lies in one that is a folder."""
    path = PurePosixPath(line.path)
    return not chosen.isdisjoint(map(str, (path, *path.parents)))


def _request(
    manifest: bytes, steps: tuple[int, int] | None, arrays: Collection[str] | None
) -> bytes | None:
    """What runs are cut for, and of what; None: they come as they are, and hashes tell them."""
    if steps is None and arrays is None:
        return None
    asked = {"steps": steps, "arrays": None if arrays is None else sorted(arrays)}
    return json.dumps(asked | {"manifest": hashlib.sha256(manifest).hexdigest()}).encode()


def _go_on(draft: Path, request: bytes | None) -> None:
    """Keep what came, unless it was for another request."""
    file = draft / REQUEST
    if (file.read_bytes() if file.is_file() else None) != request:
        shutil.rmtree(draft)
        draft.mkdir()
    if request is not None:
        replace_file(file, request)


def _cut_all(
    dataset: Dataset,
    draft: Path,
    steps: tuple[int, int] | None,
    arrays: Collection[str] | None,
    console: Console | None,
) -> None:
    """Read a part of each run from where it is, and pack it here."""
    names = {run.id: f"runs/{run.id}.zarr{PACKED}" for run in dataset}
    with LoggedProgress(console=console) as progress:
        for run in progress.track(dataset.runs, description="runs"):
            target = draft / names[run.id]
            if not target.is_file():  # a packed run appears when it is whole
                cut(run.path, target, steps=steps, arrays=arrays)
    _sweep(draft, set(names.values()))


def _sweep(draft: Path, names: Collection[str]) -> None:
    """Remove all but these files: what a download of something else left, that was stopped."""
    for path in sorted(draft.rglob("*"), reverse=True):  # what is in a folder before the folder
        if path.is_dir():
            with contextlib.suppress(OSError):  # it is not empty
                path.rmdir()
        elif path.relative_to(draft).as_posix() not in names:
            path.unlink()


def _list_part(
    dataset: Dataset,
    draft: Path,
    steps: tuple[int, int] | None,
    arrays: Collection[str] | None,
) -> None:
    """Make a data set of a part of one."""
    entries = tuple(
        replace(entry, path=f"runs/{entry.id}.zarr{PACKED}")
        if (draft / f"runs/{entry.id}.zarr{PACKED}").is_file()
        else entry
        for entry in _entries(dataset)
    )
    recipe: dict[str, Any] = {
        "part": {
            "id": dataset.info.id,
            "version": dataset.info.version,
            "runs": f"{len(entries)} of {len(dataset.info.runs)}",
            "steps": None if steps is None else list(steps),
            "arrays": None if arrays is None else sorted(arrays),
        }
    }
    write_dataset_info(draft, replace(dataset.info, runs=entries, recipe=recipe))
    seal(draft)


@contextlib.contextmanager
def _kept(draft: Path) -> Iterator[None]:
    """A folder that one process works in, and that stays if it does not come to its end."""
    try:
        lock_file = draft.with_name(f"{draft.name}.lock")
        for path in (draft, lock_file):
            _refuse_link(path)
        draft.mkdir(parents=True, exist_ok=True)
        with FileLock(lock_file, timeout=0) as lock:
            for path in draft.rglob("*"):
                if path.is_symlink():  # none is ours, and it could lead anywhere
                    path.unlink()
            yield
        Path(lock.lock_file).unlink(missing_ok=True)
    except Timeout as error:
        raise StoreLockedError(
            "another process is downloading this data set",
            where=draft,
            do="wait for it",
        ) from error
    except OSError as error:
        if isinstance(error, RemoteError | FileNotFoundError):
            raise
        raise FormatError(
            "the data set could not be written; what came is kept",
            got=error,
            where=draft,
            do="make room, or correct the permissions, and give the command again: it goes on",
        ) from error


def _refuse_link(path: Path) -> None:
    if path.is_symlink():
        raise FormatError(
            "a link lies where the download keeps what came",
            expected="nothing, or a folder of an earlier download",
            got=f"a link to {path.readlink()}",
            where=path,
            do="remove the link, or choose another folder with --out",
        )


@contextlib.contextmanager
def _progress(console: Console | None, total: int) -> Iterator[tuple[Progress, TaskID]]:
    columns = (TextColumn("download"), BarColumn(), DownloadColumn())
    speed = (TransferSpeedColumn(), TimeRemainingColumn())
    with LoggedProgress(*columns, *speed, console=console) as progress:
        yield progress, progress.add_task("download", total=total)


def _sha256(file: Path) -> Any:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256")
