"""Measurements of a forecaster on a run, kept on disk so that each is made once."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tipl.runs import checksum_of
from weighttraj import Run
from weighttraj.atomic import replacing

Arrays = dict[str, np.ndarray]


class Parts:
    """A folder of measurements. Each names its sources, and is made again when these change."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str, source: dict[str, Any], measure: Callable[[], Arrays]) -> Arrays:
        """Return the arrays of a measurement; make them if they are not stored.

        Args:
            name: path in the folder, without suffix.
            source: everything that the arrays depend on, for JSON.
            measure: makes the arrays.
        """
        path = self._folder / f"{name}.npz"
        wanted = json.dumps(source, sort_keys=True, default=str)
        if (arrays := _read(path, wanted)) is None:
            arrays = measure()
            _write(path, wanted, arrays)
        return arrays


def run_source(run: Run) -> dict[str, Any]:
    """Return what identifies a run."""
    return {"run": run.id, "digest": checksum_of(run)}


def _read(path: Path, wanted: str) -> Arrays | None:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (FileNotFoundError, ValueError, OSError, EOFError, zipfile.BadZipFile):
        return None  # absent, or cut short
    return arrays if str(arrays.pop("source", "")) == wanted else None


def _write(path: Path, source: str, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        np.savez_compressed(file, source=np.array(source), **arrays)  # type: ignore[arg-type]
