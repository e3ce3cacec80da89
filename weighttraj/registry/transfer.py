"""Many files at the same time."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

from weighttraj.format.catalog import ManifestLine

AT_ONCE = 4
"""Files that are sent or fetched at the same time."""


def for_each(lines: Iterable[ManifestLine], do: Callable[[ManifestLine], None]) -> None:
    """Do something for each file; the first error ends it, and those not begun are left."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        futures = [pool.submit(do, line) for line in lines]
        try:
            for future in futures:
                future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


__all__ = ["AT_ONCE", "for_each"]
