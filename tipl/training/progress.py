"""The progress bar of a training."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from weighttraj.progress import LoggedProgress


class TrainingBar:
    """Shows batches done, batches a second and the error; draws nothing on a quiet console.

    Args:
        total: batches of the whole training.
        start: batches done before.
        console: where to draw.
        measure: what the error is called.
    """

    def __init__(self, total: int, start: int, console: Console, measure: str) -> None:
        # Twice a second: drawing takes time from the training.
        self._progress = LoggedProgress(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(
                "{task.fields[speed]:.3g} batches/s, " + measure + " {task.fields[error]:.3g}"
            ),
            TimeRemainingColumn(),
            console=console,
            refresh_per_second=2,
            disable=console.quiet,
        )
        self._task = self._progress.add_task(
            "training", total=total, completed=start, speed=0.0, error=float("nan")
        )
        self._since, self._count = time.perf_counter(), 0

    def advance(self, error: float) -> None:
        """Count one more batch.

        Args:
            error: mean error since the last line of the log.
        """
        self._count += 1
        self._progress.update(self._task, advance=1, speed=self.speed, error=error)

    @property
    def speed(self) -> float:
        """Batches a second since the last line of the log."""
        return self._count / max(time.perf_counter() - self._since, 1e-9)

    def restart(self) -> None:
        """Begin to measure again: a line of the log was written."""
        self._since, self._count = time.perf_counter(), 0

    def __enter__(self) -> TrainingBar:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._progress.stop()
