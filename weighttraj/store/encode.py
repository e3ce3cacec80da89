"""Encodes one object of an array, chunk by chunk, without Zarr's machinery and its copies.

The counterpart of ``decode``, for runs that are being collected: what Zarr holds at once is ten
times a block, and training goes on beside it. Zarr reads what is written here; tests see to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import google_crc32c
import numpy as np
from numcodecs import blosc

from weighttraj.atomic import replacing
from weighttraj.errors import DamageError
from weighttraj.format.schema import ArraySpec
from weighttraj.store.codecs import unshard

_SHUFFLES = {"noshuffle": blosc.NOSHUFFLE, "shuffle": blosc.SHUFFLE, "bitshuffle": blosc.BITSHUFFLE}


class ObjectEncoder:
    """Encodes blocks of rows of one array.

    Args:
        spec: the array.
        document: its Zarr metadata.

    Raises:
        NotImplementedError: Zarr must write this array.
    """

    def __init__(self, spec: ArraySpec, document: dict[str, Any]) -> None:
        self._spec = spec
        outer = tuple(document["chunk_grid"]["configuration"]["chunk_shape"])
        codecs, self._chunk, self._sharded = unshard(document["codecs"], outer)
        kinds = [codec["name"] for codec in codecs]
        transposed = document["dimension_names"][0] != spec.axis
        if kinds != ["bytes", "blosc", "crc32c"] or transposed:
            raise NotImplementedError(kinds)
        self._blosc = codecs[1]["configuration"]
        self._counts = tuple(o // c for o, c in zip(outer, self._chunk, strict=True))

    def write(self, root: Path, key: str, rows: Sequence[np.ndarray] | np.ndarray) -> str:
        """Write one object so that readers see all of it or none; read it back and compare.

        Fewer rows than a chunk has are filled up. One chunk at a time is in memory.

        Args:
            root: folder of the run.
            key: name of the object in it.
            rows: what it holds.

        Returns:
            The crc32c of each chunk, hexadecimal.

        Raises:
            DamageError: a chunk does not decode to what was encoded, or reads back differently.
            FormatError: a folder on the way is a link.
        """
        path = root / key
        places = list(np.ndindex(*self._counts[1:]))
        head = 16 * len(places) + 4 if self._sharded else 0
        table: list[tuple[int, int]] = []
        tags: list[str] = []
        # The commit sees all objects of a block on the disk at once.
        with replacing(path, root=root, durable=False) as file:
            file.seek(head)
            for place in places:
                data = self._encode(rows, place)
                table.append((file.tell(), len(data)))
                tags.append(data[-4:].hex())
                file.write(data)
            if self._sharded:
                index = np.array(table, "<u8").tobytes()
                file.seek(0)
                file.write(index + _crc(index))
        with path.open("rb") as file:
            same = not self._sharded or file.read(head) == index + _crc(index)
            # A chunk's own checksum makes every whole chunk look alike: compare these too.
            got = [_tag_of(file, length) for _, length in table]
            if not same or got != tags or file.read(1):
                raise DamageError(
                    "what was written reads back as something else",
                    where=path,
                    do="check the disk; nothing of this block was committed",
                )
        return "".join(tags)

    def _encode(self, rows: Sequence[np.ndarray] | np.ndarray, place: tuple[int, ...]) -> bytes:
        """Encode one chunk: a part of each row."""
        chunk = np.full(self._chunk, self._spec.fill, self._spec.dtype)
        spans = list(zip(place, self._chunk[1:], self._spec.inner, strict=True))
        part: tuple[Any, ...] = tuple(slice(i * c, min((i + 1) * c, n)) for i, c, n in spans)
        corner: tuple[Any, ...] = tuple(slice(s.stop - s.start) for s in part)
        for i, row in enumerate(rows):
            chunk[i, *corner] = row[part]
        settings = self._blosc
        shuffle = _SHUFFLES[settings["shuffle"]]
        data: bytes = blosc.compress(
            chunk, settings["cname"].encode(), settings["clevel"], shuffle, settings["blocksize"]
        )
        again = np.empty_like(chunk)
        blosc.decompress(data, again)
        if not np.array_equal(again.view(np.uint8), chunk.view(np.uint8)):
            raise DamageError(
                "a chunk decodes to something else than was encoded",
                where=f"array {self._spec.name!r}",
                do="check the memory of this machine; nothing of this block was committed",
            )
        return data + _crc(data)


def _tag_of(file: BinaryIO, length: int) -> str:
    """Return the crc32c of the chunk that is read next, if it is right."""
    chunk = file.read(length)
    return chunk[-4:].hex() if _crc(chunk[:-4]) == chunk[-4:] else "damaged"


def _crc(data: bytes) -> bytes:
    return int(google_crc32c.value(data)).to_bytes(4, "little")
