"""How the arrays of a run are chunked and encoded, and which encodings a reader accepts."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec, ShardingCodecIndexLocation, TransposeCodec
from zarr.codecs.numcodecs import PCodec
from zarr.core.array import ShardsConfigParam
from zarr.errors import ZarrUserWarning

from weighttraj.errors import DamageError, FormatError
from weighttraj.format.schema import ArraySpec, Profile

MAX_CHUNK_PARAMS = 16_384
"""Columns in a chunk. While a run is collected, wider arrays are sharded: one file a block."""

MAX_PARTS = 64
"""Chunks that one row is cut into, about: the chunks of larger rows have more columns."""

MAX_NARROW = 1024
"""Parameters up to which a packed chunk is transposed: a tenth smaller, where reading it is fast
anyway. Larger policies would decode at half the speed."""

PACKED_CHUNK_BYTES = 4 << 20
"""Decoded bytes in a chunk of a packed run, about."""

BLOCK_BYTES = MAX_PARTS * PACKED_CHUNK_BYTES
"""Decoded bytes of the rows that a writer keeps in memory and commits together: 256 MiB. A single
row may be larger."""

MAX_CHUNK_BYTES = (1 << 31) - 1
"""Decoded bytes in a chunk, at most: Blosc cannot hold more."""

FREE_CHUNK_BYTES = 1 << 30
"""Decoded bytes up to which a reader accepts a chunk however small its object is."""

MAX_RATIO = 256
"""Decoded bytes for each stored byte of a larger chunk, at most; LZ4 reaches 255."""

PLAIN = {"name": "bytes", "configuration": {"endian": "little"}}
"""The codec of numbers as they are in memory."""

KNOWN_CODECS = frozenset(
    {"bytes", "transpose", "blosc", "crc32c", "sharding_indexed"} | {"numcodecs.pcodec"}
)
"""Codecs that a reader accepts."""


def create_array(
    group: zarr.Group, spec: ArraySpec, profile: Profile, block: int, packed_rows: int | None
) -> None:
    """Create an empty array in a run's group.

    Args:
        group: the run's group.
        spec: the array.
        profile: ``default`` encodes by core codecs, row by row; ``archive`` by PCodec, parameter
            by parameter.
        block: rows of a chunk while the run is collected.
        packed_rows: rows the array will have in a packed run; None: the run is being collected.
    """
    if packed_rows is None:
        profile = "default"  # until the run is packed
    by_column = profile == "archive" and len(spec.inner) == 1 and spec.dtype != "uint8"
    shards: ShardsConfigParam | None = None
    if packed_rows is not None:
        chunks = _packed_chunk(spec, packed_rows, by_column)
    else:
        part = part_of_row(spec.inner, MAX_CHUNK_PARAMS)
        chunks = (block, *part)
        if part != spec.inner:
            widths = (-(-n // c) * c for n, c in zip(spec.inner, part, strict=True))
            # The index comes first: plain HTTP servers answer no request for a suffix.
            shards = ShardsConfigParam(
                shape=(block, *widths), index_location=ShardingCodecIndexLocation.start
            )
    shape, dims = (0, *spec.inner), spec.dims
    if by_column:  # PCodec sees no strides: the order must be the array's own
        shape, dims, chunks = shape[::-1], dims[::-1], chunks[::-1]
    with quiet_codecs():
        group.create_array(
            spec.name,
            shape=shape,
            dtype=spec.dtype,
            chunks=chunks,
            shards=shards,
            fill_value=spec.fill,
            dimension_names=dims,
            **_codecs(spec, profile, packed=packed_rows is not None),
        )


def check_array(spec: ArraySpec, document: Any, rows: int, where: str) -> None:
    """Accept the metadata of an array, or refuse it before anything is decoded or allocated.

    Raises:
        FormatError: it is another array than the run says, or has codecs or chunks that no
            reader should meet.
    """
    try:
        dims = tuple(document["dimension_names"])
        shape, inner = (rows, *spec.inner), document["chunk_grid"]["configuration"]["chunk_shape"]
        if dims == spec.dims[::-1] and len(dims) == 2:
            shape, dims = shape[::-1], dims[::-1]
        got = (tuple(document["shape"]), document["data_type"], dims)
        expected = (shape, spec.dtype, spec.dims)
        if got != expected or document["node_type"] != "array":
            raise FormatError(
                "an array is not what the run's metadata says",
                expected=expected,
                got=got,
                where=where,
                do="restore the run from a copy",
            )
        plain = (
            document["chunk_grid"]["name"] == "regular"
            and document["chunk_key_encoding"]
            == {"name": "default", "configuration": {"separator": "/"}}
            and not document.get("storage_transformers")
        )
        small = min(spec.inner, default=1) > 0 and _divides(inner, [0] * len(shape))
        small = small and _shards_fit(document, inner)
        # A shard may have any size: its chunks are decoded one by one.
        chunk = unshard(document["codecs"], tuple(inner))[1] if small else ()
        size = math.prod(chunk) * np.dtype(spec.dtype).itemsize
        small = small and size <= MAX_CHUNK_BYTES
        unknown = sorted(set(_codec_names(document["codecs"])) - KNOWN_CODECS)
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        if isinstance(error, FormatError):
            raise
        raise DamageError(
            "the metadata of an array is damaged",
            got=repr(error),
            where=where,
            do="restore the run from a copy",
        ) from error
    if unknown or not (plain and small):
        raise FormatError(
            "refused: an array is encoded in a way that this format does not have",
            expected=f"codecs among {sorted(KNOWN_CODECS)}, chunks of at most "
            f"{MAX_CHUNK_BYTES} bytes on a regular grid",
            got=f"codecs {unknown}" if unknown else f"chunks {inner}",
            where=where,
            do="do not use data from a source that you do not trust",
        )


def rows_in_block(specs: Iterable[ArraySpec], block: int) -> int:
    """Return how many rows a writer commits together: fewer than ``block`` if rows are large.

    So the rows of the arrays stay within ``BLOCK_BYTES``, except that one row may be larger.

    Args:
        specs: arrays that are written together.
        block: rows that the user asked for.
    """
    return max(1, min(block, BLOCK_BYTES // max(1, sum(map(row_bytes, specs)))))


def row_bytes(spec: ArraySpec) -> int:
    """Return the decoded bytes of one row of an array."""
    return math.prod(spec.inner) * np.dtype(spec.dtype).itemsize


def part_of_row(inner: tuple[int, ...], most: int) -> tuple[int, ...]:
    """Return the shape of the parts that a row is cut into: last axes whole, if they fit.

    Args:
        inner: shape of a row.
        most: elements of a part; more where a row would have more than ``MAX_PARTS`` parts.

    >>> part_of_row((40_000,), 16_384), part_of_row((64, 84, 84, 4), 16_384)
    ((16384,), (1, 84, 84, 4))
    """
    left, part = max(most, -(-math.prod(inner) // MAX_PARTS)), []
    for n in reversed(inner):
        part.append(max(1, min(n, left)))
        left //= max(1, n)
    return tuple(reversed(part))


def explodes(decoded: int, encoded: int) -> bool:
    """Return whether a chunk would decode to more bytes than an honest writer put into it."""
    return decoded > max(FREE_CHUNK_BYTES, MAX_RATIO * encoded)


def check_grid(document: dict[str, Any]) -> None:
    """Raise ValueError, TypeError or KeyError if the chunks of an array cannot be counted."""
    shape = document["shape"]
    whole = all(type(n) is int and n >= 0 for n in shape)
    chunk = document["chunk_grid"]["configuration"]["chunk_shape"]
    if not whole or not _divides(chunk, [0] * len(shape)):
        raise ValueError(f"shape {shape} in chunks of {chunk}")


def unshard(
    codecs: list[dict[str, Any]], outer: tuple[int, ...]
) -> tuple[list[dict[str, Any]], tuple[int, ...], bool]:
    """Return the codec chain of a chunk, its shape, and whether chunks lie in shards (index first).

    Raises:
        FormatError: they lie in other shards than the format has.
    """
    if [codec["name"] for codec in codecs] != ["sharding_indexed"]:
        return codecs, outer, False
    shard = codecs[0]["configuration"]
    if (
        shard["index_codecs"] != [PLAIN, {"name": "crc32c"}]
        or shard.get("index_location") != "start"
    ):
        raise FormatError(
            "refused: chunks lie in shards that this format does not have",
            expected="the index first, its codecs bytes and crc32c",
            got=shard,
            do="do not use data from a source that you do not trust",
        )
    return shard["codecs"], tuple(shard["chunk_shape"]), True


@contextmanager
def quiet_codecs() -> Iterator[None]:
    """Silence Zarr's warning that PCodec is in no specification: FORMAT.md says so."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Numcodecs codecs are not in", ZarrUserWarning)
        yield


def _packed_chunk(spec: ArraySpec, rows: int, by_column: bool) -> tuple[int, ...]:
    """Return the shape of a chunk of about 4 MiB: as many rows as fit, all but large rows whole."""
    itemsize = np.dtype(spec.dtype).itemsize
    most = PACKED_CHUNK_BYTES // itemsize
    if len(spec.inner) == 1:
        most = MAX_CHUNK_PARAMS // (2 if by_column else 1)
    columns = part_of_row(spec.inner, most)
    fitting = PACKED_CHUNK_BYTES // (itemsize * max(1, math.prod(columns)))
    return max(1, min(rows, fitting)), *columns


def _codecs(spec: ArraySpec, profile: Profile, *, packed: bool) -> dict[str, Any]:
    # Crc32c last: without it no bit flip in a compressed chunk is noticed.
    if profile == "archive" and spec.dtype != "uint8":
        return {
            "serializer": PCodec(level=8, mode_spec="classic"),
            "compressors": (Crc32cCodec(),),
        }
    itemsize = np.dtype(spec.dtype).itemsize
    # Both decode at memory speed; the slow encoder, once for a packed run, makes a twentieth less.
    blosc = BloscCodec(
        cname="lz4hc" if packed else "lz4",
        clevel=5 if packed else 9,
        shuffle="shuffle",
        typesize=itemsize,
    )
    codecs: dict[str, Any] = {"compressors": (blosc, Crc32cCodec())}
    if packed and spec.dims[1:] in (("param",), ("critic_param",)) and spec.inner[0] <= MAX_NARROW:
        codecs["filters"] = (TransposeCodec(order=(1, 0)),)
    return codecs


def _divides(chunk: list[int], outer: list[int]) -> bool:
    """Whether a chunk's shape is made of positive integers that divide those of another shape."""
    pairs = zip(chunk, outer, strict=True)
    return all(type(c) is int and c > 0 and o % c == 0 for c, o in pairs)


def _shards_fit(document: dict[str, Any], outer: list[int]) -> bool:
    """Whether shards, if there are any, are cut into whole chunks, and lie in no other shard."""
    codecs = document["codecs"]
    if "sharding_indexed" not in _codec_names(codecs):
        return True
    shard = codecs[0]["configuration"]
    inner = [*_codec_names(shard["codecs"]), *_codec_names(shard["index_codecs"])]
    plain = len(codecs) == 1 and "sharding_indexed" not in inner
    return plain and _divides(shard["chunk_shape"], outer)


def _codec_names(codecs: list[dict[str, Any]]) -> Iterator[str]:
    if not isinstance(codecs, list):
        raise TypeError(f"codecs that are no list: {codecs!r:.100}")
    for codec in codecs:
        yield codec["name"]
        inner = codec.get("configuration", {})
        if any(not isinstance(inner.get(key, []), list) for key in ("codecs", "index_codecs")):
            raise TypeError(f"codecs that are no list: {inner!r:.100}")
        yield from _codec_names([*inner.get("codecs", []), *inner.get("index_codecs", [])])
