"""The progress bar of a training."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from weighttraj.progress import LoggedProgress


class TrainingBar(LoggedProgress):
    """Shows batches done, batches a second and the error; draws nothing on a quiet console."""

    def __init__(self, total: int, start: int, console: Console, measure: str) -> None:
        super().__init__(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(
                "{task.fields[speed]:.3g} batches/s, " + measure + " {task.fields[error]:.3g}"
            ),
            TimeRemainingColumn(),
            console=console,
            refresh_per_second=2,  # drawing takes time from the training
        )
        self._bar = self.add_task(
            "training", total=total, completed=start, speed=0.0, error=float("nan")
        )
        self.measure_again()

    def count(self, error: float) -> None:
        """Count one more batch; the error is the mean since the last line of the log."""
        self._count += 1
        self.update(self._bar, advance=1, speed=self.speed, error=error)

    @property
    def speed(self) -> float:
        """Batches a second since the last line of the log."""
        return self._count / max(time.perf_counter() - self._since, 1e-9)

    def measure_again(self) -> None:
        """Measure the speed from now on: a line of the log was written."""
        self._since, self._count = time.perf_counter(), 0
