"""Reads and writes objects at an address: S3 and its kin, HTTP, the hub, a folder elsewhere.

``obstore`` does the work: requests, signatures, retries with growing pauses on 429, 5xx and broken
connections. Here its errors become ours, and a fork is noticed before it would hang.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from weighttraj.errors import RemoteError, missing_extra
from weighttraj.remote.address import RemotePath

if TYPE_CHECKING:
    from obstore.store import ObjectStore

TIMEOUT = "WEIGHTTRAJ_REMOTE_TIMEOUT"
"""Environment variable: seconds after which a request is not tried again. Default: 60."""
BROKEN = 4
"""Times that an answer is asked for again which broke off in the middle."""

_REFUSED = re.compile(r"(?s)status code: (400|416|501)(?!.*RequestTimeout)")
"""Answers that stay the same, however often is asked; S3 also says 400 where it waited too long."""
_CAUSE = re.compile(r'message: "([^"]+)"|kind: (\w+),?\s*}')
_process: list[int] = []
T = TypeVar("T")


@dataclass(frozen=True)
class Piece:
    """Some bytes of an object."""

    content: bytes
    start: int
    """Where in the object they begin."""
    size: int
    """Bytes of the whole object."""
    tag: str | None
    """The server's mark of these very bytes; another one: it was replaced."""


class BrokenOffError(RemoteError):
    """An answer ended in the middle; what came is good."""


class NoPartsError(RemoteError):
    """The server sends whole objects only."""


class RefusedError(RemoteError):
    """The server answers, but not what it was asked."""


class RemoteStore:
    """Objects below one address.

    Args:
        root: address, as in ``RemotePath.root``.
    """

    def __init__(self, root: str) -> None:
        self.root = root
        self._client = _client(root)

    def read(self, name: str) -> Piece | None:
        """A whole object; None: there is none."""
        return self._get(name, None)

    def read_range(self, name: str, start: int, stop: int) -> Piece | None:
        """Bytes from start to stop (exclusive); None: there is no such object.

        Raises:
            NoPartsError: the server sends whole objects only.
        """
        return self._get(name, (start, stop))

    def read_tail(self, name: str, count: int) -> Piece | None:
        """The last bytes of an object, all of a smaller one; None: there is no such object."""
        try:
            return self._get(name, {"suffix": count})
        except (NoPartsError, RefusedError):
            # Some servers send ranges, but not from the end; of Azure it is not even asked.
            size = self.size(name)
            if size is None:
                raise
            return self._get(name, (max(0, size - count), size))

    def size(self, name: str) -> int | None:
        """Bytes of an object; None: there is none."""
        there = self.stat(name)
        return None if there is None else there[0]

    def stat(self, name: str) -> tuple[int, datetime] | None:
        """Bytes of an object, and when it was written; None: there is none."""
        import obstore

        try:
            there = self._told(name, lambda: obstore.head(self._client, name))
        except FileNotFoundError:
            return None
        return there["size"], there["last_modified"]

    def pieces(self, name: str, start: int = 0) -> Iterator[bytes]:
        """An object from a byte on, some bytes at a time, as they arrive.

        Raises:
            BrokenOffError: it can be gone on from where it ended.
            NoPartsError: the server does not begin in the middle.
            FileNotFoundError: there is no such object.
        """
        import obstore

        def begin() -> Any:
            options: Any = {"range": {"offset": start}} if start else {}
            return obstore.get(self._client, name, options=options)

        stream = iter(self._told(name, begin).stream(min_chunk_size=4 << 20))
        while (piece := self._told(name, lambda: next(stream, None), again=False)) is not None:
            yield bytes(piece)

    def write(self, name: str, content: bytes | Path, *, new: bool = False) -> bool:
        """Write an object, seen by others when it is whole.

        Args:
            name: of the object.
            content: bytes, or a file.
            new: write only if there is none of this name.

        Returns:
            Whether it was written: not if it had to be new and was there.
        """
        import obstore

        mode: Any = "create" if new else "overwrite"

        def put() -> None:
            if isinstance(content, bytes):
                obstore.put(self._client, name, content, mode=mode)
                return
            with content.open("rb") as file:
                # Objects that are put in parts cannot be put only if they are new.
                obstore.put(self._client, name, file, mode=mode, use_multipart=not new)

        try:
            self._told(name, put)
        except FileExistsError:
            return False
        return True

    def delete(self, name: str) -> None:
        """Remove an object, if it is there."""
        import obstore

        with contextlib.suppress(FileNotFoundError):
            self._told(name, lambda: obstore.delete(self._client, name))

    def _get(self, name: str, span: Any) -> Piece | None:
        import obstore

        def get() -> Piece:
            options: Any = {} if span is None else {"range": span}
            result = obstore.get(self._client, name, options=options)
            content = bytes(result.bytes())
            if len(content) != result.range[1] - result.range[0]:
                raise RemoteError(
                    "the answer is not as long as it says",
                    expected=f"{result.range[1] - result.range[0]} bytes",
                    got=len(content),
                    where=self._where(name),
                    do="try again; the object may be damaged",
                )
            meta = result.meta
            return Piece(content, result.range[0], meta["size"], meta["e_tag"])

        try:
            return self._told(name, get)
        except FileNotFoundError:
            return None

    def _told(self, name: str, do: Callable[[], T], *, again: bool = True) -> T:
        """Do something; broken answers are asked for again, other errors become ours.

        Raises:
            FileNotFoundError: there is no such object.
            FileExistsError: there is one.
        """
        from obstore import exceptions

        _refuse_fork()
        for attempt in range(BROKEN + 1):
            try:
                return do()
            except exceptions.GenericError as error:
                if not again:
                    raise BrokenOffError(str(self._error(name, error))) from None
                final = " retries, " in str(error) or _REFUSED.search(str(error))
                if final or attempt == BROKEN:
                    raise self._error(name, error) from None
                time.sleep(0.1 * 2**attempt)
            except exceptions.AlreadyExistsError as error:
                raise FileExistsError(name) from error
            except (exceptions.BaseError, OSError) as error:
                if isinstance(error, FileNotFoundError | RemoteError):
                    raise
                raise self._error(name, error) from None
        raise AssertionError("not reached")

    def _error(self, name: str, error: Exception) -> RemoteError:
        """What happened, in a line, and what to do about it."""
        from obstore import exceptions

        text, _, details = str(error).partition("\n\nDebug source")
        causes = [first or second for first, second in _CAUSE.findall(details)]
        got = " ".join(text.split())[:400] + (f" ({causes[-1]})" if causes else "")
        do = f"see whether the server can be reached, and try again; {TIMEOUT} says how long"
        what = "a remote object cannot be reached"
        kind = RefusedError if _REFUSED.search(text) else RemoteError
        if isinstance(error, exceptions.NotSupportedError):
            what, kind = "the server cannot send parts of an object", NoPartsError
            do = f"weighttraj download {self.root}, and open what lies here then"
        elif isinstance(
            error, exceptions.PermissionDeniedError | exceptions.UnauthenticatedError
        ) or any(word in got for word in ("169.254.169.254", "credential")):
            what = "the server does not let us"
            do = _CREDENTIALS.get(self.root.partition("://")[0], "give the server your credentials")
        return kind(what, got=got, where=self._where(name), do=do)

    def _where(self, name: str) -> str:
        return str(RemotePath(self.root, name))

    def __reduce__(self) -> tuple[Any, ...]:
        return store_at, (self.root,)


_CREDENTIALS = {
    "hf": "hf auth login, or set HF_TOKEN; ask for access if the repository is gated",
    "s3": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; for a public bucket "
    "AWS_SKIP_SIGNATURE=true",
    "gs": "set GOOGLE_APPLICATION_CREDENTIALS; for a public bucket GOOGLE_SKIP_SIGNATURE=true",
    "az": "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY; for a public container "
    "AZURE_SKIP_SIGNATURE=true",
}


@functools.lru_cache(maxsize=64)
def store_at(root: str) -> RemoteStore:
    """The store of an address, one for each in a process: its connections are used again."""
    return RemoteStore(root)


def _patience() -> timedelta:
    """For how long a server that does not answer is asked again."""
    told = os.environ.get(TIMEOUT, "60")
    with contextlib.suppress(ValueError, OverflowError):  # no number; not finite, or too many
        if (patience := timedelta(seconds=float(told))) >= timedelta():
            return patience
    raise RemoteError(
        "this is no time to wait for a server",
        expected="seconds, 0 or more",
        got=told,
        where=f"environment variable {TIMEOUT}",
        do="set it to a number, or unset it",
    )


def _client(root: str) -> ObjectStore:
    try:
        from obstore.store import HTTPStore, from_url
    except ModuleNotFoundError as error:
        raise missing_extra("obstore", "remote") from error
    options: Any = {
        "connect_timeout": timedelta(seconds=10),
        "read_timeout": timedelta(seconds=30),  # between two pieces of an answer
        "timeout": timedelta(hours=12),  # of a whole answer, which may be a large file
        "allow_http": not root.startswith("https:"),  # a bucket's endpoint is the user's choice
    }
    retries: Any = {
        "max_retries": 100,
        "retry_timeout": _patience(),
        "backoff": {
            "init_backoff": timedelta(milliseconds=100),
            "max_backoff": timedelta(seconds=5),
            "base": 2,
        },
    }
    scheme = root.partition("://")[0]
    url = root
    if scheme == "hf":
        from weighttraj.remote.hub import headers, resolve_url

        url, options["default_headers"] = resolve_url(root), headers()
    try:
        if scheme == "file":
            if not Path(url.removeprefix("file://")).is_dir():
                raise FileNotFoundError(f"no folder at {root}")
            return from_url(url)
        if scheme in ("hf", "http", "https"):
            return HTTPStore.from_url(url, client_options=options, retry_config=retries)
        return from_url(url, client_options=options, retry_config=retries)
    except Exception as error:  # obstore's, of addresses and settings: each kind has its own
        if isinstance(error, FileNotFoundError):
            raise
        raise RemoteError(
            "this address cannot be used",
            got=" ".join(str(error).split())[:400],
            where=root,
            do="correct the address, or the environment variables that say how to reach it",
        ) from error


def _refuse_fork() -> None:
    """A forked process has no threads to wait for answers with: it would wait for ever."""
    if not _process:
        _process.append(os.getpid())
    if _process[0] != os.getpid():
        raise RemoteError(
            "remote data cannot be read in a forked process",
            expected=f"process {_process[0]}, which read remote data first, or a spawned one",
            got=f"process {os.getpid()}",
            do="start processes with multiprocessing_context='spawn', or download the data set",
        )


__all__ = ["TIMEOUT", "BrokenOffError", "NoPartsError", "Piece", "RemoteStore", "store_at"]
