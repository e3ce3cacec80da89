"""``tables/*.parquet``: one row a run and one row a snapshot, readable by pandas alone."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from weighttraj.errors import missing_extra
from weighttraj.format.objects import sync
from weighttraj.format.reader import Dataset, Run

if TYPE_CHECKING:
    import pyarrow as pa

RUNS, SNAPSHOTS = "tables/runs.parquet", "tables/snapshots.parquet"

_ROWS = 64
"""Snapshots that are held at a time: of a large policy they fill memory."""


def write_tables(dataset: Dataset) -> None:
    """Write both tables of a data set.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
    except ModuleNotFoundError as error:
        raise missing_extra("pyarrow", "files") from error
    folder = Path(dataset.path)
    (folder / "tables").mkdir(exist_ok=True)
    runs = pa.Table.from_pylist([run_row(run) for run in dataset])
    if "final_mean_return" in runs.column_names:  # not a type of its own where all are null
        index = runs.column_names.index("final_mean_return")
        values = runs.column(index).cast(pa.float64())
        runs = runs.set_column(index, "final_mean_return", values)
    _write(folder / RUNS, runs)
    parts = [pa.table(snapshot_columns(run)) for run in dataset]
    _write(folder / SNAPSHOTS, pa.concat_tables(parts, promote_options="default"))


def run_row(run: Run) -> dict[str, Any]:
    """What the table of runs says of one."""
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
    return row | {f"hyperparameters.{name}": value for name, value in plain.items()}


def snapshot_columns(run: Run) -> dict[str, Any]:
    """What the table of snapshots says of a run: every array with one number a snapshot.

    Masked values are null in the table.
    """
    weights = run.weights
    norms, steps, last = [], [], None
    for start in range(0, len(run), _ROWS):
        rows = weights[start : start + _ROWS].astype(np.float64)
        norms.append(np.linalg.norm(rows, axis=1))
        steps.append(
            np.linalg.norm(
                np.diff(rows, axis=0, prepend=rows[:1] if last is None else last), axis=1
            )
        )
        last = rows[-1:]
    scalars = {
        name.removeprefix("index/").replace("/", "."): array[:]
        for name, array in run.arrays.items()
        if array.dims == ("time",)
    }
    return {
        "run_id": [run.id] * len(run),
        "t": np.arange(len(run)),
        **scalars,
        "weight_norm": np.concatenate(norms) if norms else np.zeros(0),
        "step_norm": np.concatenate(steps) if steps else np.zeros(0),
        "mean_return_deterministic": _mean_returns(run, deterministic=True),
        "mean_return_sampled": _mean_returns(run, deterministic=False),
    }


def _mean_returns(run: Run, *, deterministic: bool) -> np.ma.MaskedArray[Any, Any]:
    """Mean return of each snapshot over the episodes of a mode, masked where it has none."""
    if run.evaluation is None or deterministic not in run.evaluation.deterministic:
        return np.ma.masked_invalid(np.full(len(run), np.nan))
    return np.ma.masked_invalid(run.mean_return(deterministic))


def _write(path: Path, table: pa.Table) -> None:
    import pyarrow.parquet as pq

    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    try:
        pq.write_table(table, draft, compression="zstd")
        sync(draft)
        draft.replace(path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            draft.unlink()
    sync(path.parent)
