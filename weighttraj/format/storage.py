"""The arrays and metadata of one run as a Zarr group: read, write, commit."""

from __future__ import annotations

import copy
import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import (
    ByteRequest,
    OffsetByteRequest,
    RangeByteRequest,
    SuffixByteRequest,
)
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import LocalStore, MemoryStore

from weighttraj.errors import DamageError, FormatError, MissingExtraError, StoreExistsError
from weighttraj.format.codecs import check_array, create_array, quiet_codecs
from weighttraj.format.objects import FolderObjects, Objects, ZipObjects
from weighttraj.format.schema import ArraySpec, RunInfo, arrays_of, load_json, parse, to_json

# Chunks of fill values are written too. Zarr 3.1 ignores `config=` of open_array: set it here.
_EMPTY_CHUNKS = {"array.write_empty_chunks": True}

ATTRIBUTE = "weighttraj"
"""Key of the run's metadata in the attributes of its Zarr group."""

CHECKSUM = "weighttraj_sha256"
"""Key of the checksum of the group's metadata."""

PACKED = ".zip"
"""Ending of a run that lies in one file."""

Documents = dict[str, dict[str, Any]]
"""Zarr metadata of each array, by name."""


class RunStore:
    """The arrays and metadata of one run, to be read; in a folder or in one zip file."""

    def __init__(self, objects: Objects, info: RunInfo, documents: Documents) -> None:
        self.objects = objects
        self.info = info
        self.specs = arrays_of(info)
        self.documents = documents
        self._readable: dict[str, zarr.Array[Any]] = {}

    @property
    def path(self) -> Path:
        """Where the run lies."""
        return self.objects.path

    @classmethod
    def open(cls, path: Path) -> RunStore:
        """Open an existing run.

        Raises:
            FileNotFoundError: there is no run at the path.
            FormatError: it is no run of this format.
        """
        objects = objects_at(path)
        return cls(objects, *read_metadata(objects))

    def read(self, name: str, key: Any) -> np.ndarray:
        """Read part of an array; ``key`` as numpy takes it, within the committed rows.

        Raises:
            DamageError: a chunk is missing, or its checksum is wrong.
        """
        array = self._array(name)
        key = key if isinstance(key, tuple) else (key,)
        by_column = array.ndim == 2 and array.metadata.dimension_names[0] != self.specs[name].axis  # type: ignore[union-attr, index]
        self._require(name, array, key[0], axis=1 if by_column else 0)
        if by_column:
            key = (key[1] if len(key) > 1 else slice(None), key[0])
        where = f"{self.path}, array {name!r}, selection {key!r}"
        basic = all(isinstance(part, int | slice) for part in key)
        try:
            values = np.asarray(array[key] if basic else array.oindex[key])
        except FormatError:
            raise
        except MemoryError as error:
            raise FormatError(
                "this selection does not fit into memory",
                got=error,
                where=where,
                do="read fewer rows at a time",
            ) from error
        # Codecs raise what they like; pco's errors are bare RuntimeErrors.
        except Exception as error:
            raise DamageError(
                "committed data cannot be decoded",
                expected="chunks whose crc32c matches",
                got=error,
                where=where,
                do="restore the array's files from a copy, or collect the run again",
            ) from error
        return np.ascontiguousarray(values.T) if by_column else values

    def chunk_rows(self, name: str) -> int:
        """Rows in a chunk (or shard) of an array: the unit in which it is read or written."""
        axis = self.documents[name]["dimension_names"].index(self.specs[name].axis)
        return int(self.documents[name]["chunk_grid"]["configuration"]["chunk_shape"][axis])

    def _require(self, name: str, array: zarr.Array[Any], rows: Any, axis: int) -> None:
        """Every chunk of the rows must exist: plain Zarr would read fill values, and allocate."""
        size = self.chunk_rows(name)
        n = array.shape[axis]
        if isinstance(rows, slice):
            start, stop, _ = rows.indices(n)
            chunks = range(start // size, -(-stop // size)) if stop > start else range(0)
        else:
            chunks = np.unique(np.atleast_1d(rows) // size).tolist()
        for chunk in chunks:
            index = [0] * array.ndim
            index[axis] = chunk
            key = "/".join([name, "c", *map(str, index)])
            if not self.objects.exists(key):
                raise _missing(key, self.path)

    def _array(self, name: str) -> zarr.Array[Any]:
        if name not in self._readable:
            store = _CommittedStore(self.objects, name, self.documents[name])
            self._readable[name] = _open_array(store, name, "r", str(self.path))
        return self._readable[name]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_readable": {}}


class LiveStore(RunStore):
    """A run in a folder, to be written."""

    objects: FolderObjects

    def __init__(self, objects: FolderObjects, info: RunInfo, documents: Documents) -> None:
        super().__init__(objects, info, documents)
        self._unsynced: set[Path] = set()
        self._writable: dict[str, zarr.Array[Any]] = {}

    @classmethod
    def create(
        cls, path: Path, info: RunInfo, packed_rows: dict[str, int] | None = None
    ) -> LiveStore:
        """Make an empty store; it appears under its name all at once.

        Args:
            path: folder to be made.
            info: metadata.
            packed_rows: rows of each axis in a run that is about to be packed.

        Raises:
            StoreExistsError: the path exists.
        """
        if path.exists():
            raise StoreExistsError(
                "the path to be written exists",
                expected="a new path",
                got="a folder" if path.is_dir() else "a file",
                where=path,
                do="choose another path, delete it, or continue the run with resume=True",
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
        shutil.rmtree(draft, ignore_errors=True)
        group = zarr.create_group(LocalStore(draft))
        documents = {}
        for name, spec in arrays_of(info).items():
            rows = packed_rows[spec.axis] if packed_rows else None
            create_array(group, spec, info.profile, info.block, rows)
            documents[name] = json.loads((draft / name / "zarr.json").read_bytes())
        store = cls(FolderObjects(draft), info, documents)
        store.commit(info)
        draft.rename(path)
        sync(path.parent)
        store.objects = FolderObjects(path)
        return store

    @classmethod
    def open(cls, path: Path) -> LiveStore:
        """Open a folder for writing. Rows that were written but not committed are forgotten.

        Raises:
            FileNotFoundError: there is no run at the path.
            FormatError: it is no run of this format, or it is packed.
        """
        if path.name.endswith(PACKED):
            raise FormatError("a packed run is finished; nothing can be added", where=path)
        objects = FolderObjects(path)
        store = cls(objects, *read_metadata(objects))
        store.trim()
        return store

    def write(self, name: str, start: int, values: np.ndarray) -> None:
        """Write rows of an array from ``start`` on, which begins a chunk; nothing is committed.

        Every chunk is written whole and replaced atomically, then read back and compared.

        Raises:
            DamageError: what was read back is not what was written.
        """
        if name not in self._writable:
            self._writable[name] = _open_array(LocalStore(self.path), name, "r+", str(self.path))
        array = self._writable[name]
        stop = start + len(values)
        values = np.ascontiguousarray(values, array.dtype)
        rows: Any = slice(start, stop)
        if array.metadata.dimension_names[0] != self.specs[name].axis:  # type: ignore[union-attr, index]
            if array.shape[1] < stop:
                array.resize((array.shape[0], stop))
            rows = (slice(None), rows)
            values = np.ascontiguousarray(values.T)
        elif array.shape[0] < stop:
            array.resize((stop, *array.shape[1:]))
        array[rows] = values
        self._unsynced |= self._files(name, start, stop)
        if np.asarray(array[rows]).tobytes() != values.tobytes():
            raise DamageError(
                "what was written reads back as something else",
                where=f"{self.path}, array {name!r}, rows {start} to {stop}",
                do="check the disk; nothing of this block was committed",
            )

    def commit(self, info: RunInfo) -> None:
        """Make the metadata, and with it the committed rows, visible in one atomic replace.

        What was written before is on the disk first, so that a power cut finds it there.
        """
        for path in self._unsynced:
            sync(path)
        self._unsynced.clear()
        documents = copy.deepcopy(self.documents)
        for name, spec in self.specs.items():
            axis = documents[name]["dimension_names"].index(spec.axis)
            documents[name]["shape"][axis] = info.committed(spec.axis)
        replace_file(self.path / "zarr.json", group_document(info, documents))
        self.info, self.documents = info, documents

    def trim(self) -> None:
        """Cut the arrays to the committed rows, so that plain Zarr shows nothing else."""
        for name, content in member_documents(self.documents).items():
            file = self.path / name
            if not file.is_file() or file.read_bytes() != content:
                replace_file(file, content)
        self._writable.clear()

    def _files(self, name: str, start: int, stop: int) -> set[Path]:
        """Files and folders that hold some rows of an array."""
        folder = self.path / name
        if self.documents[name]["dimension_names"][0] == self.specs[name].axis:
            size, inner = self.chunk_rows(name), "/0" * len(self.specs[name].inner)
            chunks = range(start // size, -(-stop // size))
            files = [folder / f"c/{chunk}{inner}" for chunk in chunks]
            files = [file for file in files if file.exists()]
        else:
            files = [file for file in folder.rglob("*") if file.is_file()]
        files.append(folder / "zarr.json")
        root = len(self.path.parts)
        parents = {Path(*f.parts[:n]) for f in files for n in range(root, len(f.parts))}
        return {*files, *parents}

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_writable": {}}


class _CommittedStore(MemoryStore):
    """One array as Zarr sees it: checked metadata from memory, chunks from where they are.

    Plain Zarr reads a missing chunk as fill value. All chunks of committed rows are written, even
    empty ones, so here a missing chunk is damage.
    """

    def __init__(self, objects: Objects, name: str, document: dict[str, Any]) -> None:
        content = default_buffer_prototype().buffer.from_bytes(array_document(document))
        super().__init__({f"{name}/zarr.json": content}, read_only=True)
        self._objects = objects

    async def get(
        self,
        key: str,
        prototype: BufferPrototype | None = None,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        if "/c/" not in key:
            return await super().get(key, prototype, byte_range)
        start, stop = 0, None
        if isinstance(byte_range, RangeByteRequest):
            start, stop = byte_range.start, byte_range.end
        elif isinstance(byte_range, OffsetByteRequest):
            start = byte_range.offset
        elif isinstance(byte_range, SuffixByteRequest):
            start = -byte_range.suffix
        value = self._objects.read(key, start, stop)
        if value is None:
            raise _missing(key, self._objects.path)
        return (prototype or default_buffer_prototype()).buffer.from_bytes(value)


def objects_at(path: Path) -> FolderObjects | ZipObjects:
    """The objects of a run in a folder or in a zip file.

    Raises:
        FileNotFoundError: there is none.
        FormatError: it is a file, but no packed run.
    """
    if path.is_file():
        return ZipObjects(path)
    if not (path / "zarr.json").is_file():
        raise FileNotFoundError(f"no run at {path}: it has no zarr.json")
    return FolderObjects(path)


def read_info(path: Path) -> RunInfo:
    """Metadata of the run at a path; raises as ``RunStore.open`` does."""
    return read_metadata(objects_at(path))[0]


def read_metadata(objects: Objects) -> tuple[RunInfo, Documents]:
    """The checked metadata of a run and of its arrays.

    Raises:
        FormatError: it is no run of this format, or asks for what no reader should do.
        DamageError: it does not match its checksum.
    """
    where = f"{objects.path}, zarr.json"
    document = load_json(objects.read("zarr.json") or b"", where)
    attributes = document.get("attributes") if isinstance(document, dict) else None
    if not isinstance(attributes, dict) or ATTRIBUTE not in attributes:
        raise FormatError(
            "this Zarr store is no run of weighttraj",
            expected=f"a group with the attribute {ATTRIBUTE!r}",
            got="none",
            where=objects.path,
            do="open a run, <data set>/runs/<id>.zarr",
        )
    info = parse(attributes[ATTRIBUTE], RunInfo, where)
    stored = attributes.pop(CHECKSUM, None)
    if stored != checksum(document):
        raise DamageError(
            "the metadata does not match its checksum",
            expected=stored,
            got=checksum(document),
            where=where,
            do="restore the file from a copy",
        )
    try:
        documents = document["consolidated_metadata"]["metadata"]
        documents = {name: documents[name] for name in arrays_of(info)}
    except (KeyError, TypeError) as error:
        raise FormatError(
            "the metadata lacks an array that the run has", got=error, where=where
        ) from error
    for name, spec in arrays_of(info).items():
        check_array(spec, documents[name], info.committed(spec.axis), f"{objects.path}, {name}")
    return info, documents


def group_document(info: RunInfo, documents: Documents) -> bytes:
    """``zarr.json`` of a run's group, with the metadata of its arrays and the checksum."""
    document = {
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {ATTRIBUTE: to_json(info)},
        "consolidated_metadata": {
            "kind": "inline",
            "must_understand": False,
            "metadata": {**_groups(documents), **documents},
        },
    }
    document["attributes"] |= {CHECKSUM: checksum(document)}  # type: ignore[operator]
    return json.dumps(document, indent=1).encode()


def array_document(document: dict[str, Any]) -> bytes:
    """``zarr.json`` of an array."""
    return json.dumps(document, indent=2).encode()


def member_documents(documents: Documents) -> dict[str, bytes]:
    """Every ``zarr.json`` below a run's group, by path, as the group's metadata says it."""
    nodes = {**_groups(documents), **documents}
    return {f"{name}/zarr.json": array_document(node) for name, node in nodes.items()}


def _groups(documents: Documents) -> Documents:
    """The groups between a run and its arrays: they hold nothing of their own."""
    names = sorted({name.rpartition("/")[0] for name in documents} - {""})
    return {name: {"attributes": {}, "zarr_format": 3, "node_type": "group"} for name in names}


def checksum(metadata: Any) -> str:
    """SHA-256 of metadata as JSON with sorted keys and no spaces."""
    text = json.dumps(metadata, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def replace_file(path: Path, content: bytes) -> None:
    """Write a file so that readers see the old content or the new, also after a power cut."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    with draft.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    sync(path.parent)


def sync(path: Path) -> None:
    """See a file or folder on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _missing(key: str, where: object) -> DamageError:
    return DamageError(
        "committed data is missing",
        expected=f"the object {key}",
        got="no such object",
        where=where,
        do="restore the file from a copy, or collect the run again from its seed",
    )


def _open_array(store: Any, name: str, mode: Any, where: str) -> zarr.Array[Any]:
    try:
        with zarr.config.set(_EMPTY_CHUNKS), quiet_codecs():
            return zarr.open_array(store, path=name, mode=mode, zarr_format=3)
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"the archive profile needs {error.name}, which is not installed",
            where=where,
            do="pip install 'numcodecs[pcodec]'",
        ) from error
    except Exception as error:  # Zarr has no error of its own for metadata it cannot parse
        raise DamageError(
            "the metadata of an array is damaged",
            got=repr(error),
            where=f"{where}, array {name!r}",
            do="restore the run from a copy",
        ) from error


__all__ = ["ArraySpec", "LiveStore", "RunStore", "read_info", "replace_file"]
