"""Many files at the same time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from weighttraj.remote.wait import stop_with
from weighttraj.store.catalog import ManifestLine

AT_ONCE = 4
"""Files that are sent or fetched at the same time."""


def for_each(lines: Iterable[ManifestLine], do: Callable[[ManifestLine], None]) -> None:
    """Do something for each file; the first error, or Ctrl-C, ends those that have begun."""
    stop = threading.Event()
    with ThreadPoolExecutor(AT_ONCE, initializer=stop_with, initargs=(stop,)) as pool:
        futures = [pool.submit(do, line) for line in lines]
        try:
            for future in futures:
                future.result()
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


__all__ = ["AT_ONCE", "for_each"]
