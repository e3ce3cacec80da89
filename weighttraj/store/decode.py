"""Decodes rows of an array, without Zarr's machinery: a tenth of the time for small runs.

Reads what FORMAT.md allows and nothing else, and knows which chunk belongs where: Zarr would read
a missing chunk as fill values, and one in the place of another without a word. Tests hold both
against each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import google_crc32c
import numpy as np
from numcodecs import blosc

from weighttraj.errors import DamageError, FormatError, MissingExtraError
from weighttraj.store.codecs import BLOCK_BYTES, MAX_RATIO, PLAIN, explodes, unshard
from weighttraj.store.objects import Objects, fitting_memory

_MISSING = 2**64 - 1
_OVERHEAD = 1 << 20  # bytes of an object beside its chunks, at most

_WHOLE_BYTES = BLOCK_BYTES
"""Stored bytes up to which a shard is read at once, while a writer may replace it. Larger ones hold
a single row, or are old: their chunks are read one by one."""

GROWING = "--------"
"""Stands for the crc32c of a chunk that is not full while its run is collected."""


class RowDecoder:
    """Reads ranges of rows of one array.

    Args:
        objects: where the chunks are.
        name: the array.
        document: its Zarr metadata, checked.
        tags: the crc32c of each chunk, as the run's metadata have them.
        by_column: rows are the last axis of the array.

    Raises:
        FormatError: the array is encoded in a way that the format does not have.
    """

    def __init__(
        self, objects: Objects, name: str, document: dict[str, Any], tags: str, *, by_column: bool
    ) -> None:
        self._objects, self._name, self._tags, self._by_column = objects, name, tags, by_column
        self._shape = tuple(document["shape"])
        self._dtype = np.dtype(document["data_type"]).newbyteorder("<")
        self._outer = tuple(document["chunk_grid"]["configuration"]["chunk_shape"])
        codecs, self._chunk, self._sharded = unshard(document["codecs"], self._outer)
        self._transposed = bool(codecs) and codecs[0] == _transpose(len(self._shape))
        codecs = codecs[1:] if self._transposed else codecs
        kinds = [codec["name"] for codec in codecs]
        single_byte = self._dtype.itemsize == 1
        plain = codecs[:1] == [PLAIN] or (single_byte and codecs[:1] == [{"name": "bytes"}])
        self._pco = kinds == ["numcodecs.pcodec", "crc32c"] and not self._transposed
        self._blosc = plain and kinds[1:] == ["blosc", "crc32c"]
        if not (self._pco or self._blosc or (plain and kinds[1:] == ["crc32c"])):
            raise FormatError(
                "refused: an array is encoded in a way that this format does not have",
                expected="transpose or not; bytes and perhaps blosc, or numcodecs.pcodec; crc32c",
                got=document["codecs"],
                where=f"{objects.path}, array {name!r}",
                do="do not use data from a source that you do not trust",
            )

    def read(self, start: int, stop: int, columns: tuple[int, int] | None = None) -> np.ndarray:
        """Rows from start to stop (exclusive), C order; of two-dimensional arrays, some columns.

        Raises:
            DamageError: a chunk is missing, or its checksum or size is wrong.
        """
        axis = len(self._shape) - 1 if self._by_column else 0
        bounds = [(0, n) for n in self._shape]
        bounds[axis] = (start, stop)
        if columns is not None:
            bounds[1 - axis if len(bounds) == 2 else 1] = columns
        parts = [range(a // c, -(-b // c)) for (a, b), c in zip(bounds, self._outer, strict=True)]
        shape = tuple(b - a for a, b in bounds)
        if min(shape) > 0:
            self._require(parts)
        out = self._empty(shape[::-1] if self._by_column else shape)
        target = out.T if self._by_column else out
        scratch: np.ndarray | None = None
        self._objects.expect([self._key(index) for index in itertools.product(*parts)])
        for index in itertools.product(*parts):
            for corner, content in self._encoded(index, bounds):
                lows = [max(a, k) for (a, _), k in zip(bounds, corner, strict=True)]
                ends = zip(bounds, corner, self._chunk, strict=True)
                highs = [min(b, k + c) for (_, b), k, c in ends]
                if any(low >= high for low, high in zip(lows, highs, strict=True)):
                    continue
                spans = list(zip(lows, highs, strict=True))
                source = tuple(slice(a - k, b - k) for (a, b), k in zip(spans, corner, strict=True))
                place = tuple(
                    slice(a - o, b - o) for (a, b), (o, _) in zip(spans, bounds, strict=True)
                )
                data = self._checked(content, index, self._tag(corner))
                scratch = self._memory(scratch, len(data), index)
                target[place] = self._decode(data, scratch, index)[source]
        return out

    def _tag(self, corner: tuple[int, ...]) -> str:
        """Return the crc32c that the chunk has by the run's metadata, hexadecimal."""
        axis = len(self._shape) - 1 if self._by_column else 0
        counts = [-(-n // c) for n, c in zip(self._shape, self._chunk, strict=True)]
        place = [k // c for k, c in zip(corner, self._chunk, strict=True)]
        order = [axis, *(i for i in range(len(counts)) if i != axis)]
        position = 0
        for i in order:
            position = position * counts[i] + place[i]
        return self._tags[8 * position : 8 * position + 8]

    def _empty(self, shape: tuple[int, ...]) -> np.ndarray:
        with fitting_memory(f"{self._objects.path}, array {self._name!r}"):
            return np.empty(shape, self._dtype)

    def _require(self, parts: list[range]) -> None:
        """Check that every chunk exists before memory is allocated."""
        for index in grid(parts):
            if self._objects.size(self._key(index)) is None:
                raise self._missing(index)

    def _encoded(
        self, index: tuple[int, ...], bounds: list[tuple[int, int]]
    ) -> Iterator[tuple[tuple[int, ...], memoryview]]:
        """First element and bytes of each chunk in an object."""
        corner = tuple(i * c for i, c in zip(index, self._outer, strict=True))
        if not self._sharded:
            yield corner, memoryview(self._bytes(index, 0, self._most()))
            return
        size = self._objects.size(self._key(index)) or 0
        content = self._bytes(index, 0, self._most()) if size <= _WHOLE_BYTES else None
        counts = [o // c for o, c in zip(self._outer, self._chunk, strict=True)]
        head = 16 * math.prod(counts) + 4
        start = self._bytes(index, 0, head) if content is None else content[:head]
        table = np.frombuffer(self._checked(start, index), "<u8").reshape(-1, 2)
        size = size if content is None else len(content)
        if len(table) != math.prod(counts) or int(table.sum(axis=1).max()) != size:
            raise self._damaged(index, f"{size} bytes, not what the shard's index says")
        for place, (offset, length) in zip(np.ndindex(*counts), table.tolist(), strict=True):
            inner = tuple(k + i * c for k, i, c in zip(corner, place, self._chunk, strict=True))
            ends = zip(inner, self._chunk, bounds, strict=True)
            if all(k < b and k + c > a for k, c, (a, b) in ends):
                if offset == _MISSING:
                    raise self._missing(index)
                if content is None:
                    yield inner, memoryview(self._bytes(index, offset, offset + length))
                else:
                    yield inner, memoryview(content)[offset : offset + length]

    def _most(self) -> int:
        """Return how many bytes an object may have: more than what it decodes to is no data."""
        return int(2 * math.prod(self._outer) * self._dtype.itemsize) + _OVERHEAD

    def _bytes(self, index: tuple[int, ...], start: int, stop: int) -> bytes:
        """Return the bytes of an object that must be there, or some of them."""
        content = self._objects.read(self._key(index), start, stop)
        if content is None:
            raise self._missing(index)
        return content

    def _memory(
        self, memory: np.ndarray | None, encoded: int, index: tuple[int, ...]
    ) -> np.ndarray:
        """Return memory for one decoded chunk: that of the last one, if there was one.

        Raises:
            FormatError: the chunk asks for far more memory than its bytes can fill.
        """
        size = math.prod(self._chunk)
        if explodes(size * self._dtype.itemsize, encoded):
            raise FormatError(
                "refused: a chunk asks for more memory than its bytes can fill",
                expected=f"at most {MAX_RATIO} bytes for each of the {encoded} stored ones",
                got=f"{size * self._dtype.itemsize} bytes",
                where=f"{self._objects.path}, {self._key(index)}",
                do="do not use data from a source that you do not trust",
            )
        return self._empty((size,)) if memory is None else memory

    def _decode(self, data: bytes, scratch: np.ndarray, index: tuple[int, ...]) -> np.ndarray:
        shape = self._chunk[::-1] if self._transposed else self._chunk
        try:
            if self._pco:
                progress = pcodec(self._objects.path).simple_decompress_into(data, scratch)
                whole = progress.n_processed == scratch.size and progress.finished
            elif not self._blosc:
                whole = len(data) == scratch.nbytes
                if whole:
                    scratch.view(np.uint8)[:] = np.frombuffer(data, np.uint8)
            else:
                # Blosc believes its header: another size would lead it out of the bytes.
                sizes = (int.from_bytes(data[at : at + 4], "little") for at in (4, 12))
                whole = tuple(sizes) == (scratch.nbytes, len(data))
                if whole:
                    blosc.decompress(data, scratch)
        except (RuntimeError, ValueError, TypeError) as error:
            raise self._damaged(index, error) from error
        if not whole:
            raise self._damaged(index, "another number of bytes than the chunk has")
        values = scratch.reshape(shape)
        return values.T if self._transposed else values

    def _checked(
        self, content: bytes | memoryview, index: tuple[int, ...], tag: str | None = None
    ) -> bytes:
        """The bytes before the crc32c at the end, which must match them, and be the committed."""
        data, stored = bytes(content[:-4]), bytes(content[-4:])
        if len(stored) < 4 or google_crc32c.value(data) != int.from_bytes(stored, "little"):
            raise self._damaged(index, "another checksum")
        if tag is not None and stored.hex() != tag != GROWING:
            raise self._damaged(index, f"another chunk: crc32c {stored.hex()}, committed {tag}")
        return data

    def _key(self, index: tuple[int, ...]) -> str:
        return "/".join([self._name, "c", *map(str, index)])

    def _missing(self, index: tuple[int, ...]) -> DamageError:
        return DamageError(
            "committed data is missing",
            expected=f"the object {self._key(index)}",
            got="no such object",
            where=self._objects.path,
            do="restore the file from a copy, or collect the run again from its seed",
        )

    def _damaged(self, index: tuple[int, ...], got: object) -> DamageError:
        return DamageError(
            "committed data cannot be decoded",
            expected="chunks whose crc32c matches",
            got=got,
            where=f"{self._objects.path}, {self._key(index)}",
            do="restore the file from a copy, or collect the run again",
        )


def grid(parts: list[range]) -> Iterator[tuple[int, ...]]:
    """Yield what ``itertools.product`` does, which would make lists of the ranges first."""
    for i in parts[0]:
        yield from ((i, *rest) for rest in grid(parts[1:])) if parts[1:] else [(i,)]


def pcodec(where: object) -> Any:
    """Return the module that decodes the archive profile: reading the default one needs none.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        from pcodec import standalone
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            "the archive profile needs pcodec, which is not installed",
            where=where,
            do="pip install 'numcodecs[pcodec]'",
        ) from error
    return standalone


def _transpose(ndim: int) -> dict[str, Any]:
    return {"name": "transpose", "configuration": {"order": list(range(ndim))[::-1]}}
