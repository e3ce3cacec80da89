"""Runs as tables of pandas, and as data sets of xarray."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from weighttraj.errors import needs

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from weighttraj.run import Run, StoredArray

HYPERPARAMETER = "hyperparameters."
"""Prefix of the columns that hold hyper-parameters."""

MEAN_RETURNS = ("mean_return_deterministic", "mean_return_sampled")
"""Columns of mean returns; NaN where a snapshot was not evaluated in that mode."""

_ROWS = 64
"""Snapshots that are in memory at a time."""
_COLUMNS = 8192
"""Parameters that are in memory as float64 at a time."""


def runs_frame(runs: Sequence[Run]) -> pd.DataFrame:
    """Return a table with a row for each run: id, split, seed, sizes, returns, hyper-parameters."""
    rows = [run_row(run) for run in runs]
    frame: pd.DataFrame = _pandas().DataFrame(rows, columns=None if rows else ["run_id"])
    return frame.set_index("run_id")


def snapshots_frame(run: Run) -> pd.DataFrame:
    """Return a table with a row for each snapshot: counters, diagnostics, mean returns."""
    frame: pd.DataFrame = _pandas().DataFrame(snapshot_columns(run))
    return frame.set_index("t")


def run_row(run: Run) -> dict[str, Any]:
    """Return what a table of runs says of one run."""
    info = run.info
    row = {
        "run_id": run.id,
        "split": run.split,
        "seed": info.seed,
        "env": info.env.id if info.env else None,
        "algorithm": info.algorithm.name if info.algorithm else None,
        "status": info.status,
        "n_snapshots": len(run),
        "n_params": run.layout.size,
        "num_timesteps": int(run.num_timesteps[-1]) if len(run) else 0,
        "final_return": run.final_return,
        "final_mean_return": None if np.isnan(run.final_mean_return) else run.final_mean_return,
        "created": info.provenance.created,
    }
    hyperparameters = info.algorithm.hyperparameters if info.algorithm else {}
    plain = {k: v for k, v in hyperparameters.items() if isinstance(v, bool | int | float | str)}
    return row | {f"{HYPERPARAMETER}{name}": value for name, value in plain.items()}


def snapshot_columns(run: Run) -> dict[str, Any]:
    """Return every array of a run that has one number a snapshot, and the mean returns."""
    scalars = {
        name.removeprefix("index/").replace("/", "."): array[:]
        for name, array in run.arrays.items()
        if array.dims == ("time",)
    }
    means = zip(MEAN_RETURNS, (True, False), strict=True)
    return {
        "t": np.arange(len(run)),
        **scalars,
        **{name: _mean_returns(run, deterministic=mode) for name, mode in means},
    }


def step_sizes(run: Run) -> dict[str, np.ndarray]:
    """Return the Euclidean norm of each snapshot's weights and of the step to it, float64 (time,).

    All weights are read.
    """
    norms, steps, last = [np.zeros(0)], [np.zeros(0)], None
    for start in range(0, len(run), _ROWS):
        rows = run.weights[start : start + _ROWS].astype(np.float64)
        before = rows[:1] if last is None else last
        norms.append(np.linalg.norm(rows, axis=1))
        steps.append(np.linalg.norm(np.diff(rows, axis=0, prepend=before), axis=1))
        last = rows[-1:]
    return {"weight_norm": np.concatenate(norms), "step_norm": np.concatenate(steps)}


def distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the L2 distance of two snapshots in float64; NaN if one of them is not finite."""
    total = 0.0
    for start in range(0, len(one), _COLUMNS):
        part = slice(start, start + _COLUMNS)
        with np.errstate(invalid="ignore"):
            difference = one[part].astype(np.float64) - other[part]
        total += float(difference @ difference)
    return math.sqrt(total) if math.isfinite(total) else math.nan


def _mean_returns(run: Run, *, deterministic: bool) -> np.ndarray:
    """Return the mean return of each snapshot over episodes of a mode; NaN where there is none."""
    if run.evaluation is None or deterministic not in run.evaluation.deterministic:
        return np.full(len(run), np.nan)
    return run.mean_return(deterministic)


def run_dataset(run: Run) -> xr.Dataset:
    """Return a run as an xarray data set whose arrays are read when they are used.

    Variables have the names of ``run.keys()``. Snapshots have the coordinate ``num_timesteps``,
    parameters the coordinate ``tensor``, the name of the tensor that each belongs to.
    """
    with needs("files"):
        import xarray as xr
    tensors = np.concatenate([np.full(p.size, p.name) for p in run.layout.params])
    return xr.Dataset(
        {name: (array.dims, _lazy(array)) for name, array in run.arrays.items()},
        coords={"num_timesteps": ("time", run.num_timesteps), "tensor": ("param", tensors)},
        attrs={"run": run.id, "split": run.split, "path": str(run.path)},
    )


def _lazy(array: StoredArray) -> Any:
    """Return an array that xarray reads when a value is asked for."""
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class Lazy(BackendArray):
        shape, dtype = array.shape, array.dtype

        def __getitem__(self, key: Any) -> Any:
            support = indexing.IndexingSupport.OUTER_1VECTOR
            return indexing.explicit_indexing_adapter(key, self.shape, support, array.__getitem__)

    return indexing.LazilyIndexedArray(Lazy())


def _pandas() -> Any:
    with needs("files"):
        import pandas as pd
    return pd
