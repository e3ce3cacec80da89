"""Where the bytes of a run are: objects under a name, in a folder or in one zip file.

Nothing here keeps a file open, so objects survive fork, spawn and pickling. Those that are not on
this machine are in ``store.remote``.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import stat
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from weighttraj.atomic import linked
from weighttraj.errors import DamageError, FormatError, WeightTrajError
from weighttraj.remote.address import Place

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*(/[A-Za-z0-9_][A-Za-z0-9._-]*)*")
_LOCAL_HEADER = b"PK\x03\x04"
_PIECE_BYTES = 4 << 20

MAX_DIRECTORY = 64 << 20
"""Bytes of a zip file's directory, at most: half a million members."""

MAX_DOCUMENT_BYTES = 64 << 20
"""Bytes of a JSON document or a manifest that are read: more could fill the memory."""
MAX_NAME = 200
"""Characters between two slashes of a name: file systems take 255, drafts have longer ones."""


@runtime_checkable
class Objects(Protocol):
    """Read-only objects by name, such as ``policy/weights/c/0/0``."""

    @property
    def path(self) -> Place:
        """Folder or file that holds them."""

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """Return bytes of an object, or a range of them; a negative start counts from the end.

        Returns None if there is no such object.
        """

    def size(self, name: str) -> int | None:
        """Return bytes of an object; None: there is no such object."""

    def expect(self, names: Sequence[str]) -> None:
        """Announce what is read next, in this order, so that a remote store fetches it together."""


@runtime_checkable
class Blob(Protocol):
    """The bytes of one file that does not change."""

    @property
    def path(self) -> Place:
        """Where it is."""

    @property
    def size(self) -> int:
        """How many bytes it has."""

    def read(self, start: int, stop: int) -> bytes:
        """Return some of its bytes."""

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Announce which bytes, from start to stop, are read next, in this order."""


class FileBlob:
    """A file on this machine, opened for each reading.

    Raises:
        FileNotFoundError: there is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        status = path.stat()
        self._inode, self.size = status.st_ino, status.st_size

    def read(self, start: int, stop: int) -> bytes:
        """See ``Blob``.

        Raises:
            FormatError: another file has taken its place.
        """
        handle = os.open(self.path, os.O_RDONLY)
        try:
            if os.fstat(handle).st_ino != self._inode:
                raise replaced(self.path)
            return _read_range(handle, self.size, start, stop)
        finally:
            os.close(handle)

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """See ``Blob``; the disk is near."""


class FolderObjects:
    """Objects that are the files of a folder. Links are refused: they could lead out of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._root = os.path.realpath(path)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """See ``Objects``."""
        try:
            # A pipe in the place of a file would be waited for.
            handle = os.open(self.file(name), os.O_RDONLY | os.O_NONBLOCK)
        except (FileNotFoundError, NotADirectoryError):
            return None
        try:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode):
                return None
            return _read_range(handle, status.st_size, start, stop)
        finally:
            os.close(handle)

    def size(self, name: str) -> int | None:
        """See ``Objects``."""
        try:
            status = os.stat(self.file(name))
        except (FileNotFoundError, NotADirectoryError):
            return None
        return status.st_size if stat.S_ISREG(status.st_mode) else None

    def expect(self, names: Sequence[str]) -> None:
        """See ``Objects``; the disk is near."""

    def file(self, name: str) -> str:
        """Path of an object, which is no link."""
        path = f"{self._root}/{check_name(name, self.path)}"
        if os.path.realpath(path) != path:
            raise linked(path, os.path.realpath(path))
        return path


class ZipObjects:
    """Objects that are the members of one zip file, stored without compression.

    Args:
        blob: the file; or its path.

    Raises:
        DamageError: the file is no whole zip file.
        DamageError: a member reaches into another, or out of the file.
        FormatError: a member is compressed, encrypted, there twice or named like a path out.
    """

    def __init__(self, blob: Blob | Path) -> None:
        self._blob: Blob = FileBlob(blob) if isinstance(blob, Path) else blob
        path = self.path
        try:
            with zipfile.ZipFile(_BlobFile(self._blob)) as archive:
                members, end = archive.infolist(), archive.start_dir
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
            if isinstance(error, WeightTrajError | FileNotFoundError):
                raise
            raise DamageError(
                "the packed run is no whole zip file",
                got=error,
                where=path,
                do="restore the file from a copy, or collect the run again",
            ) from error
        self._members: dict[str, tuple[int, int]] = {}
        self._ends: dict[str, int] = {}
        self._starts: dict[str, int] = {}
        self.crc32 = {member.filename: member.CRC for member in members}
        """What the file's directory says of each object: the CRC-32 of its bytes."""
        end = self._blob.size
        for member in members:
            if not 0 <= member.header_offset <= end - 30 - member.file_size:
                raise DamageError(
                    "a member of the packed run lies outside the file",
                    expected=f"a place within {end} bytes",
                    got=f"{member.file_size} bytes at {member.header_offset}",
                    where=f"{path}, {member.filename!r}",
                    do="restore the file from a copy, or collect the run again",
                )
            name = check_name(member.filename, path)
            odd = member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 0x1
            if odd or name in self._members or member.file_size != member.compress_size:
                raise FormatError(
                    "a member of the packed run is not as the format has it",
                    expected="each name once, stored, not encrypted",
                    got=member,
                    where=path,
                    do="do not use data from a source that you do not trust",
                )
            self._members[name] = (member.header_offset, member.file_size)
        # From the last to the first: members that share bytes would be a bomb.
        for name, (offset, size) in sorted(self._members.items(), key=lambda m: m[1], reverse=True):
            self._ends[name] = end
            if not 0 <= offset <= offset + 30 + size <= end:
                raise self._misplaced(name, offset)
            end = offset

    @property
    def path(self) -> Place:
        """Where the file is."""
        return self._blob.path

    @property
    def names(self) -> list[str]:
        """Names of all objects, in the order of the file."""
        return list(self._members)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """See ``Objects``."""
        if name not in self._members:
            return None
        self.expect([name])
        first, size = self._start(name), self._members[name][1]
        start = max(0, size + start) if start < 0 else start
        stop = size if stop is None else min(stop, size)
        return self._blob.read(first + start, first + stop) if start < stop else b""

    def expect(self, names: Sequence[str]) -> None:
        """See ``Objects``."""
        known = [name for name in names if name in self._members]
        self._blob.expect([(self._members[name][0], self._ends[name]) for name in known])

    def size(self, name: str) -> int | None:
        """See ``Objects``."""
        return self._members[name][1] if name in self._members else None

    def _start(self, name: str) -> int:
        """Return where the bytes of an object begin: its own header says how long that is."""
        if name not in self._starts:
            offset, size = self._members[name]
            header = self._blob.read(offset, offset + 30)
            skip = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:], "little")
            if header[:4] != _LOCAL_HEADER or offset + 30 + skip + size > self._ends[name]:
                raise self._misplaced(name, offset)
            self._starts[name] = offset + 30 + skip
        return self._starts[name]

    def _misplaced(self, name: str, offset: int) -> DamageError:
        return DamageError(
            "a member of the packed run is not where the directory says",
            expected=f"a local header at byte {offset}, and bytes of its own after it",
            where=f"{self.path}, {name}",
            do="restore the file from a copy, or collect the run again",
        )


class _BlobFile(io.RawIOBase):
    """A blob as the file that Python's ``zipfile`` reads the directory from."""

    def __init__(self, blob: Blob) -> None:
        self._blob, self._at = blob, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._blob.size}[whence]
        if base + offset < 0:
            raise OSError("before the first byte")  # as files say it: zipfile asks for it
        self._at = base + offset
        return self._at

    def read(self, count: int = -1) -> bytes:
        stop = self._blob.size if count < 0 else min(self._at + count, self._blob.size)
        if stop - self._at > MAX_DIRECTORY:
            raise OSError(f"its directory has more than {MAX_DIRECTORY} bytes")
        content = self._blob.read(self._at, stop) if self._at < stop else b""
        self._at += len(content)
        return content


def read_document(objects: Objects, name: str, limit: int = MAX_DOCUMENT_BYTES) -> bytes | None:
    """Return an object that must not be large, such as metadata; None: there is none.

    Raises:
        FormatError: it has more bytes than the limit. So much is read, and no more.
    """
    content = objects.read(name, 0, limit + 1)
    return None if content is None else check_size(content, f"{objects.path}, {name}", limit)


def check_size(content: bytes, where: object, limit: int = MAX_DOCUMENT_BYTES) -> bytes:
    """Return metadata that readers accept.

    Raises:
        FormatError: they have more bytes than the limit.
    """
    if len(content) > limit:
        raise FormatError(
            "refused: the metadata is too large",
            expected=f"at most {limit:,} bytes",
            got="more",
            where=where,
            do="do not use data from a source that you do not trust; "
            "data of your own is to be divided into more runs or data sets",
        )
    return content


def bytes_in(path: Path) -> int:
    """Return the bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)


@contextlib.contextmanager
def fitting_memory(where: object) -> Iterator[None]:
    """Make room for a selection of an array inside.

    Raises:
        FormatError: there is not enough memory.
    """
    try:
        yield
    except MemoryError as error:
        raise FormatError(
            "this selection does not fit into memory",
            got=error,
            where=where,
            do="read fewer rows at a time",
        ) from error


def replaced(where: object) -> FormatError:
    """Return the error for a packed run that is not the one any more that was opened."""
    return FormatError(
        "the packed run was replaced after it was opened",
        where=where,
        do="open it again",
    )


def check_name(name: str, where: object) -> str:
    """Return the name of an object; it cannot lead out of its folder.

    Raises:
        FormatError: it is empty, absolute, too long, has ``..`` or unusual characters.
    """
    parts = name.split("/")
    if _NAME.fullmatch(name) is None or ".." in name or max(map(len, parts)) > MAX_NAME:
        raise FormatError(
            "refused: the name of an object could lead out of its folder",
            expected="letters, digits, '.', '_', '-', and '/' between them",
            got=repr(name),
            where=where,
            do="do not use data from a source that you do not trust",
        )
    return name


def write_zip(path: Path, members: Iterable[tuple[str, Path | ZipObjects]]) -> None:
    """Write files into a zip file: stored, without times, so equal content gives equal bytes.

    Args:
        path: the zip file.
        members: names, each with a file, or with a zip file that has a member of this name.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, source in members:
            info = zipfile.ZipInfo(name)  # 1980-01-01
            # Zip files write it first: it says whether the sizes need 64 bits.
            if isinstance(source, ZipObjects):
                info.file_size = source.size(name) or 0
            else:
                info.file_size = source.stat().st_size
            with archive.open(info, "w") as writer:
                for piece in _pieces(name, source):
                    writer.write(piece)


def _pieces(name: str, source: Path | ZipObjects) -> Iterator[bytes]:
    """Yield the bytes of a file or member, some at a time."""
    if isinstance(source, ZipObjects):
        for start in range(0, source.size(name) or 0, _PIECE_BYTES):
            yield source.read(name, start, start + _PIECE_BYTES) or b""
        return
    with source.open("rb") as reader:
        while piece := reader.read(_PIECE_BYTES):
            yield piece


def read_plain(path: Path, limit: int) -> bytes:
    """Return the bytes of a file that a stranger may have put there.

    Raises:
        FormatError: it is a link, no plain file, has more bytes than the limit, or cannot be read.
    """
    try:
        # A pipe in the place of a file would be waited for.
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            status = os.fstat(handle)
            if stat.S_ISREG(status.st_mode) and status.st_size <= limit:
                return _read_range(handle, status.st_size, 0, limit)
        finally:
            os.close(handle)
        got: object = "another kind of file, or a larger one"
    except OSError as error:
        got = "a link" if path.is_symlink() else error
    raise FormatError(
        "refused to read a file",
        expected=f"a plain file of at most {limit} bytes, and no link: that could lead anywhere",
        got=got,
        where=path,
        do="if it is yours, put the file itself in its place",
    )


def _read_range(handle: int, size: int, start: int, stop: int | None) -> bytes:
    if start < 0:
        start = max(0, size + start)
    stop = size if stop is None else min(stop, size)
    pieces, at = [], start
    while at < stop:  # one call reads at most 2 GiB
        piece = os.pread(handle, stop - at, at)
        if not piece:
            break
        pieces.append(piece)
        at += len(piece)
    return b"".join(pieces)


def packed_order(name: str) -> tuple[bool, bool, str]:
    """Sort key of the objects of a packed run: the metadata first, then the chunks by name."""
    return name != "zarr.json", not name.endswith("zarr.json"), name
