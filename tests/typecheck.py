"""The type checker that runs under the tests, and the modules that it checks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from beartype import BeartypeConf, beartype
from jaxtyping import config

typecheck = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""An int is a float, as for static type checkers."""

ROOT = Path(__file__).parents[1]


def checked_modules() -> list[str]:
    """Return the modules whose calls are checked: those that give shapes, which mypy ignores.

    With ``WEIGHTTRAJ_CHECK_ALL_TYPES`` in the environment, as under ``make test-long``, all are.
    """
    if os.environ.get("WEIGHTTRAJ_CHECK_ALL_TYPES"):
        return ["weighttraj", "tipl"]
    files = [file for package in ("weighttraj", "tipl") for file in (ROOT / package).rglob("*.py")]
    return [
        ".".join(file.relative_to(ROOT).with_suffix("").parts)
        for file in sorted(files)
        if "from jaxtyping" in file.read_text()
    ]


@contextmanager
def unchecked() -> Iterator[None]:
    """Check no types meanwhile: for long runs of functions that other tests call with checks."""
    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        config.update("jaxtyping_disable", before)
