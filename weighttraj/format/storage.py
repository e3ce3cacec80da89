"""The only module that knows Zarr: arrays, chunks, shards, codecs, commit."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import ByteRequest
from zarr.codecs import BloscCodec, Crc32cCodec, ShardingCodecIndexLocation
from zarr.core.array import ShardsConfigParam
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore

from weighttraj.errors import DamageError, FormatError, StoreExistsError
from weighttraj.format.schema import ArraySpec, RunInfo, arrays_of, load_json, parse, to_json

MAX_CHUNK_PARAMS = 16_384
"""Columns in a chunk. Wider arrays are sharded: one file a block, each chunk read on its own."""

# Chunks of fill values are written too. Zarr 3.1 ignores `config=` of open_array: set it here.
_EMPTY_CHUNKS = {"array.write_empty_chunks": True}

ATTRIBUTE = "weighttraj"
"""Key of the run's metadata in the attributes of its Zarr group."""

CHECKSUM = "weighttraj_sha256"
"""Key of the metadata's checksum."""


class _CommittedStore(LocalStore):
    """A store in which every chunk must exist.

    Plain Zarr reads a missing chunk as fill value. All chunks of committed rows are written, even
    empty ones, so here a missing chunk is damage.
    """

    async def get(
        self,
        key: str,
        prototype: BufferPrototype | None = None,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        value = await super().get(key, prototype, byte_range)
        if value is None and "/c/" in key:
            raise DamageError(
                "committed data is missing",
                expected=f"the object {key}",
                got="no such object",
                where=self.root,
                do="restore the file from a copy, or collect the run again from its seed",
            )
        return value


class RunStore:
    """The arrays and metadata of one run on disk."""

    def __init__(self, path: Path, info: RunInfo) -> None:
        self.path = path
        self.info = info
        self.specs = arrays_of(info)
        self._unsynced: set[Path] = set()
        self._readable: dict[str, zarr.Array[Any]] = {}
        self._writable: dict[str, zarr.Array[Any]] = {}

    @classmethod
    def create(cls, path: Path, info: RunInfo) -> RunStore:
        """Make an empty store; it appears under its name all at once.

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
        for spec in arrays_of(info).values():
            _create_array(group, spec, info.block)
        store = cls(draft, info)
        store.commit(info)
        draft.rename(path)
        _sync(path.parent)
        store.path = path
        return store

    @classmethod
    def open(cls, path: Path) -> RunStore:
        """Open an existing store.

        Raises:
            FileNotFoundError: there is no run at the path.
            FormatError: it is no run of this format.
        """
        return cls(path, read_info(path))

    def read(self, name: str, key: Any) -> np.ndarray:
        """Read part of an array; ``key`` as numpy takes it, within the committed rows.

        Raises:
            DamageError: a chunk is missing, or its checksum is wrong.
        """
        try:
            if name not in self._readable:
                self._readable[name] = self._open_array(name, _CommittedStore(self.path))
            return np.asarray(self._readable[name].oindex[key])
        except FormatError:
            raise
        except (ValueError, RuntimeError, OSError) as error:
            raise DamageError(
                "committed data cannot be decoded",
                expected="chunks whose crc32c matches",
                got=error,
                where=f"{self.path}, array {name!r}, selection {key!r}",
                do="restore the array's files from a copy, or collect the run again",
            ) from error

    def write(self, name: str, start: int, values: np.ndarray) -> None:
        """Write rows of an array from ``start`` on, which begins a block; nothing is committed.

        Every chunk is written whole and replaced atomically, then read back and compared.

        Raises:
            DamageError: what was read back is not what was written.
        """
        array = self._writable_array(name)
        stop = start + len(values)
        if array.shape[0] < stop:
            array.resize((stop, *array.shape[1:]))
        values = np.ascontiguousarray(values, array.dtype)
        array[start:stop] = values
        self._unsynced |= self._files(name, start, stop)
        if np.asarray(array[start:stop]).tobytes() != values.tobytes():
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
            _sync(path)
        self._unsynced.clear()
        metadata = to_json(info)
        attributes = {ATTRIBUTE: metadata, CHECKSUM: checksum(metadata)}
        document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
        replace_file(self.path / "zarr.json", json.dumps(document, indent=1).encode())
        self.info = info

    def _files(self, name: str, start: int, stop: int) -> set[Path]:
        """Files and folders that hold some rows of an array."""
        blocks = range(start // self.info.block, -(-stop // self.info.block))
        inner = "/0" * len(self.specs[name].inner)
        names = [f"{name}/zarr.json", *(f"{name}/c/{block}{inner}" for block in blocks)]
        folders = {self.path / parent for file in names for parent in Path(file).parents}
        return folders | {self.path / file for file in names}

    def trim(self) -> None:
        """Cut the arrays to the committed rows, so that plain Zarr shows nothing else."""
        for name, spec in self.specs.items():
            array = self._writable_array(name)
            rows = self.info.committed(spec.axis)
            if array.shape[0] > rows:
                array.resize((rows, *array.shape[1:]))
                _sync(self.path / name / "zarr.json")

    def _writable_array(self, name: str) -> zarr.Array[Any]:
        if name not in self._writable:
            self._writable[name] = self._open_array(name, LocalStore(self.path))
        return self._writable[name]

    def _open_array(self, name: str, store: LocalStore) -> zarr.Array[Any]:
        spec = self.specs[name]
        where = f"{self.path}, array {spec.name!r}"
        try:
            with zarr.config.set(_EMPTY_CHUNKS):
                array = zarr.open_array(store, path=name, mode="r+", zarr_format=3)
        except (FileNotFoundError, ValueError, KeyError, TypeError) as error:
            raise DamageError(
                "the metadata of an array is missing or damaged",
                got=error,
                where=where,
                do="restore its zarr.json from a copy",
            ) from error
        rows = self.info.committed(spec.axis)
        expected = (f"at least {rows} rows of {spec.inner}", spec.dtype)
        if array.shape[1:] != spec.inner or array.dtype != spec.dtype or array.shape[0] < rows:
            raise FormatError(
                "an array is not what the run's metadata says",
                expected=expected,
                got=(array.shape, str(array.dtype)),
                where=where,
                do="restore the run from a copy",
            )
        return array

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_readable": {}, "_writable": {}}


def read_info(path: Path) -> RunInfo:
    """Metadata of the run at a path; raises as ``RunStore.open`` does."""
    file = path / "zarr.json"
    if not file.is_file():
        raise FileNotFoundError(f"no run at {path}: it has no zarr.json")
    document = load_json(file.read_bytes(), file)
    attributes = document.get("attributes") if isinstance(document, dict) else None
    if not isinstance(attributes, dict) or ATTRIBUTE not in attributes:
        raise FormatError(
            "this Zarr store is no run of weighttraj",
            expected=f"a group with the attribute {ATTRIBUTE!r}",
            got="none",
            where=path,
            do="open a run's folder, <data set>/runs/<id>.zarr",
        )
    metadata = attributes[ATTRIBUTE]
    info = parse(metadata, RunInfo, file)
    if attributes.get(CHECKSUM) != checksum(metadata):
        raise DamageError(
            "the metadata does not match its checksum",
            expected=attributes.get(CHECKSUM),
            got=checksum(metadata),
            where=file,
            do="restore the file from a copy",
        )
    return info


def checksum(metadata: Any) -> str:
    """SHA-256 of metadata as JSON with sorted keys and no spaces."""
    text = json.dumps(metadata, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def replace_file(path: Path, content: bytes) -> None:
    """Write a file so that readers see the old content or the new, also after a power cut."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    with draft.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    _sync(path.parent)


def _create_array(group: zarr.Group, spec: ArraySpec, block: int) -> None:
    width = math.prod(spec.inner)
    chunks: tuple[int, ...] = (block, *spec.inner)
    shards: ShardsConfigParam | None = None
    if len(spec.inner) == 1 and width > MAX_CHUNK_PARAMS:
        columns = -(-width // MAX_CHUNK_PARAMS) * MAX_CHUNK_PARAMS
        chunks = (block, MAX_CHUNK_PARAMS)
        # The index comes first: plain HTTP servers answer no request for a suffix.
        shards = ShardsConfigParam(
            shape=(block, columns), index_location=ShardingCodecIndexLocation.start
        )
    itemsize = np.dtype(spec.dtype).itemsize
    group.create_array(
        spec.name,
        shape=(0, *spec.inner),
        dtype=spec.dtype,
        chunks=chunks,
        shards=shards,
        # Without the checksum no bit flip in a compressed chunk is noticed.
        compressors=(
            BloscCodec(cname="zstd", clevel=5, shuffle="shuffle", typesize=itemsize),
            Crc32cCodec(),
        ),
        fill_value=spec.fill,
        dimension_names=spec.dims,
    )
