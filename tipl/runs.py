"""How models read runs: through the decoded memory map of ``weighttraj.load``.

A run is decoded and checked once, into a file that all processes map; later readings are slices of
that map.
"""

from __future__ import annotations

import functools
import hashlib
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, runtime_checkable
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32, Int

from tipl.errors import LeftOutWarning
from tipl.growing import GrowingRun
from weighttraj import Run
from weighttraj.load import CachedWeights

P = ParamSpec("P")
T = TypeVar("T")

BLOCK_BYTES = 2**27
"""Bytes of the rows that are read at once when columns are picked."""
HUGE = 1e15
"""Weights beyond this are not forecast: squares of their steps leave the range of float32."""


@runtime_checkable
class Rows(Protocol):
    """A matrix (time, param) that is read when it is sliced: an array or a memory map."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Snapshots and parameters."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Element type."""

    def __getitem__(self, key: Any, /) -> Any:
        """Rows of a slice (and, after a comma, columns)."""


def while_open(function: Callable[Concatenate[Run, P], T]) -> Callable[Concatenate[Run, P], T]:
    """Keep what a function of a run returns as long as the run is open, for each argument.

    Of a run that grows in memory nothing is kept: it is another run after each snapshot.
    """
    known: WeakKeyDictionary[Run, dict[Any, T]] = WeakKeyDictionary()

    @functools.wraps(function)
    def kept(run: Run, /, *args: P.args, **options: P.kwargs) -> T:
        if isinstance(run, GrowingRun):
            return function(run, *args, **options)
        results, key = known.setdefault(run, {}), (args, *sorted(options.items()))
        if key not in results:
            results[key] = function(run, *args, **options)
        return results[key]

    return kept


@while_open
def weights_of(run: Run) -> Float32[np.ndarray, "time param"]:
    """Return the weights of a run: a read-only memory map, decoded when it is first needed.

    The snapshots of a run that is still being collected are read into memory instead: each state
    of a growing run would be another file in the cache. A run that grows in memory gives a view.

    Raises:
        CacheError: the cache's folder cannot be used.
        DamageError: the run is damaged.
    """
    if isinstance(run, GrowingRun):
        return run.rows
    if run.info.status == "complete":
        return CachedWeights(run).map()
    return np.asarray(run.weights[:], np.float32)


@while_open
def checksum_of(run: Run) -> str:
    """Return the SHA-256 (hex) of the checksums of a run's snapshots: equal weights, equal sum."""
    return hashlib.sha256(run["digest"][:].tobytes()).hexdigest()


@contextmanager
def cache_in(folder: Path) -> Iterator[None]:
    """Decode runs into another cache for a while: runs that are soon deleted, for example."""
    before = os.environ.get("WEIGHTTRAJ_CACHE")
    os.environ["WEIGHTTRAJ_CACHE"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["WEIGHTTRAJ_CACHE"]
        else:
            os.environ["WEIGHTTRAJ_CACHE"] = before


def stratified(
    tensor: Int[np.ndarray, " param"], limit: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " some"], Float[np.ndarray, " some"]]:
    """Draw about ``limit`` parameters, some of each tensor; return how many each stands for, too.

    The share of a tensor is that of its size, and at least half of an equal share.
    """
    size, tensors = len(tensor), int(tensor.max()) + 1
    chosen, counts = [], []
    for number in range(tensors):
        mine = np.flatnonzero(tensor == number)
        share = max(limit * len(mine) // size, limit // (2 * tensors), 1)
        some = np.sort(rng.permutation(mine)[:share]) if size > limit else mine
        chosen.append(some)
        counts.append(np.full(len(some), len(mine) / len(some)))
    return np.concatenate(chosen), np.concatenate(counts)


def columns_of(weights: Rows, columns: np.ndarray) -> Float32[np.ndarray, "time some"]:
    """Return some columns of all rows, read block by block."""
    rows = max(1, BLOCK_BYTES // (4 * weights.shape[1]))
    blocks = [weights[a : a + rows][:, columns] for a in range(0, weights.shape[0], rows)]
    return np.ascontiguousarray(np.concatenate(blocks))


def fault_of(weights: Rows) -> str | None:
    """Return why nothing can be forecast of these weights, in words; None: they are fine."""
    rows = max(1, BLOCK_BYTES // (4 * max(1, weights.shape[1])))
    moving = False
    for first in range(0, weights.shape[0], rows):
        block = np.asarray(weights[first : first + rows])
        bad = ~np.isfinite(block).all(axis=1)
        if bad.any():
            return f"NaN or infinity in snapshot {first + int(bad.argmax())}"
        large = np.abs(block).max(axis=1, initial=0) > HUGE
        if large.any():
            return f"a weight beyond {HUGE:g} in snapshot {first + int(large.argmax())}"
        moving = moving or bool((block != weights[0]).any())
    return None if moving else "its weights never change"


def without_faults(
    runs: Sequence[Run], fault: Callable[[Run], str | None]
) -> tuple[list[Run], dict[str, str]]:
    """Return the runs without a fault, and the faults of the others by id; warn of each."""
    found = [(run, fault(run)) for run in runs]
    faults = {run.id: why for run, why in found if why is not None}
    for run, why in faults.items():
        warn_left_out(run, why)
    return [run for run, why in found if why is None], faults


def warn_left_out(run: str, why: str) -> None:
    """Warn that a run, named by its id, is left out."""
    warnings.warn(f"run {run} is left out: {why}", LeftOutWarning, stacklevel=4)
