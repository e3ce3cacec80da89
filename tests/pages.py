"""The code of a page, run as a reader would: Python in order, commands through the command line."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

import tipl.cli
import weighttraj.cli
from tests.typecheck import unchecked

ROOT = Path(__file__).parents[1]
PROGRAMS: dict[str, Callable[[], None]] = {
    "weighttraj": weighttraj.cli.main,
    "tipl": tipl.cli.main,
}

QUICKER = (
    "--quick --starts 50 --function-starts 10 --learning-starts 1 --plateau-starts 0"
    " --bootstrap 100"
)
"""What ``tipl evaluate --quick`` becomes."""


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and text of each block of code."""
    return re.findall(r"```(python|bash)\n(.*?)```", page.read_text(), re.DOTALL)


def run_page(
    page: Path, shorter: Mapping[str, str] | None = None, skip: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Run all blocks of a page in the current folder; returns the names that its Python made.

    The types of calls are not checked: that takes half of the time, and other tests check them.

    Args:
        page: Markdown.
        shorter: what is replaced by what; each of these must be there.
        skip: beginnings of commands that are not run; each of these must be there.
    """
    names: dict[str, Any] = {}
    used: set[str] = set()
    for language, text in blocks(page):
        for long, short in (shorter or {}).items():
            used |= {long} if long in text else set()
            text = text.replace(long, short)
        if language == "python":
            with unchecked():
                exec(compile(text, page.name, "exec"), names)  # noqa: S102
            continue
        for line in [text] if "<<" in text else text.splitlines():
            command = line if "<<" in text else line.partition("#")[0].strip()
            skipped = [start for start in skip if command.startswith(start)]
            used.update(skipped)
            if command and not skipped:
                run_command(command)
    assert used == {*(shorter or {}), *skip}
    return names


def run_command(command: str) -> None:
    """Run a command: ours in this process, as a new one spends seconds on imports."""
    program, *arguments = shlex.split(command, comments=True)
    if program in PROGRAMS and ">" not in arguments:
        with pytest.MonkeyPatch.context() as patch, unchecked():
            patch.setattr(sys, "argv", [program, *arguments])
            try:
                PROGRAMS[program]()
            except SystemExit as end:
                assert not end.code, command  # noqa: PT017
        return
    scripts = f"PATH={shlex.quote(str(Path(sys.executable).parent))}:$PATH"
    done = subprocess.run(
        ["bash", "-euc", f"{scripts}; {command}"],  # noqa: S607
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
