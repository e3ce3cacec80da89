"""Which engine a user asks for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

from weighttraj.engine.base import Engine
from weighttraj.engine.processes import Processes
from weighttraj.engine.serial import Serial
from weighttraj.errors import EngineError


@contextmanager
def engine_of(workers: int = 1, scheduler: str | None = None) -> Iterator[Engine]:
    """The engine for so many workers, or for a Dask scheduler.

    Args:
        workers: 1: this process; more: so many processes.
        scheduler: address of a Dask scheduler, ``tcp://host:port``, or ``local`` for a Dask cluster
            of so many workers on this machine.

    Raises:
        EngineError: nobody is left to do the work, or no scheduler answers.
        MissingExtraError: Dask is not installed.
    """
    if workers < 1:
        raise EngineError("nobody to do the work", expected="workers at least 1", got=workers)
    if scheduler is not None:
        from weighttraj.engine.cluster import Cluster

        with closing(Cluster(scheduler, workers)) as cluster:
            yield cluster
    else:
        yield Serial() if workers == 1 else Processes(workers)


__all__ = ["engine_of"]
