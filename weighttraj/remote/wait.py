"""Waits for servers: as long as was promised, and no longer once Ctrl-C is pressed.

Requests run on an event loop in a thread of its own. The thread that asks waits for it in Python,
where Ctrl-C reaches it; in the client's own code it would not.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import threading
from collections.abc import Callable, Coroutine, Iterable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from typing import Any, TypeVar

from weighttraj.errors import RemoteError

TIMEOUT = "WEIGHTTRAJ_REMOTE_TIMEOUT"
"""Environment variable: seconds that a request for metadata may take in all, its repetitions
included; a large file may take longer as long as its bytes come. Default: 60."""

_LONGEST = 1e8  # seconds
_POLL = 0.2  # seconds
_local = threading.local()
_process: list[int] = []
T = TypeVar("T")

AT_ONCE = 4
"""Files that are sent or fetched at the same time."""


def patience() -> float:
    """Return the seconds that a server is waited for.

    Raises:
        RemoteError: the environment variable is no such number.
    """
    told = os.environ.get(TIMEOUT, "60")
    with contextlib.suppress(ValueError):
        if 0 < (seconds := float(told)) < _LONGEST:
            return seconds
    raise RemoteError(
        "this is no time to wait for a server",
        expected="seconds, more than 0",
        got=told,
        where=f"environment variable {TIMEOUT}",
        do="set it to a number, or unset it",
    )


def result(work: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine on the loop of requests, and return its result.

    Raises:
        RemoteError: this is a forked process, or another request of ``for_each`` failed.
    """
    try:
        _refuse_fork()
    except RemoteError:
        work.close()
        raise
    return _finish(asyncio.run_coroutine_threadsafe(work, _loop()))


def within(do: Callable[[], T], where: object) -> T:
    """Do something that asks a server, and stop waiting for it after ``patience()`` seconds.

    Raises:
        RemoteError: it took longer.
    """
    seconds, future = patience(), Future[T]()

    def work() -> None:
        try:
            future.set_result(do())
        except BaseException as error:  # whoever waits gets it
            future.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    try:
        return future.result(seconds)
    except TimeoutError:
        if future.done():
            raise
        raise too_slow(seconds, where) from None


def for_each(items: Iterable[T], do: Callable[[T], None]) -> None:
    """Do something for each item, several at a time.

    The first error, or Ctrl-C, soon ends the requests of those that have begun.
    """
    stop = threading.Event()
    with ThreadPoolExecutor(AT_ONCE, initializer=_stop_with, initargs=(stop,)) as pool:
        futures = [pool.submit(do, item) for item in items]
        try:
            for future in futures:
                future.result()
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


def _stop_with(event: threading.Event) -> None:
    """Make the requests of the current thread end soon after the event is set."""
    _local.stop = event


def too_slow(seconds: float, where: object, *, keys: bool = False) -> RemoteError:
    """Return the error for a server that has not answered in time; keys: or that of the keys."""
    return RemoteError(
        "a remote object cannot be reached in time",
        expected=f"an answer within {seconds:g} seconds",
        got="a part of it, or nothing",
        where=where,
        do=f"try again{' with credentials' if keys else ''}; {TIMEOUT} says how many seconds an "
        "answer may take",
    )


def _finish(future: Future[T]) -> T:
    stop: threading.Event | None = getattr(_local, "stop", None)
    try:
        while True:
            try:
                return future.result(None if stop is None else _POLL)
            except TimeoutError:
                if future.done():
                    raise
                if stop is not None and stop.is_set():
                    raise RemoteError("stopped, because another request failed") from None
    except CancelledError as error:
        raise RemoteError("the request was cancelled") from error
    finally:
        future.cancel()  # where nobody waits any more


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="weighttraj requests", daemon=True).start()
    return loop


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
