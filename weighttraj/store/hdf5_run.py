"""A run in an HDF5 file, read block by block. The file may be damaged, and is not trusted.

HDF5 itself checks little: links and external storage lead to other files, filters load code, a
chunk that is not there reads as fill values, and a chunk that no filter could shrink and a disk
has lost is zeros whose checksum is right. So every link, type, layout and filter is looked at
before anything is read, and every block of rows is compared with the SHA-256 in the metadata.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import msgspec
import numpy as np

from weighttraj.errors import DamageError, FormatError, WeightTrajError
from weighttraj.format.schema import ArraySpec, RunInfo, arrays_of, load_json, parse
from weighttraj.store.codecs import FREE_CHUNK_BYTES
from weighttraj.store.objects import check_name, fitting_memory
from weighttraj.store.zarr_run import ATTRIBUTE, check_checksum

RUN = "run.json"
"""Metadata of a run, in the run's group: ``weighttraj``, ``arrays`` and their ``sha256``."""

MAX_METADATA_BYTES = 16 << 20
"""Metadata that a reader accepts."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"

_FILTERS = {
    h5py.h5z.FILTER_SHUFFLE: "shuffle",
    h5py.h5z.FILTER_DEFLATE: "gzip",
    h5py.h5z.FILTER_LZF: "lzf",
    h5py.h5z.FILTER_FLETCHER32: "fletcher32",
}
_DISTRUST = "do not use data from a source that you do not trust"
_RESTORE = "restore the file from a copy, or export it again"


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """How an array is checked: in blocks of whole rows, which are chunks of the file too."""

    rows: int
    """Rows in a block; the last one may have fewer."""
    sha256: tuple[str, ...]
    """Hash of each block's values, C order, little-endian; hexadecimal."""


class H5RunStore:
    """The arrays and metadata of one run in an HDF5 file, to be read.

    No handle stays open, so a store survives fork, spawn and pickling. The two blocks of each
    array that were read last are kept.
    """

    def __init__(self, file: Path, info: RunInfo, blocks: dict[str, Blocks]) -> None:
        self.file = file
        self.info = info
        self.specs = arrays_of(info)
        self._blocks = blocks
        self._recent: dict[str, tuple[tuple[int, np.ndarray], ...]] = {}

    @property
    def path(self) -> Path:
        """The file and, after it, the run's group in it, as HDF5's own tools name it."""
        return self.file / "runs" / self.info.run_id

    @classmethod
    def open(cls, file: Path, run_id: str) -> H5RunStore:
        """Open a run of a file.

        Raises:
            FileNotFoundError: there is no such file.
            FormatError: it is no such run of this format, or asks for what no reader should do.
            DamageError: it is damaged.
        """
        where = f"{file}, /runs/{run_id}/{RUN}"
        with opened(file) as root:
            content = read_document(root, f"runs/{run_id}/{RUN}", where)
        info, blocks = _parse(load_json(content, where), where)
        store = cls(file, info, blocks)
        with opened(file) as root:
            for spec in store.specs.values():
                store._array(root, spec)
        return store

    def read(self, name: str, key: Any) -> np.ndarray:
        """Read part of an array; ``key`` as numpy takes it, within the committed rows.

        Raises:
            DamageError: a block is missing, or is not what was written.
        """
        rows, *rest = key if isinstance(key, tuple) else (key,)
        with fitting_memory(f"{self.path}, array {name!r}"):
            return self._read(self.specs[name], rows, (slice(None), *rest))

    def chunk_rows(self, name: str) -> int:
        """Return rows of an array that are decoded together."""
        return self._blocks[name].rows

    def _read(self, spec: ArraySpec, rows: Any, columns: tuple[Any, ...]) -> np.ndarray:
        if isinstance(rows, slice):
            rows = np.arange(*rows.indices(self.info.committed(spec.axis)))
        rows = np.asarray(rows, np.int64)
        size = self._blocks[spec.name].rows
        order = np.argsort(rows.reshape(-1) // size, kind="stable")
        wanted = rows.reshape(-1)[order]
        parts = [np.empty((0, *spec.inner), spec.dtype)[columns]]
        for group in np.split(wanted, np.flatnonzero(np.diff(wanted // size)) + 1):
            if group.size:
                index = int(group[0]) // size
                parts.append(self._block(spec, index)[group - index * size][columns])
        read = np.concatenate(parts)
        values = np.empty_like(read)
        values[order] = read
        return np.reshape(values, (*rows.shape, *values.shape[1:]))

    def _block(self, spec: ArraySpec, index: int) -> np.ndarray:
        recent = self._recent.get(spec.name, ())
        for number, values in recent:
            if number == index:
                return values
        blocks = self._blocks[spec.name]
        with opened(self.file) as root:
            stored = self._array(root, spec)
            values = np.asarray(
                stored[index * blocks.rows : min((index + 1) * blocks.rows, len(stored))]
            )
        if sha256(values) != blocks.sha256[index]:
            raise DamageError(
                "committed data is not what was written",
                expected=f"sha256 {blocks.sha256[index]}",
                got=f"sha256 {sha256(values)}",
                where=f"{self.path}, array {spec.name!r}, block {index}",
                do=_RESTORE,
            )
        self._recent[spec.name] = (*recent[-1:], (index, values))
        return values

    def _array(self, root: h5py.File, spec: ArraySpec) -> h5py.Dataset:
        shape = (self.info.committed(spec.axis), *spec.inner)
        return _checked_array(root, f"runs/{self.info.run_id}/{spec.name}", spec, shape)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_recent": {}}


@contextlib.contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for a moment; whatever HDF5 raises meanwhile is damage.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: it is no HDF5 file.
        DamageError: it is damaged.
    """
    with path.open("rb") as file:
        start = file.read(len(SIGNATURE))
    if start != SIGNATURE:
        raise FormatError(
            "this is no HDF5 file",
            expected=f"a file that begins with {SIGNATURE!r}",
            got=start,
            where=path,
            do="open what weighttraj.tools.hdf5.export_hdf5 wrote",
        )
    try:
        with h5py.File(path, "r") as root:
            yield root
    except (WeightTrajError, MemoryError):
        raise
    # HDF5 raises OSError, RuntimeError, KeyError and ValueError, as it comes.
    except Exception as error:
        raise DamageError("the file is damaged", got=error, where=path, do=_RESTORE) from error


def exists(root: h5py.File, name: str) -> bool:
    """Return whether there is such an object; raises FormatError if a link leads to it."""
    return _located(root, name) is not None


def read_document(root: h5py.File, name: str, where: str) -> bytes:
    """Return a fixed-length byte string; its size is known before it is read.

    Raises:
        FormatError: it is something else, too large, or lies outside the file.
        DamageError: there is none.
    """
    found = _dataset(root, name)
    kind, plist = found.get_type(), found.get_create_plist()
    fixed = isinstance(kind, h5py.h5t.TypeStringID) and not kind.is_variable_str()
    inside = plist.get_layout() in (h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS)
    inside = inside and not plist.get_external_count()
    scalar = fixed and inside and found.get_space().get_simple_extent_type() == h5py.h5s.SCALAR
    if not scalar or kind.get_size() > MAX_METADATA_BYTES:
        raise FormatError(
            "refused: metadata is not stored as this format has it",
            expected=f"a fixed-length string of at most {MAX_METADATA_BYTES} bytes, in the file",
            got=f"{kind.get_size()} bytes" if scalar else "something else",
            where=where,
            do=_DISTRUST,
        )
    return bytes(h5py.Dataset(found)[()])


def sha256(values: np.ndarray) -> str:
    """Return the hash of an array's values in C order, little-endian; hexadecimal."""
    return hashlib.sha256(values.astype(values.dtype.newbyteorder("<")).tobytes()).hexdigest()


def _parse(document: Any, where: str) -> tuple[RunInfo, dict[str, Blocks]]:
    """Return the checked metadata of a run and of its arrays."""
    plain = document if isinstance(document, dict) else {}
    stored = plain.pop("sha256", None)
    info = parse(plain.get(ATTRIBUTE), RunInfo, where)
    check_checksum(plain, stored, where)
    try:
        blocks = msgspec.convert(plain.get("arrays"), dict[str, Blocks])
        for name, spec in arrays_of(info).items():
            rows, n = blocks[name].rows, info.committed(spec.axis)
            size = rows * math.prod(spec.inner) * np.dtype(spec.dtype).itemsize
            if rows < 1 or (rows > 1 and size > FREE_CHUNK_BYTES):
                raise ValueError(f"{name}: blocks of {rows} rows, {size} bytes")
            if len(blocks[name].sha256) != -(-n // rows):
                raise ValueError(f"{name}: {len(blocks[name].sha256)} blocks for {n} rows")
    except (msgspec.ValidationError, KeyError, ValueError) as error:
        raise FormatError(
            "the blocks of an array are not what the run's metadata says",
            expected=f"hashes of all blocks, of one row or at most {FREE_CHUNK_BYTES} bytes each",
            got=error,
            where=where,
            do=_DISTRUST,
        ) from error
    return info, blocks


def _checked_array(
    root: h5py.File, name: str, spec: ArraySpec, shape: tuple[int, ...]
) -> h5py.Dataset:
    """An array that may be read. Its shape is asked for last: a virtual one opens other files."""
    found, where = _dataset(root, name), f"{root.filename}, /{name}"
    plist = found.get_create_plist()
    chunked = plist.get_layout() == h5py.h5d.CHUNKED
    filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
    itemsize = np.dtype(spec.dtype).itemsize
    if (
        not chunked
        or filters - _FILTERS.keys()
        or math.prod(plist.get_chunk()) * itemsize > FREE_CHUNK_BYTES
    ):
        raise FormatError(
            "refused: an array is stored in a way that this format does not have",
            expected=f"chunks of at most {FREE_CHUNK_BYTES} bytes in the file itself, filters "
            f"among {sorted(_FILTERS.values())}",
            got=f"filters {sorted(filters)}, chunks {plist.get_chunk() if chunked else None}",
            where=where,
            do=_DISTRUST,
        )
    expected = (shape, np.dtype(spec.dtype).newbyteorder("<"))
    if (found.shape, found.dtype) != expected:
        raise FormatError(
            "an array is not what the run's metadata says",
            expected=expected,
            got=(found.shape, found.dtype),
            where=where,
            do=_RESTORE,
        )
    chunks = math.prod(-(-n // c) for n, c in zip(shape, plist.get_chunk(), strict=True))
    if found.get_num_chunks() != chunks:
        raise DamageError(
            "committed data is missing",
            expected=f"{chunks} chunks",
            got=found.get_num_chunks(),
            where=where,
            do=_RESTORE,
        )
    return h5py.Dataset(found)


def _dataset(root: h5py.File, name: str) -> h5py.h5d.DatasetID:
    found = _located(root, name)
    if not isinstance(found, h5py.h5d.DatasetID):
        raise DamageError(
            "the file lacks an array or metadata that it should have",
            expected=f"/{name}",
            got="no such data" if found is None else "something else",
            where=root.filename,
            do=_RESTORE,
        )
    return found


def _located(root: h5py.File, name: str) -> Any:
    """Return the HDF5 object of a name, reached by hard links only; None: there is none."""
    found = h5py.h5g.open(root.id, b"/")
    for part in check_name(name, root.filename).split("/"):
        if not isinstance(found, h5py.h5g.GroupID) or not found.links.exists(part.encode()):
            return None
        if found.links.get_info(part.encode()).type != h5py.h5l.TYPE_HARD:
            raise FormatError(
                "a part of the file is a link",
                expected="the data itself: a link could lead anywhere",
                got=f"{part!r} in /{name}",
                where=root.filename,
                do=_DISTRUST,
            )
        found = h5py.h5o.open(found, part.encode())
    return found
