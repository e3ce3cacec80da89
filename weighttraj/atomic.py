"""Files and folders that appear under their names whole, or not at all.

Whoever hands over a data set can put links into it. So nothing below a ``root`` is written through
a link: every folder on the way is opened by its own name, and the file is made in the folder that
was opened. Drafts have random names and are created exclusively, so no link can wait for them.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from filelock import FileLock, Timeout

from weighttraj.errors import FormatError, StoreExistsError, StoreLockedError
from weighttraj.remote.address import new_path

DRAFT = ".draft"
"""Ending of files and folders that are not whole yet; their names begin with a dot."""

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_ADD = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_LINKED = (errno.ELOOP, errno.ENOTDIR, errno.EMLINK)  # what systems say of O_NOFOLLOW and a link


@contextlib.contextmanager
def replacing(path: Path, *, root: Path | None = None, durable: bool = True) -> Iterator[BinaryIO]:
    """Open a new file that takes the place of ``path`` when the block ends.

    Readers see the old content or the new one. If the block fails, the new file is removed; if the
    process is killed, by the next one that writes the same path.

    Args:
        path: the file. Folders below ``root`` are made.
        root: folder of data that may be a stranger's: no part of the path below it may be a link.
            None: the path is the user's own choice.
        durable: the new content survives a power cut.

    Raises:
        FormatError: a part of the path below ``root`` is a link.
    """
    with _parent_of(path, root) as folder:
        _remove_abandoned_files(path.name, folder)
        draft, number = _locked_draft(path.name, folder)
        try:
            with os.fdopen(number, "wb") as file:
                yield file
                file.flush()
                if durable:
                    os.fsync(file.fileno())
            os.replace(draft, path.name, src_dir_fd=folder, dst_dir_fd=folder)
        except BaseException as error:
            with contextlib.suppress(OSError):
                os.unlink(draft, dir_fd=folder)
            if isinstance(error, IsADirectoryError):
                raise _misplaced(path, "a folder") from error
            if isinstance(error, OSError) and error.errno and error.filename in (None, draft):
                error.filename = str(path)  # a full disk does not say where
            raise
        if durable:
            os.fsync(folder)


def _locked_draft(name: str, folder: int) -> tuple[str, int]:
    """Make a draft of a file in an opened folder; return its name and its file descriptor.

    The lock on it tells others that its writer is alive.
    """
    while True:
        draft = f".{name}.{secrets.token_hex(8)}{DRAFT}"
        number = os.open(draft, _NEW, 0o666, dir_fd=folder)
        fcntl.flock(number, fcntl.LOCK_EX)
        if os.fstat(number).st_nlink:  # else it was removed between the two lines above
            return draft, number
        os.close(number)


def _remove_abandoned_files(name: str, folder: int) -> None:
    """Remove the drafts of a file whose writers were killed: nobody holds their locks."""
    drafts = (f for f in os.listdir(folder) if f.startswith(f".{name}.") and f.endswith(DRAFT))
    for draft in drafts:
        with contextlib.suppress(OSError):  # it is locked, gone, or no file
            number = os.open(draft, _READ, dir_fd=folder)
            try:
                if stat.S_ISREG(os.fstat(number).st_mode):
                    fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(draft, dir_fd=folder)
            finally:
                os.close(number)


def replace_file(
    path: Path, content: bytes, *, root: Path | None = None, durable: bool = True
) -> None:
    """Write a file at once; the arguments and errors are those of ``replacing``."""
    with replacing(path, root=root, durable=durable) as file:
        file.write(content)


@contextlib.contextmanager
def appending(path: Path, *, root: Path) -> Iterator[BinaryIO]:
    """Open a file of a data set, new or old, to add to its end; it survives a power cut.

    Raises:
        FormatError: a part of the path below ``root`` is a link, or the file has another name, too,
            or is no plain file.
    """
    with _parent_of(path, root) as folder:
        try:
            number = os.open(path.name, _ADD, 0o666, dir_fd=folder)
        except OSError as error:
            if error.errno != errno.ENXIO:  # a pipe that nobody reads
                raise
            raise _misplaced(path, "a pipe") from error
        with os.fdopen(number, "ab") as file:
            status = os.fstat(number)
            if not stat.S_ISREG(status.st_mode):
                raise _misplaced(path, "no plain file")
            if status.st_nlink > 1:  # what is added would be added to another's file
                raise _misplaced(path, "a file that has another name elsewhere")
            yield file
            file.flush()
            os.fsync(file.fileno())


@contextlib.contextmanager
def drafting(target: Path) -> Iterator[Path]:
    """Make a folder beside a path, for what is to get the path's name. It is removed at the end.

    Folders for the same path that killed processes left are removed first.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(target)
    name = tempfile.mkdtemp(prefix=f".{target.name}.", suffix=DRAFT, dir=target.parent)
    try:
        with FileLock(Path(name) / "lock"):
            yield Path(name)
    finally:
        shutil.rmtree(name, ignore_errors=True)


def remove_abandoned(target: Path) -> None:
    """Remove the folders that ``drafting`` made for a path in processes that were killed."""
    for old in target.parent.glob(f".{glob.escape(target.name)}.*{DRAFT}"):
        lock = old / "lock"
        if old.is_symlink() or lock.is_symlink():
            continue  # a link is nobody's draft: what it leads to is not ours to lock or to remove
        if lock.is_file():
            with contextlib.suppress(Timeout), FileLock(lock, timeout=0):
                shutil.rmtree(old)
        else:  # killed before it took its lock, when the folder is still empty
            with contextlib.suppress(OSError):
                old.rmdir()


@contextlib.contextmanager
def appearing(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield a path at which a new file or folder is to be made; it then moves to ``path``.

    Whatever stops the process, there is nothing new at the path, or all of it. The folder of the
    yielded path has room for other drafts.

    Args:
        path: the file or folder.
        replace: replace a file that is there; else the path must be a new one.

    Raises:
        StoreExistsError: the path exists, and is not to be replaced.
    """
    if not replace:
        refuse_existing(path)
    with drafting(path) as folder:
        draft = folder / path.name
        yield draft
        for file in (draft, *draft.rglob("*")):
            sync(file)
        if not replace:
            refuse_existing(path)
        draft.replace(path)
    sync(path.parent)


def lock_of(path: Path) -> FileLock:
    """Return the lock of a file, not yet acquired.

    Raises:
        FormatError: the file is a link, or a folder.
    """
    if path.is_symlink():
        raise linked(path, os.readlink(path))
    if path.is_dir():
        raise _misplaced(path, "a folder")
    return FileLock(path)


def acquired(lock: FileLock, what: str, *, where: object, do: str) -> FileLock:
    """Return a lock that is held now.

    Raises:
        StoreLockedError: another process holds it; the other arguments say so.
    """
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise StoreLockedError(what, where=where, do=do) from error
    return lock


def refuse_existing(path: Path, do: str = "choose another path, or delete it") -> None:
    """Refuse to overwrite anything.

    Raises:
        StoreExistsError: the path exists.
        RegistryError: it is an address.
    """
    if new_path(path).exists() or path.is_symlink():
        raise StoreExistsError(
            "the path to be written exists",
            expected="a new path",
            got="a link" if path.is_symlink() else "a folder" if path.is_dir() else "a file",
            where=path,
            do=do,
        )


def refuse_link(path: Path, root: Path) -> Path:
    """Return a path below ``root``; no part of it below ``root`` is a link.

    Raises:
        FormatError: a part is a link, or the path leads out of ``root``.
    """
    real = os.path.join(os.path.realpath(root), path.relative_to(root))
    if os.path.realpath(real) != real:
        raise linked(path, os.path.realpath(real))
    return path


def links_in(folder: Path) -> Iterator[str]:
    """Yield a problem for each link in a folder; links are not followed."""
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(place, name)
            if os.path.islink(path):
                yield f"{path}: a link to {os.readlink(path)}; the data must be plain files"


def linked(path: object, target: object = "somewhere else") -> FormatError:
    """The error for a link where a plain file or folder must be."""
    return FormatError(
        "a file of the data is a link",
        expected="plain files: a link could lead anywhere",
        got=f"{path} -> {target}",
        where=path,
        do="do not use data from a source that you do not trust; "
        "if the link is yours, put the file in its place",
    )


def sync(path: Path) -> None:
    """See a file or folder on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def _parent_of(path: Path, root: Path | None) -> Iterator[int]:
    """Open the folder of a file; folders below ``root`` are made, and none of them is a link."""
    base = path.parent if root is None else root
    handle = os.open(base, _FOLDER)
    try:
        for part in path.parent.relative_to(base).parts:
            with contextlib.suppress(FileExistsError):
                os.mkdir(part, dir_fd=handle)
            inner = _inner(part, handle, path)
            os.close(handle)
            handle = inner
        if root is not None and _is_link(path.name, handle):
            raise linked(path)
        yield handle
    finally:
        os.close(handle)


def _inner(part: str, folder: int, path: Path) -> int:
    """Open a folder in a folder.

    Raises:
        FormatError: it is a link, or no folder.
    """
    try:
        return os.open(part, _FOLDER | os.O_NOFOLLOW, dir_fd=folder)
    except OSError as error:
        if error.errno not in _LINKED:
            raise
        raise (
            linked(path) if _is_link(part, folder) else _misplaced(path, f"the file {part}")
        ) from error


def _misplaced(path: Path, got: str) -> FormatError:
    return FormatError(
        "a file of the data cannot be written where it belongs",
        expected="a file in a folder",
        got=got,
        where=path,
        do="move away what is there",
    )


def _is_link(name: str, folder: int) -> bool:
    try:
        return stat.S_ISLNK(os.stat(name, dir_fd=folder, follow_symlinks=False).st_mode)
    except FileNotFoundError:
        return False
