"""What a collection took: one line of JSON for each call that trained runs, beside the runs."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from weighttraj.atomic import appending
from weighttraj.store.objects import read_plain

COSTS = ".costs.jsonl"
"""Hidden file in a data set's folder, so it is no object of the data set and is not published."""


_MOST = 2**24
"""Bytes that the file may have."""


@contextlib.contextmanager
def measured(folder: Path, finished: Callable[[], Sequence[int]]) -> Iterator[None]:
    """Write down the CPU and wall seconds of what happens inside, also if it is interrupted.

    Worker processes count once they have ended. Workers on other machines do not count. A call
    that found nothing to do leaves no line.

    Args:
        folder: of the data set.
        finished: returns the seeds whose runs are complete.
    """
    before, cpu, wall = set(finished()), _cpu_seconds(), time.monotonic()
    stopped = True
    try:
        yield
        stopped = False
    finally:
        line = {
            "seeds": sorted(set(finished()) - before),
            "cpu_s": round(_cpu_seconds() - cpu, 1),
            "wall_s": round(time.monotonic() - wall, 1),
        }
        if (folder / "dataset.json").is_file() and (stopped or line["seeds"]):
            with appending(folder / COSTS, root=folder) as file:
                file.write(f"{json.dumps(line)}\n".encode())


def read_costs(folder: Path) -> list[dict[str, Any]]:
    """Return what was written down of the collections into a folder, the first one first.

    Lines that are damaged are left out.

    Raises:
        FormatError: the file is a link, no plain file, or too large.
    """
    file = folder / COSTS
    if not os.path.lexists(file):
        return []
    found = []
    for line in read_plain(file, _MOST).splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            value = json.loads(line)
            found += [value] if isinstance(value, dict) else []
    return found


def _cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
