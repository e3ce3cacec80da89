"""Where the bytes of a run are: objects under a name, in a folder or in one zip file.

Nothing here keeps a file open, so objects survive fork, spawn and pickling.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol, runtime_checkable

from weighttraj.errors import DamageError, FormatError

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*(/[A-Za-z0-9_][A-Za-z0-9._-]*)*")
_LOCAL_HEADER = b"PK\x03\x04"


@runtime_checkable
class Objects(Protocol):
    """Read-only objects by name, such as ``policy/weights/c/0/0``."""

    path: Path
    """Folder or file that holds them."""

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """Bytes of an object, or a range of them; a negative start counts from the end.

        Returns None if there is no such object.
        """

    def exists(self, name: str) -> bool:
        """Whether there is such an object."""


class FolderObjects:
    """Objects that are the files of a folder. Links are refused: they could lead out of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._root = os.path.realpath(path)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """See ``Objects``."""
        try:
            handle = os.open(self._checked(name), os.O_RDONLY)
        except (FileNotFoundError, NotADirectoryError):
            return None
        try:
            return _read_range(handle, 0, os.fstat(handle).st_size, start, stop)
        finally:
            os.close(handle)

    def exists(self, name: str) -> bool:
        """See ``Objects``."""
        return os.path.isfile(self._checked(name))

    def _checked(self, name: str) -> str:
        path = f"{self._root}/{check_name(name, self.path)}"
        if os.path.realpath(path) != path:
            raise FormatError(
                "a file of the run is a link",
                expected="plain files: a link could lead anywhere",
                got=f"{path} -> {os.path.realpath(path)}",
                where=self.path,
                do="do not use data from a source that you do not trust; "
                "if the link is yours, put the file in its place",
            )
        return path


class ZipObjects:
    """Objects that are the members of one zip file, stored without compression.

    Raises:
        DamageError: the file is no whole zip file.
        FormatError: a member is compressed, encrypted, there twice or named like a path out.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                members = archive.infolist()
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
            if isinstance(error, FileNotFoundError):
                raise
            raise DamageError(
                "the packed run is no whole zip file",
                got=error,
                where=path,
                do="restore the file from a copy, or collect the run again",
            ) from error
        self._members: dict[str, tuple[int, int]] = {}
        for member in members:
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

    @property
    def names(self) -> list[str]:
        """Names of all objects, in the order of the file."""
        return list(self._members)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes | None:
        """See ``Objects``."""
        if name not in self._members:
            return None
        offset, size = self._members[name]
        handle = os.open(self.path, os.O_RDONLY)
        try:
            header = os.pread(handle, 30, offset)
            if header[:4] != _LOCAL_HEADER or len(header) < 30:
                raise DamageError(
                    "a member of the packed run is not where the directory says",
                    expected=f"a local header at byte {offset}",
                    got=header[:4],
                    where=f"{self.path}, {name}",
                    do="restore the file from a copy, or collect the run again",
                )
            skip = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:], "little")
            return _read_range(handle, offset + 30 + skip, size, start, stop)
        finally:
            os.close(handle)

    def exists(self, name: str) -> bool:
        """See ``Objects``."""
        return name in self._members


def check_name(name: str, where: object) -> str:
    """Return the name of an object; it cannot lead out of its folder.

    Raises:
        FormatError: it is empty, absolute, has ``..`` or unusual characters.
    """
    if _NAME.fullmatch(name) is None or ".." in name:
        raise FormatError(
            "refused: the name of an object could lead out of its folder",
            expected="letters, digits, '.', '_', '-', and '/' between them",
            got=repr(name),
            where=where,
            do="do not use data from a source that you do not trust",
        )
    return name


def write_zip(path: Path, members: Iterable[tuple[str, Path]]) -> None:
    """Write files into a zip file: stored, without times, so equal content gives equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, source in members:
            info = zipfile.ZipInfo(name)  # 1980-01-01
            info.file_size = source.stat().st_size
            with source.open("rb") as reader, archive.open(info, "w") as writer:
                while piece := reader.read(1 << 22):
                    writer.write(piece)


def _read_range(handle: int, offset: int, size: int, start: int, stop: int | None) -> bytes:
    if start < 0:
        start = max(0, size + start)
    stop = size if stop is None else min(stop, size)
    pieces, at = [], start
    while at < stop:  # one call reads at most 2 GiB
        piece = os.pread(handle, stop - at, offset + at)
        if not piece:
            break
        pieces.append(piece)
        at += len(piece)
    return b"".join(pieces)
