"""Reads and writes objects at an address: S3 and similar stores, HTTP, the hub, a folder elsewhere.

``obstore`` does the work: requests, signatures, retries with growing pauses on 429, 5xx and broken
connections. Here answers get a largest size and a longest time (``wait``), and errors of the client
become ours (``failures``).
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from weighttraj.errors import RemoteError, needs
from weighttraj.remote.address import BUCKETS, Root
from weighttraj.remote.failures import (
    BrokenOffError,
    NoPartsError,
    RefusedError,
    failure,
    is_final,
    no_bucket,
    too_large,
    unusable,
)
from weighttraj.remote.wait import patience, result, too_slow

if TYPE_CHECKING:
    from obstore.store import ObjectStore

BROKEN = 4
"""Times that an answer is asked for again which broke off in the middle."""
MAX_DOCUMENT = 64 << 20
"""Bytes of a manifest, a list of runs or metadata, at most: half a million files."""
MAX_OBJECT = 1 << 30
"""Bytes of an object that is read whole, at most."""
STEP_BYTES = 1 << 16
"""Bytes of a large answer that must come within ``patience()`` seconds."""

T = TypeVar("T")
Clock = Callable[[], None]


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


class RemoteStore:
    """Objects below one address.

    Args:
        root: the decoded parts of the address.
    """

    def __init__(self, root: Root) -> None:
        self.root = root
        self._client = _client(root)

    def read(self, name: str, limit: int = MAX_DOCUMENT) -> Piece | None:
        """Return a whole object, which must come in ``patience()`` seconds; None: there is none.

        Raises:
            RemoteError: it has more bytes than the limit, or cannot be reached in time.
        """
        return self._get(name, None, limit, large=False)

    def read_large(self, name: str, limit: int = MAX_OBJECT) -> Piece | None:
        """Return a whole object, which may take as long as its bytes come; None: there is none."""
        return self._get(name, None, limit, large=True)

    def read_range(self, name: str, start: int, stop: int) -> Piece | None:
        """Return bytes from start to stop (exclusive); None: there is no such object.

        Raises:
            NoPartsError: the server sends whole objects only.
        """
        return self._get(name, (start, stop), stop - start, large=True)

    def read_tail(self, name: str, count: int) -> Piece | None:
        """Return the last bytes of an object, all of a smaller one; None: there is no such one."""
        try:
            return self._get(name, {"suffix": count}, count, large=False)
        except (NoPartsError, RefusedError):
            # Some servers send ranges, but not from the end; Azure is not even asked.
            size = self.size(name)
            if size is None:
                raise
            return self._get(name, (max(0, size - count), size), count, large=False)

    def size(self, name: str) -> int | None:
        """Return the number of bytes of an object; None: there is none."""
        there = self.stat(name)
        return None if there is None else there[0]

    def stat(self, name: str) -> tuple[int, datetime] | None:
        """Return the bytes of an object, and when it was written; None: there is none."""
        import obstore

        async def head(_: Clock) -> Any:
            return await obstore.head_async(self._client, name)

        try:
            there = self._told(name, head)
        except FileNotFoundError:
            return None
        return there["size"], there["last_modified"]

    def pieces(self, name: str, start: int = 0) -> Iterator[bytes]:
        """Yield an object from a byte on, some bytes at a time, as they arrive.

        Raises:
            BrokenOffError: it can be gone on from where it ended.
            NoPartsError: the server does not begin in the middle.
            FileNotFoundError: there is no such object.
        """
        import obstore

        async def begin(_: Clock) -> Any:
            options: Any = {"range": {"offset": start}} if start else {}
            return await obstore.get_async(self._client, name, options=options)

        answer = self._told(name, begin)
        stream = aiter(answer.stream(min_chunk_size=STEP_BYTES))

        async def proceed(_: Clock) -> Any:
            return await anext(stream, None)

        while (piece := self._told(name, proceed, again=False)) is not None:
            yield bytes(piece)

    def write(self, name: str, content: bytes | Path, *, new: bool = False) -> bool:
        """Write an object, seen by others when it is whole.

        Args:
            name: of the object.
            content: bytes, or a file.
            new: write only if there is none of this name.

        Returns:
            Whether it was written: not if it had to be new and was there.

        Raises:
            RemoteError: there is no such bucket, or nothing may be written there.
        """
        import obstore

        mode: Any = "create" if new else "overwrite"

        async def put(_: Clock) -> None:
            if isinstance(content, bytes):
                await obstore.put_async(self._client, name, content, mode=mode)
                return
            with content.open("rb") as file:
                # Objects that are put in parts cannot be put only if they are new.
                await obstore.put_async(self._client, name, file, mode=mode, use_multipart=not new)

        size = len(content) if isinstance(content, bytes) else content.stat().st_size
        try:
            self._told(name, put, seconds=patience() * (1 + size / STEP_BYTES))
        except FileExistsError:
            return False
        except FileNotFoundError as error:
            raise no_bucket(self._where(name)) from error
        return True

    def delete(self, name: str) -> None:
        """Remove an object, if it is there."""
        import obstore

        async def delete(_: Clock) -> None:
            await obstore.delete_async(self._client, name)

        with contextlib.suppress(FileNotFoundError):
            self._told(name, delete)

    def _get(self, name: str, span: Any, limit: int, *, large: bool) -> Piece | None:
        import obstore

        async def get(progress: Clock) -> Piece:
            options: Any = {} if span is None else {"range": span}
            answer = await obstore.get_async(self._client, name, options=options)
            start, stop = answer.range
            if stop - start > limit:  # before memory for it is taken
                raise too_large(limit, stop - start, self._where(name))
            pieces, size = [], 0
            async for piece in answer.stream(min_chunk_size=STEP_BYTES):
                pieces.append(bytes(piece))
                size += len(piece)
                if size > stop - start:
                    break
                if large:
                    progress()
            if size != stop - start:
                raise RemoteError(
                    "the answer is not as long as it says",
                    expected=f"{stop - start} bytes",
                    got=size,
                    where=self._where(name),
                    do="try again; the object may be damaged",
                )
            return Piece(b"".join(pieces), start, answer.meta["size"], answer.meta["e_tag"])

        try:
            return self._told(name, get)
        except FileNotFoundError:
            return None

    def _told(
        self,
        name: str,
        do: Callable[[Clock], Awaitable[T]],
        *,
        again: bool = True,
        seconds: float | None = None,
    ) -> T:
        """Do something in time; broken answers are asked for again, other errors become ours.

        Args:
            name: of the object, for messages.
            do: is handed a function that gives it as many seconds once more.
            again: whether it can be done twice.
            seconds: how long it may take; None: ``patience()``.

        Raises:
            FileNotFoundError: there is no such object.
            FileExistsError: there is one.
        """
        limit = patience() if seconds is None else seconds

        async def timed() -> T:
            loop = asyncio.get_running_loop()
            try:
                async with asyncio.timeout(limit) as clock:
                    progress = lambda: clock.reschedule(loop.time() + limit)  # noqa: E731
                    return await self._repeated(name, functools.partial(do, progress), again)
            except TimeoutError:
                hint = self.root.scheme in BUCKETS  # their keys are looked for on the network
                raise too_slow(limit, self._where(name), keys=hint) from None

        return result(timed())

    async def _repeated(self, name: str, do: Callable[[], Awaitable[T]], again: bool) -> T:
        from obstore import exceptions

        for attempt in range(BROKEN + 1):
            try:
                return await do()
            except (exceptions.BaseError, OSError) as error:
                if isinstance(error, RemoteError | TimeoutError):
                    raise
                ours = failure(error, self.root.scheme, self._where(name))
                broken = isinstance(error, exceptions.GenericError)
                if broken and not again:
                    raise BrokenOffError(str(ours)) from None
                if not broken or is_final(error) or attempt == BROKEN:
                    raise ours from None
                await asyncio.sleep(0.1 * 2**attempt)
        raise AssertionError("not reached")

    def _where(self, name: str) -> str:
        return self.root.text(name)

    def __reduce__(self) -> tuple[Any, ...]:
        return store_at, (self.root,)


@functools.lru_cache(maxsize=64)
def store_at(root: Root) -> RemoteStore:
    """Return the store of an address, one for each in a process: its connections are used again."""
    return RemoteStore(root)


def _client(root: Root) -> ObjectStore:
    with needs("remote"):
        from obstore.store import LocalStore
    folder = Path(root.path or "/")
    if root.scheme == "file" and not folder.is_dir():
        hint = "; in file:// addresses %20 is a space, and %25 a %" if "%" in str(root) else ""
        raise FileNotFoundError(f"no folder at {folder}{hint}")
    try:
        return LocalStore(folder) if root.scheme == "file" else _server(root)
    except RemoteError:
        raise
    except Exception as error:  # obstore's, of addresses and settings: each kind has its own
        raise unusable(error, root.scheme, root) from error


def _server(root: Root) -> ObjectStore:
    from obstore.store import AzureStore, GCSStore, HTTPStore, S3Store

    seconds = patience()
    options: Any = {
        "connect_timeout": timedelta(seconds=min(10, seconds)),
        "read_timeout": timedelta(seconds=seconds / 2),  # between two pieces of an answer
        "timeout": timedelta(hours=12),  # of a whole answer, which may be a large file
        "allow_http": root.scheme != "https",  # a bucket's endpoint is the user's choice
    }
    retries: Any = {
        "max_retries": 100,
        "retry_timeout": timedelta(seconds=0.8 * seconds),  # its error comes before our time-out
        "backoff": {
            "init_backoff": timedelta(seconds=min(0.1, seconds / 10)),
            "max_backoff": timedelta(seconds=min(5, seconds / 10)),
            "base": 2,
        },
    }
    stores: Any = {"s3": S3Store, "gs": GCSStore, "az": AzureStore}
    if root.scheme in stores:
        return stores[root.scheme](  # type: ignore[no-any-return]
            root.host, prefix=root.path or None, client_options=options, retry_config=retries
        )
    url = str(root)
    if root.scheme == "hf":
        from weighttraj.remote.hub import headers, resolve_url

        url, options["default_headers"] = resolve_url(root), headers()
        options["allow_http"] = True  # HF_ENDPOINT is the user's choice
    return HTTPStore.from_url(url, client_options=options, retry_config=retries)
