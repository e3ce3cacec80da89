"""Which engine a user asks for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial

from weighttraj.engine.base import Engine, Outcome, R, Serial, T, Tell
from weighttraj.engine.processes import Processes
from weighttraj.errors import EngineError
from weighttraj.plugins import import_modules


@contextmanager
def engine_of(
    workers: int = 1, scheduler: str | None = None, imports: Sequence[str] = ()
) -> Iterator[Engine]:
    """The engine for so many workers, or for a Dask scheduler.

    Args:
        workers: 1: this process; more: so many processes.
        scheduler: address of a Dask scheduler, ``tcp://host:port``, or ``local`` for a Dask cluster
            of so many workers on this machine.
        imports: modules that are imported here and by each worker, before its first task: they
            register environments.

    Raises:
        CollectError: a module cannot be imported, or registers nothing.
        EngineError: nobody is left to do the work, or no scheduler answers.
        MissingExtraError: Dask is not installed.
    """
    if workers < 1:
        raise EngineError(
            "nobody to do the work",
            expected="workers at least 1",
            got=workers,
            do="ask for at least one",
        )
    import_modules(imports)
    if scheduler is not None:
        from weighttraj.engine.cluster import Cluster

        with closing(Cluster(scheduler, workers)) as cluster:
            yield _Importing(cluster, tuple(imports)) if imports else cluster
    else:
        engine: Engine = Serial() if workers == 1 else Processes(workers)
        yield _Importing(engine, tuple(imports)) if imports else engine


class _Importing:
    """Does tasks with another engine, after its workers have imported some modules."""

    def __init__(self, engine: Engine, imports: tuple[str, ...]) -> None:
        self.workers = engine.workers
        self._engine, self._imports = engine, imports

    def run(
        self, do: Callable[[T, Tell], R], tasks: Sequence[T], note: Tell, *, wait: bool = True
    ) -> Iterator[Outcome[T, R]]:
        """See ``Engine``."""
        prepared = partial(_import_and_do, self._imports, do)
        return self._engine.run(prepared, tasks, note, wait=wait)


def _import_and_do(imports: tuple[str, ...], do: Callable[[T, Tell], R], task: T, tell: Tell) -> R:
    import_modules(imports)
    return do(task, tell)
