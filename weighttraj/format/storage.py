"""The metadata and arrays of one run as a Zarr group, to be read."""

from __future__ import annotations

import hashlib
import json
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
from zarr.storage import MemoryStore

from weighttraj.errors import DamageError, FormatError, MissingExtraError
from weighttraj.format.codecs import check_array, check_grid, quiet_codecs
from weighttraj.format.decode import RowDecoder
from weighttraj.format.objects import (
    FolderObjects,
    Objects,
    ZipObjects,
    check_name,
    missing_object,
)
from weighttraj.format.schema import RunInfo, arrays_of, load_json, parse, to_json

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
        self._decoders: dict[str, RowDecoder | None] = {}

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
        decoder = self._decoder(name)
        if decoder is not None and isinstance(key, int):
            return np.asarray(decoder.read(key, key + 1)[0])
        if decoder is not None and isinstance(key, slice) and key.step in (None, 1):
            start, stop, _ = key.indices(self.info.committed(self.specs[name].axis))
            return decoder.read(start, max(start, stop))
        array = self._array(name)
        key = key if isinstance(key, tuple) else (key,)
        by_column = self._by_column(name)
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
                raise missing_object(key, self.path)

    def _by_column(self, name: str) -> bool:
        """Whether rows are the last axis of an array, as in the archive profile."""
        return bool(self.documents[name]["dimension_names"][0] != self.specs[name].axis)

    def _decoder(self, name: str) -> RowDecoder | None:
        if name not in self._decoders:
            document, by_column = self.documents[name], self._by_column(name)
            try:
                decoder = RowDecoder(self.objects, name, document, by_column=by_column)
            except NotImplementedError:
                decoder = None
            self._decoders[name] = decoder
        return self._decoders[name]

    def _array(self, name: str) -> zarr.Array[Any]:
        if name not in self._readable:
            store = _CommittedStore(self.objects, name, self.documents[name])
            self._readable[name] = open_array(store, name, "r", str(self.path))
        return self._readable[name]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_readable": {}, "_decoders": {}}


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
            raise missing_object(key, self._objects.path)
        return (prototype or default_buffer_prototype()).buffer.from_bytes(value)


def objects_at(path: Path) -> FolderObjects | ZipObjects:
    """The objects of a run in a folder or in a zip file; a folder's name finds the file it became.

    Raises:
        FileNotFoundError: there is none.
        FormatError: it is a file, but no packed run.
    """
    packed = path.with_name(path.name + PACKED)
    if path.is_file() or (packed.is_file() and not path.exists()):
        return ZipObjects(path if path.is_file() else packed)
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
    documents = _array_documents(document, where)
    for name, spec in arrays_of(info).items():
        if name not in documents:
            raise FormatError("the run lacks an array", expected=name, where=where)
        check_array(spec, documents[name], info.committed(spec.axis), f"{objects.path}, {name}")
    return info, documents


def _array_documents(document: dict[str, Any], where: str) -> Documents:
    """Metadata of all arrays, also of those that only a later version of this package reads."""
    try:
        nodes = document["consolidated_metadata"]["metadata"]
        arrays = {name: node for name, node in nodes.items() if node["node_type"] == "array"}
        for node in arrays.values():
            check_grid(node)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(
            "the run's metadata lack those of its arrays",
            expected="Zarr's consolidated metadata",
            got=repr(error),
            where=where,
            do="restore the file from a copy",
        ) from error
    for name in arrays:
        check_name(name, where)
    return arrays


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


def open_array(store: Any, name: str, mode: Any, where: str) -> zarr.Array[Any]:
    """Open an array by Zarr.

    Raises:
        DamageError: its metadata cannot be parsed.
        MissingExtraError: its codec is not installed.
    """
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
