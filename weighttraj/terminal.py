"""What the commands print, and whether somebody reads it.

Names, notes and errors that are printed may be a stranger's: all that a command prints goes through
``say`` or an ``Output``, which escape what a terminal would obey.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any

from rich.console import Console
from rich.segment import Segment

from weighttraj.text import printable


class Output(Console):
    """Rich's ``Console`` for text that may be a stranger's.

    It leaves it to ``while_read`` that nobody reads any more.
    """

    def render(self, *args: Any, **options: Any) -> Iterable[Segment]:
        """Render as Rich does, without control characters of the text itself."""
        for segment in super().render(*args, **options):
            if segment.control:
                yield segment
            else:
                yield Segment(printable(segment.text, lines=True), segment.style)

    def on_broken_pipe(self) -> None:
        """Go on with the error: Rich would exit with 1."""
        raise  # Rich calls this where the error is caught


def say(thing: object) -> None:
    """Print the text of anything, without control characters."""
    sys.stdout.write(printable(thing, lines=True) + "\n")


@contextlib.contextmanager
def while_read() -> Iterator[None]:
    """Ends quietly once the reader of our output, such as ``head``, has seen enough.

    Characters that the terminal's encoding lacks are printed as escapes.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with contextlib.suppress(BrokenPipeError):
            yield
    finally:
        try:
            if sys.stdout is not None:  # it is, where it was closed
                sys.stdout.flush()
        except BrokenPipeError:  # what is still to be written goes nowhere
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
