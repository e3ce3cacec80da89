"""What makes runs a data set: ``dataset.json`` lists them, ``MANIFEST.sha256`` every object."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from weighttraj.atomic import replace_file
from weighttraj.errors import DamageError, FormatError
from weighttraj.format.schema import DatasetInfo, load_json, parse, to_json
from weighttraj.store.objects import FolderObjects, check_name, check_size, read_document
from weighttraj.store.zarr_run import check_checksum, checksum

DATASET = "dataset.json"
MANIFEST = "MANIFEST.sha256"

_LINE = re.compile(r"([0-9a-f]{64})  ([0-9]{1,15})  (\S+)")


@dataclass(frozen=True, kw_only=True)
class ManifestLine:
    """One object of a data set."""

    sha256: str
    """Hash of its bytes, hexadecimal."""
    size: int
    """Bytes."""
    path: str
    """Path from the data set's folder, with forward slashes."""


def read_dataset_info(path: Path) -> DatasetInfo:
    """Return the checked list of a data set's runs.

    Raises:
        FileNotFoundError: there is no data set at the path.
        FormatError: it is none of this format.
        DamageError: it does not match its checksum.
    """
    file = path / DATASET
    if not file.is_file():
        raise FileNotFoundError(f"no data set at {path}: it has no {DATASET}")
    return parse_dataset(read_document(FolderObjects(path), DATASET) or b"", file)


def parse_dataset(content: bytes, where: object) -> DatasetInfo:
    """Return the list of runs in ``dataset.json``; raises as ``read_dataset_info`` does."""
    document = load_json(content, where)
    stored = document.pop("sha256", None) if isinstance(document, dict) else None
    info = parse(document, DatasetInfo, where)
    check_checksum(document, stored, where)
    return info


def dataset_document(info: DatasetInfo) -> bytes:
    """Return ``dataset.json`` with its checksum."""
    document = to_json(info)
    return json.dumps(document | {"sha256": checksum(document)}, indent=1).encode()


def write_dataset_info(path: Path, info: DatasetInfo) -> None:
    """Replace ``dataset.json``."""
    content = check_size(dataset_document(info), path / DATASET)
    replace_file(path / DATASET, content, root=path)


def write_manifest(path: Path) -> None:
    """Write down every object of a data set; nothing may change after it.

    Raises:
        FormatError: a file's name cannot stand in a manifest; see ``check_file_names``.
    """
    check_file_names(path)
    lines = []
    for name in sorted(_objects(path)):
        line = _line(FolderObjects(path), name)
        lines.append(f"{line.sha256}  {line.size}  {line.path}\n")
    content = check_size("".join(lines).encode(), path / MANIFEST)
    replace_file(path / MANIFEST, content, root=path)


def check_file_names(path: Path) -> None:
    """Check that a manifest can hold the names of all files of a data set.

    Raises:
        FormatError: it cannot.
    """
    for name in _objects(path):
        try:
            check_name(name, path)
        except FormatError as error:
            raise FormatError(
                "a file of the data set has a name that its manifest cannot hold",
                expected="letters of ASCII, digits, '.', '_', '-', not beginning with '.' or '-'",
                got=repr(name),
                where=path,
                do="rename the file, or put it elsewhere; hidden files stay and are not published",
            ) from error


def read_manifest(path: Path) -> list[ManifestLine]:
    """Return the lines of a data set's manifest; raises as ``parse_manifest`` does."""
    return parse_manifest(read_document(FolderObjects(path), MANIFEST), path)


def parse_manifest(content: bytes | None, where: object) -> list[ManifestLine]:
    """Return lines of a manifest.

    Args:
        content: of the file; None: there is none.
        where: the data set, for messages.

    Raises:
        DamageError: it is missing, or a line is not as the format has it.
        FormatError: a path leads out of the data set.
    """
    try:
        if content is None:
            raise FileNotFoundError(MANIFEST)
        text = content.decode("ascii")
    except (FileNotFoundError, UnicodeDecodeError) as error:
        raise DamageError(
            "the data set is complete, but its manifest is missing or damaged",
            expected=MANIFEST,
            got=error,
            where=where,
            do="if a command that changes the data set was stopped, give it again; else restore "
            "the manifest from a copy, or write it again: weighttraj repair",
        ) from error
    lines = []
    for number, line in enumerate(text.split("\n")[:-1], start=1):
        match = _LINE.fullmatch(line)
        place = f"{where}, {MANIFEST}, line {number}"
        if match is None or not text.endswith("\n"):
            raise DamageError(
                "a line of the manifest is damaged",
                expected="sha256, size and path, two spaces between them",
                got=repr(line),
                where=place,
                do="restore it from a copy, or write it again: weighttraj repair",
            )
        lines.append(
            ManifestLine(sha256=match[1], size=int(match[2]), path=check_name(match[3], place))
        )
    paths = [line.path for line in lines]
    if paths != sorted(set(paths)):
        raise DamageError(
            "the lines of the manifest are not in order, or a path is there twice",
            where=f"{where}, {MANIFEST}",
            do="restore it from a copy, or write it again: weighttraj repair",
        )
    return lines


def check_manifest(
    path: Path, shown: Callable[[list[ManifestLine]], Iterable[ManifestLine]] = iter
) -> list[str]:
    """Return objects that are missing, changed or not in the manifest, in words.

    Args:
        path: of the data set.
        shown: what goes through the lines, and shows how far it is.
    """
    lines = read_manifest(path)
    present = set(_objects(path))
    problems = []
    for line in shown(lines):
        where = path / line.path
        if line.path not in present:
            problems.append(f"{where}: missing, the manifest lists it")
            continue
        present.discard(line.path)
        got = _line(FolderObjects(path), line.path)
        if got != line:
            problems.append(
                f"{where}: changed; expected {line.size} bytes, sha256 {line.sha256[:16]}..., "
                f"got {got.size} bytes, {got.sha256[:16]}..."
            )
    problems += [f"{path / name}: not in the manifest" for name in sorted(present)]
    return problems


def _objects(path: Path) -> Iterator[str]:
    """Yield every object of a data set but the manifest; drafts and locks are none."""
    for folder, folders, files in os.walk(path):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            file = Path(folder, name)
            if not name.startswith(".") and not name.endswith(".lock") and name != MANIFEST:
                yield file.relative_to(path).as_posix()


def _line(objects: FolderObjects, name: str) -> ManifestLine:
    with open(objects.file(name), "rb") as content:
        digest = hashlib.file_digest(content, "sha256").hexdigest()
        return ManifestLine(sha256=digest, size=content.tell(), path=name)
