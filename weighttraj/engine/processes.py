"""Several processes of this machine."""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from typing import Any, Generic

from weighttraj.engine.base import RETRIES, Outcome, R, T, Tell, noted_interrupts
from weighttraj.errors import EngineError

_GO, _STOP, _EXIT = range(3)
"""What a worker is to do: its task; stop when it next tells; end at once."""
_POLL = 0.1
"""Seconds between two looks at the workers."""


class Processes:
    """Does tasks in processes of this machine, see ``Engine``.

    They are spawned, so a script that uses it needs ``if __name__ == "__main__":``. They end with
    the process that began them, however that ends.

    Args:
        workers: how many.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def run(
        self, do: Callable[[T, Tell], R], tasks: Sequence[T], note: Tell, *, wait: bool = True
    ) -> Iterator[Outcome[T, R]]:
        """See ``Engine``."""
        waiting = deque((task, RETRIES) for task in tasks)
        with contextlib.ExitStack() as stack:
            interrupted = stack.enter_context(noted_interrupts())
            workers: list[_Worker[T, R]] = [_Worker() for _ in range(min(self.workers, len(tasks)))]
            for worker in workers:
                stack.callback(worker.end)
            while waiting or any(worker.busy for worker in workers):
                if interrupted.is_set():
                    _stop(workers, note, wait=wait)
                    raise KeyboardInterrupt
                for worker in workers:
                    if waiting and not worker.busy:
                        worker.begin(do, *waiting.popleft())
                wait_for([w.future for w in workers if w.future], _POLL, "FIRST_COMPLETED")
                for worker in workers:
                    worker.pass_on(note)
                    if worker.done:
                        task, tries, outcome = worker.take()
                        if isinstance(outcome, BrokenProcessPool) and tries:
                            waiting.appendleft((task, tries - 1))
                        else:
                            yield task, _told(outcome)


class _Worker(Generic[T, R]):
    """A process that does one task at a time; another takes its place when it is killed."""

    def __init__(self) -> None:
        self.future: Future[R] | None = None
        self._pool: ProcessPoolExecutor | None = None
        self._task: tuple[T, int]

    @property
    def busy(self) -> bool:
        """Whether it has a task, done or not."""
        return self.future is not None

    @property
    def done(self) -> bool:
        """Whether its task has an outcome that nobody took yet."""
        return self.future is not None and self.future.done()

    def begin(self, do: Callable[[T, Tell], R], task: T, tries: int) -> None:
        """Begin a task that may be done again so many times."""
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._told, telling = context.Pipe(duplex=False)
            # Without a lock: one that a killed process holds would be held for ever.
            self._order = context.RawValue(ctypes.c_int, _GO)
            self._pool = ProcessPoolExecutor(
                1, mp_context=context, initializer=_begin, initargs=(telling, self._order)
            )
        self._task = task, tries
        self.future = self._pool.submit(_do, do, task)

    def pass_on(self, note: Tell) -> None:
        """Pass on what the task has told."""
        while self._pool is not None:
            try:
                message = self._told.recv() if self._told.poll() else None
            except (EOFError, OSError):  # the process is dead, and all that it told was passed on
                return
            if message is None:
                return
            note(*message)

    def take(self) -> tuple[T, int, R | BaseException]:
        """Return the task that is done, its remaining tries, and its outcome."""
        assert self.future is not None  # noqa: S101
        future, self.future = self.future, None
        error = future.exception()
        if isinstance(error, BrokenProcessPool):
            self.end()
        return *self._task, future.result() if error is None else error

    def stop(self) -> None:
        """Ask the task to stop."""
        if self._pool is not None:
            self._order.value = _STOP

    def end(self) -> None:
        """End the process at once."""
        if self._pool is not None:
            self._order.value = _EXIT
            self._pool.shutdown(cancel_futures=True)
            self._told.close()
            self._pool = self.future = None


def _stop(workers: Sequence[_Worker[Any, Any]], note: Tell, *, wait: bool) -> None:
    for worker in workers:
        worker.stop()
    while wait and (futures := [w.future for w in workers if w.future and not w.done]):
        wait_for(futures, _POLL, "FIRST_COMPLETED")
        for worker in workers:
            worker.pass_on(note)


def _told(outcome: Any) -> Any:
    """Return the outcome, in words if the process was killed each time."""
    if not isinstance(outcome, BrokenProcessPool):
        return outcome
    return EngineError(
        f"its process was killed, {RETRIES + 1} times in a row",
        got=outcome,
        do="is there enough memory? fewer workers need less",
    )


# In the workers

_telling: Connection
_order: Any


def _begin(telling: Connection, order: Any) -> None:
    global _telling, _order
    _telling, _order = telling, order
    # Interrupts are the business of the process that began this one: it gives orders.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_obey, args=(multiprocessing.parent_process(),), daemon=True).start()


def _obey(parent: Any) -> None:
    """End this process when it is told to, or when nobody is left to tell it."""
    while parent.is_alive() and _order.value != _EXIT:
        parent.join(_POLL)
    os._exit(1)


def _do(do: Callable[[T, Tell], R], task: T) -> R:
    return do(task, _tell)


def _tell(*message: Any) -> None:
    _telling.send(message)
    if _order.value != _GO:
        raise KeyboardInterrupt
