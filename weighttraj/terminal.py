"""What the commands print, and whether somebody reads it."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

from rich.console import Console


class Output(Console):
    """Rich's ``Console``, which leaves it to ``while_read`` that nobody reads any more."""

    def on_broken_pipe(self) -> None:
        """Go on with the error: Rich would exit with 1."""
        raise  # Rich calls this where the error is caught


@contextlib.contextmanager
def while_read() -> Iterator[None]:
    """Ends quietly once the reader of our output, such as ``head``, has seen enough."""
    try:
        with contextlib.suppress(BrokenPipeError):
            yield
    finally:
        try:
            if sys.stdout is not None:  # it is, where it was closed
                sys.stdout.flush()
        except BrokenPipeError:  # what is still to be written goes nowhere
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


__all__ = ["Output", "while_read"]
