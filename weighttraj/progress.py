"""Progress of long work, on a terminal and in a log."""

from __future__ import annotations

import threading
from typing import Any

from rich.console import Console
from rich.progress import Progress, ProgressColumn


class LoggedProgress(Progress):
    """Rich's ``Progress``, which prints its bars now and then where output goes to a file.

    Rich draws them on terminals and in notebooks alone, and a log of an hour's work stays empty to
    the end. Here they are printed after 10 seconds, and again each time that twice as much has
    passed, at most ten minutes.

    Args:
        columns: what a line shows; none: Rich's own.
        console: where it is shown; None: nowhere.
        disable: show nothing.
        options: of Rich's ``Progress``.
    """

    FIRST, LONGEST = 10.0, 600.0
    """Seconds to the first lines, and between later ones."""

    def __init__(
        self,
        *columns: ProgressColumn,
        console: Console | None = None,
        disable: bool = False,
        **options: Any,
    ) -> None:
        console = console or Console(quiet=True)
        super().__init__(*columns, console=console, disable=disable or console.quiet, **options)

    def start(self) -> None:
        """Begin to draw, or to print."""
        super().start()
        console = self.console
        if self.disable or console.is_terminal or console.is_jupyter:
            return
        self._ended = threading.Event()
        self._printer = threading.Thread(target=self._print, daemon=True)
        self._printer.start()

    def stop(self) -> None:
        """Draw or print for the last time."""
        if hasattr(self, "_ended"):
            self._ended.set()
            self._printer.join()
        super().stop()

    def _print(self) -> None:
        wait = self.FIRST
        while not self._ended.wait(wait):
            self.console.print(self.get_renderable())
            wait = min(2 * wait, self.LONGEST)
