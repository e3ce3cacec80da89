"""The command lines, called as a shell calls them."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
import warnings
from importlib import import_module

import pytest


def shell(
    program: str, *arguments: object, answers: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command in this process: a new one spends seconds on imports."""
    command = [program, *map(str, arguments)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("default")
        patch.setattr(sys, "argv", command)
        patch.setattr(sys, "stdin", io.StringIO(answers))
        try:
            import_module(f"{program}.cli").main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return subprocess.CompletedProcess(command, code, out.getvalue(), err.getvalue())


def process(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own, for tests of what a process is and does."""
    command = [sys.executable, "-m", f"{program}.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)
