"""Runs that are read from where they are: parts of a zip file, or objects, as they are needed."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

from weighttraj.errors import DamageError
from weighttraj.remote.address import RemotePath
from weighttraj.remote.failures import NoPartsError
from weighttraj.remote.store import MAX_OBJECT, Piece, store_at
from weighttraj.store.objects import ZipObjects, check_name, replaced

TAIL_BYTES = 1 << 16
"""Bytes at the end of a packed run that are fetched first: the directory of 800 objects."""
GAP_BYTES = 1 << 14
"""Bytes between two objects that are fetched with them, rather than to ask twice."""
PART_BYTES = 1 << 20
"""Bytes at the start of an object up to which only they are asked for."""
KEPT_BYTES = 64 << 20
"""Bytes of a run that are kept in memory, and fetched at a time, at most."""


def remote_objects(path: RemotePath) -> ZipObjects | RemoteFolder:
    """Return the objects of a run at an address: a packed one by its name, else a folder.

    Raises:
        FileNotFoundError: there is no run at the address.
        RemoteError: it cannot be reached.
    """
    path = path.as_object()
    if path.part.endswith(".zip"):
        return ZipObjects(RemoteBlob(path))
    folder = RemoteFolder(path)
    if folder.size("zarr.json") is None:
        raise FileNotFoundError(f"no run at {path}: it has no zarr.json")
    return folder


class RemoteBlob:
    """A file that is somewhere else; what was read last is kept.

    Raises:
        FileNotFoundError: there is none.
        RemoteError: it cannot be reached, or the server sends no parts.
    """

    def __init__(self, path: RemotePath) -> None:
        self.path = path
        tail = store_at(path.root).read_tail(path.part, TAIL_BYTES)
        if tail is None:
            raise FileNotFoundError(f"no run at {path}")
        self.size, self._tag = tail.size, tail.tag
        self._tail, self._kept = tail, [tail]

    def read(self, start: int, stop: int) -> bytes:
        """See ``Blob``.

        Raises:
            FormatError: it was replaced since it was opened.
            RemoteError: it cannot be reached.
        """
        piece = self._find(start, stop) or self._fetch(start, stop)
        return piece.content[start - piece.start : stop - piece.start]

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """See ``Blob``: what lies together is fetched together."""
        missing = [span for span in spans if self._find(*span) is None]
        while missing:
            start, stop = missing.pop(0)
            if stop - start > KEPT_BYTES // 2:
                return  # asked for when it is read, as far as it is read
            while missing and 0 <= missing[0][0] - stop <= GAP_BYTES:
                if missing[0][1] - start > KEPT_BYTES // 2:
                    return  # asked for when it is read
                stop = missing.pop(0)[1]
            self._keep(self._fetch(start, stop))
            if sum(len(piece.content) for piece in self._kept) > KEPT_BYTES // 2:
                return

    def _find(self, start: int, stop: int) -> Piece | None:
        for piece in reversed(self._kept):
            if piece.start <= start and stop <= piece.start + len(piece.content):
                return piece
        return None

    def _fetch(self, start: int, stop: int) -> Piece:
        piece = store_at(self.path.root).read_range(self.path.part, start, stop)
        if piece is None or (piece.size, piece.tag) != (self.size, self._tag):
            raise replaced(self.path)
        if (piece.start, len(piece.content)) != (start, stop - start):
            raise DamageError(
                "the server sends other bytes than were asked for",
                expected=f"bytes {start} to {stop}",
                got=f"{len(piece.content)} bytes from {piece.start}",
                where=self.path,
                do="download the data set, which checks every file",
            )
        return piece

    def _keep(self, piece: Piece) -> None:
        self._kept.append(piece)
        while len(self._kept) > 2 and sum(len(p.content) for p in self._kept) > KEPT_BYTES:
            del self._kept[1]  # the tail stays

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": [self._tail]}


class RemoteFolder:
    """Objects below a prefix of an object store."""

    def __init__(self, path: RemotePath) -> None:
        self.path = path

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """See ``Objects``."""
        store, limit = store_at(self.path.root), MAX_OBJECT if stop is None else stop
        if stop is not None and (start > 0 or stop <= PART_BYTES):
            with contextlib.suppress(NoPartsError):
                piece = store.read_range(self._name(name), start, stop)
                return None if piece is None else piece.content
            limit = MAX_OBJECT
        if name.endswith("zarr.json"):
            piece = store.read(self._name(name), limit)
        else:
            piece = store.read_large(self._name(name), limit)
        return None if piece is None else piece.content[start:stop]

    def size(self, name: str) -> int | None:
        """See ``Objects``."""
        return store_at(self.path.root).size(self._name(name))

    def expect(self, names: Sequence[str]) -> None:
        """See ``Objects``; each one is asked for when it is read."""

    def _name(self, name: str) -> str:
        return (self.path / check_name(name, self.path)).part
