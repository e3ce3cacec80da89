"""A Dask cluster: one that runs already, on any machines, or one that is begun here."""

from __future__ import annotations

import contextlib
import queue
import signal
import sys
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from weighttraj.engine.base import RETRIES, Outcome, R, T, Tell, noted_interrupts
from weighttraj.errors import EngineError, needs

with needs("dask"):
    import distributed

LOCAL = "local"
"""Instead of an address: a cluster on this machine, for as long as it has work."""
_POLL = 0.2
_PATIENCE = 120
"""Seconds that tasks have to stop by themselves."""


class Cluster:
    """Does tasks on a Dask cluster, see ``Engine``.

    Dask does again what a worker did that died. It holds all tasks that wait at a dying worker for
    its possible killers; each that it gives up is tried once more with no other beside it. Workers
    must have one thread each, and see the same files as this process.

    Args:
        address: of the scheduler, ``tcp://host:port``; or ``local``.
        workers: how many a local cluster has.

    Raises:
        EngineError: nobody answers at the address.
    """

    def __init__(self, address: str, workers: int) -> None:
        self._stack = contextlib.ExitStack()
        if address == LOCAL:
            local = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=":0",
            )
            self._stack.enter_context(local)
        try:
            self._client = distributed.Client(
                local if address == LOCAL else address, set_as_default=False
            )
        except (OSError, TimeoutError, ValueError) as error:
            raise EngineError(
                "no Dask scheduler answers",
                expected="the address that `dask scheduler` printed, such as tcp://host:8786",
                got=f"{type(error).__name__}: {error}",
                where=address,
                do=f"start one, or let --scheduler {LOCAL} begin one here",
            ) from error
        self._stack.enter_context(self._client)
        if address == LOCAL:
            self._client.register_plugin(_Deaf())
        self.workers = max(1, len(self._client.nthreads()))

    def close(self) -> None:
        """Leave the cluster, or end it if it is local.

        Raises:
            KeyboardInterrupt: it was interrupted meanwhile, and is closed.
        """
        with noted_interrupts() as interrupted:
            self._stack.close()
        if interrupted.is_set() and sys.exc_info()[0] is None:
            raise KeyboardInterrupt

    def run(
        self, do: Callable[[T, Tell], R], tasks: Sequence[T], note: Tell, *, wait: bool = True
    ) -> Iterator[Outcome[T, R]]:
        """See ``Engine``."""
        client, topic = self._client, f"weighttraj-{uuid.uuid4()}"
        told: queue.SimpleQueue[Any] = queue.SimpleQueue()
        stop = distributed.Event(topic, client=client)
        client.subscribe_topic(topic, lambda event: told.put(event[1]))
        futures: dict[Any, T] = {}
        suspects: list[T] = []

        def submit(task: T) -> None:
            key = f"{topic}-{uuid.uuid4()}"
            futures[client.submit(_do, do, task, topic, key=key, pure=False, retries=RETRIES)] = (
                task
            )

        with noted_interrupts() as interrupted:
            try:
                for task in tasks:
                    submit(task)
                alone = len(futures) == 1
                while futures or suspects:
                    if interrupted.is_set():
                        raise KeyboardInterrupt
                    if not futures:
                        alone = True
                        submit(suspects.pop(0))
                    with contextlib.suppress(queue.Empty):
                        note(*told.get(timeout=_POLL))
                        continue
                    for future in [future for future in futures if future.done()]:
                        task, outcome = futures.pop(future), _outcome(future)
                        if isinstance(outcome, _WorkerDiedError) and not alone:
                            suspects.append(task)
                        else:
                            yield task, outcome
            finally:
                if futures:
                    stop.set()
                    if wait:
                        with contextlib.suppress(TimeoutError), client.as_current():
                            distributed.wait(list(futures), timeout=_PATIENCE)
                    client.cancel(list(futures))
                client.unsubscribe_topic(topic)


class _WorkerDiedError(EngineError):
    """Dask gave a task up."""


def _outcome(future: Any) -> Any:
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, distributed.KilledWorker):
        return _WorkerDiedError(
            f"its worker died, {error.allowed_failures + 1} times in a row",
            got=error,
            do="read the workers' logs; do they have enough memory and time?",
        )
    return error


def _do(do: Callable[[T, Tell], R], task: T, topic: str) -> R | None:
    """Do a task in a worker; what it tells goes to those who listen to the topic."""
    worker = distributed.get_worker()
    if worker.state.nthreads > 1:
        raise EngineError(
            "the Dask worker does several tasks at a time",
            expected="one thread: random numbers and torch's threads belong to the whole process",
            got=f"{worker.state.nthreads} threads",
            where=worker.address,
            do="start workers with --nthreads 1 (dask-jobqueue: cores=1, processes=1)",
        )
    stop = distributed.Event(topic, client=distributed.get_client())

    def tell(*message: Any) -> None:
        worker.log_event(topic, message)
        if stop.is_set():
            raise KeyboardInterrupt

    if stop.is_set():
        return None
    try:
        return do(task, tell)
    except KeyboardInterrupt:  # the worker itself would take it as its end
        return None


class _Deaf(distributed.WorkerPlugin):
    """Interrupts are the business of the process that began the worker."""

    name = "deaf"

    def setup(self, worker: Any) -> None:
        """Called in each worker when it begins."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
