"""One task after another, in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from weighttraj.engine.base import Outcome, R, T, Tell


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


__all__ = ["Serial"]
