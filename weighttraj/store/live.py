"""The metadata and arrays of one run in a folder, to be written: blocks, then a commit."""

from __future__ import annotations

import contextlib
import copy
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from filelock import FileLock
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.storage import LocalStore

from weighttraj.atomic import (
    DRAFT,
    acquired,
    appearing,
    lock_of,
    refuse_existing,
    replace_file,
    sync,
)
from weighttraj.errors import DamageError, FormatError
from weighttraj.format.schema import AXES, RunInfo, arrays_of
from weighttraj.remote.address import Place
from weighttraj.store.codecs import create_array, quiet_codecs, rows_in_block
from weighttraj.store.decode import pcodec
from weighttraj.store.encode import ObjectEncoder
from weighttraj.store.objects import FolderObjects, check_size
from weighttraj.store.zarr_run import (
    MAX_METADATA,
    PACKED,
    Documents,
    Metadata,
    RunStore,
    array_document,
    chunk_count,
    group_document,
    member_documents,
    object_grid,
    read_metadata,
)

# Chunks of fill values are written too. Zarr 3.1 ignores `config=` of open_array: set it here.
_EMPTY_CHUNKS = {"array.write_empty_chunks": True}

_SLAB_BYTES = 32 << 20


class LiveStore(RunStore):
    """A run in a folder, to be written."""

    objects: FolderObjects

    def __init__(self, objects: FolderObjects, metadata: Metadata) -> None:
        super().__init__(objects, metadata)
        self._unsynced: set[Path] = set()
        self._writable: dict[str, zarr.Array[Any]] = {}
        self._encoders: dict[str, ObjectEncoder | None] = {}

    @property
    def path(self) -> Path:
        """Folder of the run."""
        return self.objects.path

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
            FormatError: readers would refuse a run that is described so.
        """
        refuse_existing(path, "choose another path, delete it, or continue with resume=True")
        if packed_rows is None:
            info = replace(info, block=_block(info))
        with appearing(path) as draft:
            documents = empty_arrays(draft, info, list(arrays_of(info)), packed_rows)
            tags = dict.fromkeys(documents, "")
            store = cls(FolderObjects(draft), Metadata(info=info, documents=documents, tags=tags))
            store.commit(info)
            _check_readable(store)
        store.objects = FolderObjects(path)
        return store

    @classmethod
    def open(cls, path: Place) -> LiveStore:
        """Open a folder for writing. Rows that were written but not committed are forgotten.

        Raises:
            FileNotFoundError: there is no run at the path.
            FormatError: it is no run of this format, or it is packed.
        """
        if path.name.endswith(PACKED):
            raise FormatError(
                "a packed run is finished; nothing can be added",
                where=path,
                do="write another run",
            )
        objects = FolderObjects(Path(path))
        store = cls(objects, read_metadata(objects))
        for draft in objects.path.rglob(f".*{DRAFT}"):  # of a killed writer
            draft.unlink()
        store.write_members()
        return store

    def write(self, name: str, start: int, rows: Sequence[np.ndarray] | np.ndarray) -> None:
        """Write rows of an array from ``start`` on, which begins a chunk; nothing is committed.

        Every chunk is written whole and replaced atomically, then read back and compared.

        Raises:
            DamageError: what was read back is not what was written.
        """
        encoder, size = self._encoder(name), self.chunk_rows(name)
        if encoder is None:
            self._write_by_zarr(name, start, np.asarray(rows))
        for first in range(start, start + len(rows), size):
            if encoder is None:
                tags = self._tags_on_disk(name, first // size)
            else:
                key = self._key(name, first // size)
                tags = encoder.write(self.path, key, rows[first - start : first - start + size])
            place = first // size * len(tags)
            self.tags[name] = self.tags[name][:place] + tags + self.tags[name][place + len(tags) :]
        self._unsynced |= self._files(name, start, start + len(rows))

    def _key(self, name: str, chunk: int, others: tuple[int, ...] = ()) -> str:
        """Return the object of some rows of an array; others: its place along the other axes."""
        index = [chunk, *(others or (0,) * len(self.specs[name].inner))]
        index = index[1:] + index[:1] if self._by_column(name) else index
        return "/".join([name, "c", *map(str, index)])

    def _tags_on_disk(self, name: str, chunk: int) -> str:
        """The crc32c that ends each chunk of some rows, which lie in objects of their own."""
        counts = object_grid(self.documents[name])
        others = counts[:-1] if self._by_column(name) else counts[1:]
        keys = [self._key(name, chunk, place) for place in np.ndindex(*others)]
        return "".join([(self.objects.read(key, -4) or b"").hex() for key in keys])

    def _encoder(self, name: str) -> ObjectEncoder | None:
        if name not in self._encoders:
            encoder = None
            # One object must span the columns; packed runs have several.
            if self._one_object_wide(name):
                with contextlib.suppress(NotImplementedError):
                    encoder = ObjectEncoder(self.specs[name], self.documents[name])
            self._encoders[name] = encoder
        return self._encoders[name]

    def _one_object_wide(self, name: str) -> bool:
        document = self.documents[name]
        widths = document["chunk_grid"]["configuration"]["chunk_shape"][1:]
        return all(w >= n for w, n in zip(widths, document["shape"][1:], strict=True))

    def _write_by_zarr(self, name: str, start: int, values: np.ndarray) -> None:
        if name not in self._writable:
            store = _BlockStore(self.path, name, self.documents[name])
            self._writable[name] = _open_array(store, name, "r+", str(self.path))
        array, by_column = self._writable[name], self._by_column(name)
        stop = start + len(values)
        axis = 1 if by_column else 0
        if array.shape[axis] < stop:
            array.resize(tuple(stop if i == axis else n for i, n in enumerate(array.shape)))
        for columns in self._slabs(name, values):
            # PCodec sees no strides: the order must be the array's own.
            part = values[:, *columns].T if by_column else values[:, *columns]
            part = np.ascontiguousarray(part, array.dtype)
            place = (*columns, slice(start, stop)) if by_column else (slice(start, stop), *columns)
            array[place] = part
            if np.asarray(array[place]).tobytes() != part.tobytes():
                raise DamageError(
                    "what was written reads back as something else",
                    where=f"{self.path}, array {name!r}, rows {start} to {stop}",
                    do="check the disk; nothing of this block was committed",
                )

    def _slabs(self, name: str, values: np.ndarray) -> Iterator[tuple[slice, ...]]:
        """Yield columns of whole chunks that Zarr writes at a time: it holds ten times as much."""
        inner = self.specs[name].inner
        if not inner:
            yield ()
            return
        chunk = self.documents[name]["chunk_grid"]["configuration"]["chunk_shape"]
        width = chunk[0] if self._by_column(name) else chunk[1]
        column = values.nbytes // max(1, inner[0])
        step = max(1, _SLAB_BYTES // max(1, column * width)) * width
        for first in range(0, inner[0], step):
            yield (slice(first, min(first + step, inner[0])),)

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
        tags = {n: self._final(n, self.tags[n], documents[n], info) for n in self.specs}
        tags |= {name: tag for name, tag in self.tags.items() if name not in self.specs}
        content = group_document(info, documents, tags, self.attributes)
        check_size(content, self.path / "zarr.json", MAX_METADATA)
        replace_file(self.path / "zarr.json", content, root=self.path)
        self.info, self.documents, self.tags = info, documents, tags
        self._decoders.clear()
        self.write_members()

    def _final(self, name: str, tags: str, document: dict[str, Any], info: RunInfo) -> str:
        """Return the checksums of the committed chunks that will not change.

        A partly filled chunk is written again when it grows, before the commit that says so: a
        writer killed in between must not leave another chunk than was committed.
        """
        tags = tags[: 8 * chunk_count(document)]
        rows, size = info.committed(self.specs[name].axis), self.chunk_rows(name)
        if info.status != "collecting" or rows % size == 0:
            return tags
        changing = len(tags) // -(-rows // size)
        return tags[:-changing] + "-" * changing

    def write_members(self, *, durable: bool = False) -> None:
        """Write the metadata of groups and arrays where they differ from the run's.

        Readers of single arrays look there; those of the run, here or in plain Zarr, do not.
        """
        for name, content in member_documents(self.documents).items():
            if self.objects.read(name, 0, len(content) + 1) != content:
                replace_file(self.path / name, content, root=self.path, durable=durable)

    def _files(self, name: str, start: int, stop: int) -> set[Path]:
        """Return files and folders that hold some rows of an array."""
        folder = self.path / name
        if not self._by_column(name):
            size = self.chunk_rows(name)
            chunks = [folder / f"c/{i}" for i in range(start // size, -(-stop // size))]
            files = [file for chunk in chunks for file in (chunk, *chunk.rglob("*"))]
            files = [file for file in files if file.is_file()]
        else:
            files = [file for file in folder.rglob("*") if file.is_file()]
        root = len(self.path.parts)
        parents = {Path(*f.parts[:n]) for f in files for n in range(root, len(f.parts))}
        return {*files, *parents}

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_writable": {}, "_encoders": {}}


def _block(info: RunInfo) -> int:
    """Return the snapshots in one commit: fewer than the user asked for if they are large."""
    specs = arrays_of(info).values()
    return min(rows_in_block([s for s in specs if s.axis == a], info.block) for a in AXES)


def _check_readable(store: LiveStore) -> None:
    """Open a new store as readers do, before the training that it is made for begins.

    Raises:
        FormatError: readers would refuse it.
    """
    try:
        read_metadata(store.objects)
    except FormatError as error:
        raise FormatError(
            "a run that is described so could not be read",
            got=error,
            where=store.path,
            do="describe the run by plain, finite values; nothing was written",
        ) from error


def empty_arrays(
    folder: Path, info: RunInfo, names: Sequence[str], packed_rows: dict[str, int] | None
) -> Documents:
    """Make a Zarr group with some of a run's arrays, without rows; returns their metadata.

    Args:
        folder: folder to be made.
        info: the run.
        names: the arrays.
        packed_rows: rows of each axis in a run that is about to be packed; None: it is not.
    """
    group, specs = zarr.create_group(LocalStore(folder)), arrays_of(info)
    documents = {}
    for name in names:
        rows = packed_rows[specs[name].axis] if packed_rows else None
        create_array(group, specs[name], info.profile, info.block, rows)
        documents[name] = json.loads((folder / name / "zarr.json").read_bytes())
    return documents


class _BlockStore(LocalStore):
    """One array that grows: chunks go to the disk, its metadata wait for the commit."""

    def __init__(self, root: Path, name: str, document: dict[str, Any]) -> None:
        super().__init__(root)
        self._metadata = {f"{name}/zarr.json": array_document(document)}

    async def get(
        self,
        key: str,
        prototype: BufferPrototype | None = None,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        if key in self._metadata:
            return default_buffer_prototype().buffer.from_bytes(self._metadata[key])
        return await super().get(key, prototype, byte_range)

    async def set(self, key: str, value: Buffer) -> None:
        if key in self._metadata:
            self._metadata[key] = value.to_bytes()
        else:
            replace_file(self.root / key, value.to_bytes(), root=self.root, durable=False)


def _open_array(store: Any, name: str, mode: Any, where: str) -> zarr.Array[Any]:
    """Open an array by Zarr.

    Raises:
        DamageError: its metadata cannot be parsed.
        MissingExtraError: its codec is not installed.
    """
    try:
        with zarr.config.set(_EMPTY_CHUNKS), quiet_codecs():
            return zarr.open_array(store, path=name, mode=mode, zarr_format=3)
    except ModuleNotFoundError:
        pcodec(where)
        raise
    except Exception as error:  # Zarr has no error of its own for metadata it cannot parse
        raise DamageError(
            "the metadata of an array is damaged",
            got=repr(error),
            where=f"{where}, array {name!r}",
            do="restore the run from a copy",
        ) from error


def lock_run(path: Path) -> FileLock:
    """Acquire the lock of a run, which has one writer.

    Raises:
        StoreLockedError: another process holds it.
        FormatError: its file is a link.
    """
    return acquired(
        lock_of(path.with_name(path.name + ".lock")),
        "another process is writing this run",
        where=path,
        do="wait for it or stop it; a lock of a dead process frees itself",
    )
