"""The metadata and arrays of one run as a Zarr group, to be read."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from weighttraj.errors import DamageError, FormatError
from weighttraj.format.schema import RunInfo, arrays_of, load_json, parse, to_json
from weighttraj.remote.address import Place, RemotePath
from weighttraj.store.codecs import check_array, check_grid, unshard
from weighttraj.store.decode import RowDecoder
from weighttraj.store.objects import FolderObjects, Objects, ZipObjects, check_name, read_document

ATTRIBUTE = "weighttraj"
"""Key of the run's metadata in the attributes of its Zarr group."""

TAGS = "weighttraj_crc32c"
"""Key of the checksums of all chunks: a chunk in the place of another is damage too."""

CHECKSUM = "weighttraj_sha256"
"""Key of the checksum of the group's metadata."""

MAX_METADATA = 256 << 20
"""Bytes of a run's metadata, at most: the checksums of 30 million chunks."""

PACKED = ".zip"
"""Ending of a run that lies in one file."""

Documents = dict[str, dict[str, Any]]
"""Zarr metadata of each array, by name."""


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """What ``zarr.json`` of a run's group says."""

    info: RunInfo
    """The run."""
    documents: Documents
    """Zarr metadata of each array."""
    tags: dict[str, str]
    """The crc32c of each chunk of each array: 8 digits a chunk, row by row of chunks."""
    attributes: dict[str, Any] = field(default_factory=dict)
    """The group's attributes as they were read, with what only a later version knows of."""


class RunStore:
    """The arrays and metadata of one run, to be read; in a folder or in one zip file."""

    def __init__(self, objects: Objects, metadata: Metadata) -> None:
        self.objects = objects
        self.info = metadata.info
        self.specs = arrays_of(metadata.info)
        self.documents = metadata.documents
        self.tags = metadata.tags
        self.attributes = metadata.attributes
        self._decoders: dict[str, RowDecoder] = {}

    @property
    def path(self) -> Place:
        """Where the run lies."""
        return self.objects.path

    @classmethod
    def open(cls, path: Place) -> RunStore:
        """Open an existing run.

        Raises:
            FileNotFoundError: there is no run at the path.
            RemoteError: it is somewhere else, and cannot be reached.
            FormatError: it is no run of this format.
        """
        objects = objects_at(path)
        return cls(objects, read_metadata(objects))

    def read(self, name: str, key: Any) -> np.ndarray:
        """Read part of an array, each axis selected on its own.

        Args:
            name: the array.
            key: rows as a slice with a positive step, a number or numbers, within the committed
                ones; after a comma, columns as numpy takes them.

        Raises:
            DamageError: a chunk is missing, another one's, or its checksum is wrong.
            FormatError: the array is encoded in a way that the format does not have.
        """
        rows, *rest = key if isinstance(key, tuple) else (key,)
        decoder, inner = self._decoder(name), self.specs[name].inner
        columns, others = _columns(rest, inner)
        if isinstance(rows, slice):
            start, stop, step = rows.indices(self.info.committed(self.specs[name].axis))
            values = decoder.read(start, max(start, stop), columns)[::step]
        else:
            values = self._scattered(name, np.atleast_1d(rows), columns)
        values = values[(slice(None), *others)] if others else values
        return values if isinstance(rows, slice) or np.ndim(rows) else np.asarray(values[0])

    def _scattered(
        self, name: str, rows: np.ndarray, columns: tuple[int, int] | None
    ) -> np.ndarray:
        """Rows in any order, read chunk by chunk."""
        decoder, chunk = self._decoder(name), np.asarray(rows) // self.chunk_rows(name)
        empty = decoder.read(0, 0, columns)
        values = np.empty((len(rows), *empty.shape[1:]), empty.dtype)
        for number in np.unique(chunk):
            mine = rows[chunk == number]
            first = int(mine.min())
            values[chunk == number] = decoder.read(first, int(mine.max()) + 1, columns)[
                mine - first
            ]
        return values

    def chunk_rows(self, name: str) -> int:
        """Rows in a chunk (or shard) of an array: the unit in which it is read or written."""
        axis = self.documents[name]["dimension_names"].index(self.specs[name].axis)
        return int(self.documents[name]["chunk_grid"]["configuration"]["chunk_shape"][axis])

    def _by_column(self, name: str) -> bool:
        """Whether rows are the last axis of an array, as in the archive profile."""
        return bool(self.documents[name]["dimension_names"][0] != self.specs[name].axis)

    def _decoder(self, name: str) -> RowDecoder:
        if name not in self._decoders:
            document, tags = self.documents[name], self.tags.get(name, "")
            by_column = self._by_column(name)
            self._decoders[name] = RowDecoder(
                self.objects, name, document, tags, by_column=by_column
            )
        return self._decoders[name]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_decoders": {}}


def objects_at(path: Place) -> Objects:
    """The objects of a run in a folder or in a zip file; a folder's name finds the file it became.

    Raises:
        FileNotFoundError: there is none.
        FormatError: it is a file, but no packed run.
    """
    if isinstance(path, RemotePath):
        from weighttraj.store.remote import remote_objects

        return remote_objects(path)
    packed = path.with_name(path.name + PACKED) if path.name else path
    if path.is_file() or (packed.is_file() and not path.exists()):
        return ZipObjects(path if path.is_file() else packed)
    if not (path / "zarr.json").is_file():
        raise FileNotFoundError(f"no run at {path}: it has no zarr.json")
    return FolderObjects(path)


def read_info(path: Path) -> RunInfo:
    """Metadata of the run at a path; raises as ``RunStore.open`` does."""
    return read_metadata(objects_at(path)).info


def read_metadata(objects: Objects) -> Metadata:
    """The checked metadata of a run, of its arrays and chunks.

    Raises:
        FormatError: it is no run of this format, or asks for what no reader should do.
        DamageError: it does not match its checksum.
    """
    where = f"{objects.path}, zarr.json"
    content = read_document(objects, "zarr.json", MAX_METADATA) or b""
    document = load_json(content, where)
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
    check_checksum(document, attributes.pop(CHECKSUM, None), where)
    documents, tags = _array_documents(document, where), attributes.get(TAGS)
    for name, spec in arrays_of(info).items():
        if name not in documents:
            raise FormatError(
                "the run lacks an array",
                expected=name,
                where=where,
                do="restore the run from a copy",
            )
        check_array(spec, documents[name], info.committed(spec.axis), f"{objects.path}, {name}")
        expected = 8 * chunk_count(documents[name])
        tag = tags.get(name) if isinstance(tags, dict) else None
        if not isinstance(tag, str) or len(tag) != expected:
            raise FormatError(
                "the run's metadata do not have the checksum of each chunk",
                expected=f"{expected} hexadecimal digits",
                got=f"{len(tag)} characters" if isinstance(tag, str) else repr(tag),
                where=f"{objects.path}, {name}",
                do="restore the run from a copy",
            )
    return Metadata(info=info, documents=documents, tags=tags, attributes=attributes)  # type: ignore[arg-type]


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


def object_grid(document: dict[str, Any]) -> list[int]:
    """Objects of an array's rows along each axis: its chunks, or its shards."""
    sizes = document["chunk_grid"]["configuration"]["chunk_shape"]
    return [-(-n // c) for n, c in zip(document["shape"], sizes, strict=True)]


def chunk_count(document: dict[str, Any]) -> int:
    """Chunks of an array's rows, those inside shards counted one by one."""
    outer = tuple(document["chunk_grid"]["configuration"]["chunk_shape"])
    chunk = unshard(document["codecs"], outer)[1]
    return math.prod(-(-n // c) for n, c in zip(document["shape"], chunk, strict=True))


def group_document(
    info: RunInfo, documents: Documents, tags: dict[str, str], attributes: dict[str, Any]
) -> bytes:
    """``zarr.json`` of a run's group, with the metadata of its arrays and the checksums.

    Args:
        info: the run.
        documents: Zarr metadata of each array.
        tags: the crc32c of each chunk.
        attributes: what the group had before; keys that this version does not know are kept.
    """
    own = attributes.get(ATTRIBUTE, {}) | to_json(info)
    document = {
        "zarr_format": 3,
        "node_type": "group",
        "attributes": attributes | {ATTRIBUTE: own, TAGS: tags},
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


def check_checksum(metadata: Any, stored: object, where: object) -> None:
    """Raise DamageError if metadata do not match the checksum that is stored with them."""
    if stored != (got := checksum(metadata)):
        raise DamageError(
            "the metadata does not match its checksum",
            expected=stored,
            got=got,
            where=where,
            do="restore the file from a copy; it is not to be edited by hand",
        )


def _columns(
    rest: list[Any], inner: tuple[int, ...]
) -> tuple[tuple[int, int] | None, tuple[Any, ...]]:
    """Bounds of the columns that a selection touches, and what then selects among them."""
    if not rest or len(inner) != 1 or rest[0] is Ellipsis or rest[0] is None:
        return None, tuple(rest)
    n, first = inner[0], rest[0]
    if isinstance(first, slice):
        start, stop, step = first.indices(n)
        if step < 1:
            return None, tuple(rest)
        return (start, max(start, stop)), (slice(None, None, step), *rest[1:])
    index = np.arange(n)[first]  # raises IndexError as numpy does
    if not index.size:
        return (0, 0), (index, *rest[1:])
    low = int(index.min())
    return (low, int(index.max()) + 1), (index - low, *rest[1:])
