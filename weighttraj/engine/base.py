"""What every engine does, and the one that does it in this process."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar, runtime_checkable

T = TypeVar("T")
R = TypeVar("R")

Tell = Callable[..., None]
"""Progress callback of a task. It raises ``KeyboardInterrupt`` in a task that is to stop."""

Outcome = tuple[T, R | Exception]
"""A task, and what it returned or raised."""

RETRIES = 2
"""How often a task is done again whose worker was killed."""


@runtime_checkable
class Engine(Protocol):
    """Runs tasks. Functions, tasks and results must be picklable."""

    workers: int
    """How many tasks it does at a time, as far as it knows."""

    def run(
        self,
        do: Callable[[T, Tell], R],
        tasks: Sequence[T],
        note: Tell,
        *,
        wait: bool = True,
    ) -> Iterator[Outcome[T, R]]:
        """Do all tasks.

        Args:
            do: called with a task and ``tell``.
            tasks: idempotent, in the order in which they are begun.
            note: called in this process with what the tasks tell.
            wait: when it is interrupted, wait until the tasks that are being done have stopped by
                themselves, at their next call of ``tell``.

        Yields:
            Each task with its outcome, in the order in which they end.

        Raises:
            KeyboardInterrupt: it was interrupted; no task is being done any more.
        """
        ...


class Serial:
    """Does tasks in this process, see ``Engine``."""

    workers = 1

    def run(
        self,
        do: Callable[[T, Tell], R],
        tasks: Sequence[T],
        note: Tell,
        *,
        wait: bool = True,
    ) -> Iterator[Outcome[T, R]]:
        """See ``Engine``."""
        for task in tasks:
            try:
                outcome: R | Exception = do(task, note)
            except Exception as error:
                outcome = error
            yield task, outcome


@contextlib.contextmanager
def noted_interrupts() -> Iterator[threading.Event]:
    """Note Ctrl-C instead of raising it anywhere, also when it is pressed again and again.

    An exception in the middle of an engine's own work would tear it apart.
    """
    noted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield noted  # only the main thread gets interrupts
        return
    before = signal.signal(signal.SIGINT, lambda *_: noted.set())
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)
