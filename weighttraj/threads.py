"""How many threads torch computes with, and threads of our own that Ctrl-C ends."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from threading import Event, Thread
from typing import TypeVar

import torch

W = TypeVar("W")
T = TypeVar("T")
R = TypeVar("R")

_POLL = 0.1
"""Seconds between two ticks."""
_PATIENCE = 1.0
"""Seconds that threads have to end when they are stopped."""


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch compute with one thread: the number moves bits, and small products wait for it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def in_threads(
    do: Callable[[W, T, Event], R],
    workers: Sequence[W],
    items: Sequence[T],
    tick: Callable[[], None],
) -> list[R]:
    """Do all items, one at a time with each worker; workers have a thread each.

    In each of them torch computes with as many threads as in the calling one.

    Args:
        do: called with a worker, an item and an event; it ends soon after the event is set.
        workers: what a thread needs of its own.
        items: what is to be done.
        tick: called in the calling thread every now and then; what it raises ends everything.

    Returns:
        The results, in the order of the items.

    Raises:
        BaseException: what ``do`` or ``tick`` raised, or Ctrl-C. Threads that do not end within a
            second are left behind; they end with the process.
    """
    waiting, stop = deque(enumerate(items)), Event()
    ended: SimpleQueue[tuple[int, R | BaseException]] = SimpleQueue()
    count = torch.get_num_threads()

    def work(worker: W) -> None:
        # OpenMP keeps the number for each thread, and MKL's products take it before torch has set
        # it: a new thread would compute with all cores, and wait for them where others use them.
        torch.set_num_threads(count)
        while waiting and not stop.is_set():
            with suppress(IndexError):  # another thread took the last one
                number, item = waiting.popleft()
                try:
                    ended.put((number, do(worker, item, stop)))
                except BaseException as error:
                    ended.put((number, error))
                    return

    threads = [Thread(target=work, args=(w,), daemon=True) for w in workers[: len(items)]]
    results: dict[int, R] = {}
    try:
        for thread in threads:
            thread.start()
        while len(results) < len(items):
            tick()
            with suppress(Empty):
                number, result = ended.get(timeout=_POLL)
                if isinstance(result, BaseException):
                    raise result
                results[number] = result
    finally:
        stop.set()
        for thread in threads:
            thread.join(_PATIENCE / len(threads))
    return [results[number] for number in range(len(items))]
