"""Decodes whole rows of an array, without Zarr's machinery: a tenth of the time for small runs.

Knows the codec chains that this package writes; Zarr reads the others, and every selection of
columns. Both read the same bytes, and tests hold them against each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import google_crc32c
import numpy as np
from numcodecs import blosc

from weighttraj.errors import DamageError, FormatError
from weighttraj.format.codecs import PLAIN, unshard
from weighttraj.format.objects import Objects, missing_object

_MISSING = 2**64 - 1


class RowDecoder:
    """Reads ranges of rows of one array.

    Args:
        objects: where the chunks are.
        name: the array.
        document: its Zarr metadata, checked.
        by_column: rows are the last axis of the array.

    Raises:
        NotImplementedError: Zarr must read this array.
    """

    def __init__(
        self, objects: Objects, name: str, document: dict[str, Any], *, by_column: bool
    ) -> None:
        self._objects, self._name, self._by_column = objects, name, by_column
        self._shape = tuple(document["shape"])
        self._dtype = np.dtype(document["data_type"]).newbyteorder("<")
        self._outer = tuple(document["chunk_grid"]["configuration"]["chunk_shape"])
        codecs, self._chunk, self._sharded = unshard(document["codecs"], self._outer)
        self._transposed = bool(codecs) and codecs[0] == _transpose(len(self._shape))
        codecs = codecs[1:] if self._transposed else codecs
        single_byte = self._dtype.itemsize == 1
        plain = codecs[:1] == [PLAIN] or (single_byte and codecs[:1] == [{"name": "bytes"}])
        kinds = [codec["name"] for codec in codecs]
        self._pco = kinds == ["numcodecs.pcodec", "crc32c"] and not self._transposed
        if not self._pco and not (plain and kinds[1:] == ["blosc", "crc32c"]):
            raise NotImplementedError(kinds)

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows from start to stop (exclusive), C order.

        Raises:
            DamageError: a chunk is missing, or its checksum or size is wrong.
        """
        axis = len(self._shape) - 1 if self._by_column else 0
        bounds = [(0, n) for n in self._shape]
        bounds[axis] = (start, stop)
        parts = [range(a // c, -(-b // c)) for (a, b), c in zip(bounds, self._outer, strict=True)]
        shape = tuple(b - a for a, b in bounds)
        if start < stop:
            self._require(parts)
        out = self._empty(shape[::-1] if self._by_column else shape)
        target = out.T if self._by_column else out
        scratch = self._empty((math.prod(self._chunk),))
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
                target[place] = self._decode(content, scratch, index)[source]
        return out

    def _empty(self, shape: tuple[int, ...]) -> np.ndarray:
        try:
            return np.empty(shape, self._dtype)
        except MemoryError as error:
            raise FormatError(
                "this selection does not fit into memory",
                got=error,
                where=f"{self._objects.path}, array {self._name!r}",
                do="read fewer rows at a time",
            ) from error

    def _require(self, parts: list[range]) -> None:
        """Every chunk must be there before memory for them is taken."""
        for index in grid(parts):
            if not self._objects.exists(self._key(index)):
                raise self._missing(index)

    def _encoded(
        self, index: tuple[int, ...], bounds: list[tuple[int, int]]
    ) -> Iterator[tuple[tuple[int, ...], memoryview]]:
        """First element and bytes of each chunk in an object."""
        content = self._objects.read(self._key(index))
        if content is None:
            raise self._missing(index)
        corner = tuple(i * c for i, c in zip(index, self._outer, strict=True))
        if not self._sharded:
            yield corner, memoryview(content)
            return
        counts = [o // c for o, c in zip(self._outer, self._chunk, strict=True)]
        size = 16 * math.prod(counts)
        table = np.frombuffer(self._checked(content[: size + 4], index), "<u8").reshape(-1, 2)
        for place, (offset, length) in zip(np.ndindex(*counts), table.tolist(), strict=True):
            inner = tuple(k + i * c for k, i, c in zip(corner, place, self._chunk, strict=True))
            if all(k < b for k, (_, b) in zip(inner, bounds, strict=True)):
                if offset == _MISSING:
                    raise self._missing(index)
                yield inner, memoryview(content)[offset : offset + length]

    def _decode(
        self, content: bytes | memoryview, scratch: np.ndarray, index: tuple[int, ...]
    ) -> np.ndarray:
        data = self._checked(content, index)
        shape = self._chunk[::-1] if self._transposed else self._chunk
        try:
            if self._pco:
                # Imported where it is used: reading the default profile needs no pcodec.
                from pcodec import standalone

                progress = standalone.simple_decompress_into(data, scratch)
                whole = progress.n_processed == scratch.size and progress.finished
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

    def _checked(self, content: bytes | memoryview, index: tuple[int, ...]) -> bytes:
        """The bytes before the crc32c at the end, which must match them."""
        data, stored = bytes(content[:-4]), bytes(content[-4:])
        if len(stored) < 4 or google_crc32c.value(data) != int.from_bytes(stored, "little"):
            raise self._damaged(index, "another checksum")
        return data

    def _key(self, index: tuple[int, ...]) -> str:
        return "/".join([self._name, "c", *map(str, index)])

    def _missing(self, index: tuple[int, ...]) -> DamageError:
        return missing_object(self._key(index), self._objects.path)

    def _damaged(self, index: tuple[int, ...], got: object) -> DamageError:
        return DamageError(
            "committed data cannot be decoded",
            expected="chunks whose crc32c matches",
            got=got,
            where=f"{self._objects.path}, {self._key(index)}",
            do="restore the file from a copy, or collect the run again",
        )


def grid(parts: list[range]) -> Iterator[tuple[int, ...]]:
    """As ``itertools.product``, which would make lists of the ranges first."""
    for i in parts[0]:
        yield from ((i, *rest) for rest in grid(parts[1:])) if parts[1:] else [(i,)]


def _transpose(ndim: int) -> dict[str, Any]:
    return {"name": "transpose", "configuration": {"order": list(range(ndim))[::-1]}}
