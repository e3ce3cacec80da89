"""Turns a trainer's values into arrays of the stored types, and refuses what would change."""

from __future__ import annotations

from typing import Any

import numpy as np

from weighttraj.errors import SnapshotError


def as_array(value: Any, dtype: str, where: str) -> np.ndarray:
    """Return a copy of a value as an array of a stored type.

    Tensors may require a gradient, lie on any device, and have any real type: float16 and bfloat16
    fit into float32 exactly, float64 is rounded to it.

    Args:
        value: a number, a nested list, an array or a tensor.
        dtype: the stored type: ``float32``, ``float64``, ``int64`` or ``uint8``.
        where: name of the array or parameter, for the error.

    Raises:
        SnapshotError: the value is no array of real numbers, or the stored type cannot hold them:
            fractions or numbers beyond 64 bits in a counter, finite numbers beyond float32.
    """
    if type(value) is np.ndarray and value.dtype == dtype:
        return value.copy()
    source = _as_numpy(value, dtype, where)
    real = source.dtype.kind in "biuf" or np.can_cast(source.dtype, np.float32)  # of ml_dtypes
    if not real or (np.ma.isMaskedArray(value) and np.ma.getmaskarray(value).any()):
        raise _error("a value of the snapshot does not consist of real numbers", source, where)
    with np.errstate(over="ignore", invalid="ignore"):
        array = source.astype(dtype)
    if array.dtype.kind in "iu":
        if not np.array_equal(array, source):
            raise _error("a counter of the snapshot is not an integer of 64 bits", source, where)
    elif array.itemsize < source.itemsize and (np.isinf(array) & np.isfinite(source)).any():
        raise _error(f"a value of the snapshot is too large for {dtype}", source, where)
    return array


def _as_numpy(value: Any, dtype: str, where: str) -> np.ndarray:
    """Return the value as a NumPy array of its own type."""
    try:
        if hasattr(value, "detach"):  # a PyTorch tensor, which this module does not import
            value = value.detach()
            narrow = value.is_floating_point() and value.element_size() < 4
            return np.asarray((value.float() if narrow else value).numpy(force=True))
        return np.asarray(value)
    except Exception as error:  # whatever the object's own conversion raises
        raise SnapshotError(
            "a value of the snapshot cannot be read as an array",
            expected=f"numbers that become {dtype}: an array, a tensor or a list",
            got=f"{type(value).__name__}: {error}",
            where=where,
            do="convert the value to a NumPy array of float32 first",
        ) from error


def _error(what: str, source: np.ndarray, where: str) -> SnapshotError:
    shown = source.reshape(-1)[:1].tolist() if source.size else []
    return SnapshotError(
        what,
        expected="real numbers: whole ones of at most 64 bits in counters, below 3.4e38 in weights",
        got=f"{source.dtype} {source.shape}, beginning with {str(shown)[:80]}",
        where=where,
        do="convert the value before it is handed over",
    )
