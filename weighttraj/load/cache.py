"""Decoded weights of a run, mapped from one ``.npy`` file that all processes share.

Random windows of compressed chunks would decode a chunk for each window. A run is decoded once
instead, into a plain file; what its pages hold is then the system's business, so that a run may be
larger than memory.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

import numpy as np
from filelock import FileLock
from jaxtyping import Float32

from weighttraj.atomic import DRAFT, replacing
from weighttraj.errors import CacheError, WeightTrajError
from weighttraj.run import Run

VARIABLE = "WEIGHTTRAJ_CACHE"
"""Environment variable that names the cache's folder."""

_ENTRY = re.compile(r"([0-9a-f])[0-9a-f]{63}\.npy")
_DRAFT = re.compile(r"\.([0-9a-f])[0-9a-f]{63}(?:\.npy)?\.[0-9a-f]{16}\.draft")
_DIGITS = "0123456789abcdef"


class CachedWeights:
    """The weights of one run in the cache.

    Holds no map and no data, so it is pickled as what it is: a run, and the name of a file.

    Args:
        run: the run. Its committed snapshots are those of the moment it was opened: a run that
            has grown since has another key, once it is opened again.
    """

    def __init__(self, run: Run) -> None:
        self.run = run

    @property
    def shape(self) -> tuple[int, int]:
        """Snapshots and parameters."""
        return len(self.run), self.run.layout.size

    @cached_property
    def key(self) -> str:
        """SHA-256 (hex) of the shape and of every snapshot's digest: equal keys, equal weights.

        Raises:
            DamageError: the run's digests are damaged.
        """
        digest = hashlib.sha256(f"float32 {self.shape}".encode())
        digest.update(self.run["digest"][:].tobytes())
        return digest.hexdigest()

    @property
    def path(self) -> Path:
        """Where the entry is, or will be."""
        return cache_folder() / f"{self.key}.npy"

    def map(self) -> Float32[np.ndarray, "time param"]:
        """Return a read-only map of the weights, decoded first if no process has done so.

        Raises:
            CacheError: the cache's folder cannot be used, or is full.
            DamageError: the run is damaged; nothing of it is kept.
        """
        path = self.path
        rows = _mapped(path, self.shape)
        if rows is None:
            with _told(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True)
            with _locked(path.parent, self.key[0]):
                rows = _mapped(path, self.shape)  # another process may have been quicker
                if rows is None:
                    self._make(path)
                    rows = np.load(path, mmap_mode="r")
        return rows.view(np.ndarray)  # memmap's own slices are slow

    def _make(self, path: Path) -> None:
        """Decode the run into a draft, see it on the disk, and rename it; the lock is held."""
        with _told(path.parent):
            for old in path.parent.glob(f".{self.key}.*{DRAFT}"):  # of a process that was killed
                old.unlink()
            with replacing(path) as file:
                for piece in self._pieces():
                    file.write(piece)

    def _pieces(self) -> Iterator[memoryview]:
        """The bytes of the entry; rows are read from the run, and so checked, piece by piece."""
        yield memoryview(_header(self.shape))
        for _, rows in self.run.weights.pieces():
            yield np.ascontiguousarray(rows, "<f4").reshape(-1).view(np.uint8).data

    def __repr__(self) -> str:
        return f"<CachedWeights of {self.run.id}: time {self.shape[0]}, param {self.shape[1]}>"


def cache_folder() -> Path:
    """Folder of the cache: ``WEIGHTTRAJ_CACHE``, else ``weighttraj`` in the user's cache folder.

    Raises:
        CacheError: the variable is not set, and the user has no home.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named).expanduser().absolute()
    base = os.environ.get("XDG_CACHE_HOME", "")
    if Path(base).is_absolute():  # others are to be ignored, says the XDG specification
        return Path(base, "weighttraj")
    try:
        return Path.home() / ".cache/weighttraj"
    except RuntimeError as error:
        raise CacheError(
            "there is no home folder to keep decoded runs in",
            got=error,
            do=f"set {VARIABLE} to a folder",
        ) from error


def cache_size() -> int:
    """Return bytes in the cache, with what killed processes left there."""
    folder = cache_folder()
    with _told(folder):
        return sum(size for digit in _DIGITS for _, size in _files(folder, digit))


def clear_cache() -> int:
    """Empty the cache, and return the bytes that were in it.

    Waits for entries that are being made. Processes that read an entry go on reading it, and the
    disk has its space back when the last of them ends.

    Raises:
        CacheError: a file cannot be removed.
    """
    folder, freed = cache_folder(), 0
    for digit in _DIGITS if folder.is_dir() else "":
        with _locked(folder, digit), _told(folder):
            for file, size in _files(folder, digit):
                file.unlink(missing_ok=True)
                freed += size
    return freed


def _files(folder: Path, digit: str) -> list[tuple[Path, int]]:
    """Entries and drafts whose key begins with a digit, and their bytes; no file of others."""
    found = []
    for file in folder.iterdir() if folder.is_dir() else ():
        name = _ENTRY.fullmatch(file.name) or _DRAFT.fullmatch(file.name)
        if name is not None and name[1] == digit:
            try:
                found.append((file, file.stat().st_size))
            except FileNotFoundError:  # a draft that was renamed this moment
                continue
    return found


@contextmanager
def _locked(folder: Path, digit: str) -> Iterator[None]:
    """One of 16 locks. Their files stay: to delete one would give the next process another."""
    lock = FileLock(folder / f".{digit}.lock")
    with _told(folder):
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _mapped(path: Path, shape: tuple[int, int]) -> np.ndarray | None:
    """Return the map of a whole entry; None: there is none, or it is not what its name says."""
    header = _header(shape)
    with _told(path.parent):
        try:
            with path.open("rb") as file:
                whole = file.read(len(header)) == header
                size = os.fstat(file.fileno()).st_size
            if whole and size == len(header) + 4 * shape[0] * shape[1]:
                rows: np.ndarray = np.load(path, mmap_mode="r")
                return rows
        except FileNotFoundError:
            pass
    return None


def _header(shape: tuple[int, int]) -> bytes:
    text = io.BytesIO()
    fields = {"descr": "<f4", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(text, fields)
    return text.getvalue()


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """Turn errors of the cache's own files into one that says how to move it."""
    try:
        yield
    except OSError as error:
        if isinstance(error, WeightTrajError):  # of the run that is read meanwhile
            raise
        raise CacheError(
            "decoded runs cannot be kept in the cache",
            expected="a folder that can be written, on a disk with space",
            got=error,
            where=folder,
            do=f"set {VARIABLE} to a folder on another disk, or free space: "
            "weighttraj.load.clear_cache()",
        ) from error
