"""A run in memory that grows while it is trained, as forecasters read it.

It is a ``Run`` without a store: a forecaster that follows the protocol needs no other code for a
training that goes on. Rows are views of arrays that double when they are full, so that to add a
snapshot and to read all of them takes no copy.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float32

from weighttraj import Run, RunInfo
from weighttraj.run import StoredArray

_COLUMNS: dict[str, Any] = {
    "index/num_timesteps": np.int64,
    "index/iteration": np.int64,
    "index/gradient_step": np.int64,
    "index/phase": np.int64,
    "index/learning_rate": np.float64,
}
"""What stands beside each snapshot, and its type."""
_WEIGHTS = "policy/weights"
_FIRST_ROWS = 64


class GrowingRun(Run):
    """A run in memory; ``append`` adds a snapshot.

    Args:
        info: metadata of the run: layout, cadence, algorithm.
    """

    def __init__(self, info: RunInfo) -> None:
        super().__init__(Path("in memory"), _no_store)
        self._info, self._count = info, 0
        self._columns = {name: np.zeros(_FIRST_ROWS, kind) for name, kind in _COLUMNS.items()}
        self._columns[_WEIGHTS] = np.zeros((_FIRST_ROWS, info.layout.size), np.float32)

    def append(self, weights: Float32[np.ndarray, " param"], **index: float) -> None:
        """Add a snapshot.

        Args:
            weights: policy weights.
            index: ``num_timesteps``, ``iteration``, ``gradient_step``, ``phase`` and
                ``learning_rate`` of the snapshot.
        """
        if self._count == len(self._columns[_WEIGHTS]):
            self._columns = {
                name: np.concatenate([rows, np.zeros_like(rows)])
                for name, rows in self._columns.items()
            }
        self._columns[_WEIGHTS][self._count] = weights
        for name in _COLUMNS:
            self._columns[name][self._count] = index[name.removeprefix("index/")]
        self._count += 1

    @property
    def rows(self) -> Float32[np.ndarray, "time param"]:
        """Policy weights of the snapshots so far: a view."""
        return self._columns[_WEIGHTS][: self._count]

    @property
    def info(self) -> RunInfo:
        """Metadata."""
        return self._info

    def __len__(self) -> int:
        """Return the number of snapshots so far."""
        return self._count

    def __getitem__(self, name: str) -> StoredArray:
        """Return any array by name; its rows so far are views."""
        try:
            return _Rows(name, self._columns[name][: self._count])
        except KeyError:
            names = ", ".join(self._columns)
            raise KeyError(f"a run in memory has no {name!r}; it has {names}") from None

    def keys(self) -> list[str]:
        """Return names of all arrays."""
        return list(self._columns)


class _Rows(StoredArray):
    """An array in memory with the members of a stored one."""

    def __init__(self, name: str, rows: np.ndarray) -> None:
        self._name, self._rows = name, rows

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and the shape of a row."""
        return self._rows.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Element type."""
        return self._rows.dtype

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions."""
        return ("time", "param")[: self._rows.ndim]

    def __getitem__(self, key: Any) -> np.ndarray:
        """Return rows (and, after a comma, columns)."""
        found: np.ndarray = self._rows[key]
        return found

    def pieces(self, unit: int = 1) -> Iterator[tuple[int, np.ndarray]]:
        """Yield all rows at once."""
        yield 0, self._rows

    def __repr__(self) -> str:
        return f"<{self._name} {self.dtype} {dict(zip(self.dims, self.shape, strict=True))}>"


def _no_store() -> NoReturn:
    raise AssertionError("a run in memory has no store")
