"""``tables/*.parquet``: one row a run and one row a snapshot, readable by pandas alone."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from weighttraj.atomic import replacing
from weighttraj.dataset import Dataset
from weighttraj.errors import DamageError, FormatError, MissingExtraError, needs
from weighttraj.frames import MEAN_RETURNS, run_row, snapshot_columns, step_sizes
from weighttraj.store.objects import FolderObjects
from weighttraj.text import printable, shortened

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from weighttraj.run import Run

RUNS, SNAPSHOTS = "tables/runs.parquet", "tables/snapshots.parquet"

_BASE_BYTES, _ROW_BYTES = 16 << 20, 4 << 10
"""Decoded bytes that a table may have, and more for each of its rows."""

RUN_COLUMNS = {
    "run_id": "string",
    "split": "string",
    "seed": "int64",
    "env": "string",
    "algorithm": "string",
    "status": "string",
    "n_snapshots": "int64",
    "n_params": "int64",
    "num_timesteps": "int64",
    "final_return": "double",
    "final_mean_return": "double",
    "created": "string",
}
"""Columns of the table of runs, and their Arrow types; hyper-parameters follow."""

_NORMS = ("weight_norm", "step_norm")
"""Columns that are computed, and may differ in the last digits on another machine."""


def write_tables(dataset: Dataset) -> None:
    """Write both tables of a data set.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """
    folder = Path(dataset.path)
    _write(folder, RUNS, runs_table(dataset))
    _write(folder, SNAPSHOTS, snapshots_table(dataset))


def runs_table(dataset: Dataset) -> pa.Table:
    """Return the table of runs, one row each.

    A seed or hyper-parameter has the type of its values: truth values, 64-bit integers, or floats,
    which hold integers too. Where the values have several kinds, or do not fit, it is text.
    """
    pa = _pyarrow()
    rows = [run_row(run) for run in dataset]
    names = dict.fromkeys([*RUN_COLUMNS, *(name for row in rows for name in row)])
    columns = {name: [row.get(name) for row in rows] for name in names}
    arrays = {
        name: _free(values, "int64")
        if name == "seed" or name not in RUN_COLUMNS
        else pa.array(values, RUN_COLUMNS[name])
        for name, values in columns.items()
    }
    return pa.table(arrays)


def snapshots_table(dataset: Dataset) -> pa.Table:
    """The table of snapshots, one row each; runs lack values of arrays that they do not store."""
    pa = _pyarrow()
    parts = [pa.table(_snapshot_columns(run)) for run in dataset]
    if not parts:
        return pa.table({"run_id": pa.array([], "string"), "t": pa.array([], "int64")})
    return pa.concat_tables(parts, promote_options="default")


def _snapshot_columns(run: Run) -> dict[str, Any]:
    """Return the columns of one run: norms of the weights too, masked values for nulls."""
    columns = snapshot_columns(run)
    means = {n: np.ma.masked_invalid(columns.pop(n)) for n in MEAN_RETURNS}
    return {"run_id": [run.id] * len(run), **columns, **step_sizes(run), **means}


def _free(values: list[Any], otherwise: str) -> pa.Array:
    """Return a column of values of any kind.

    >>> _free([1, 0.5], "int64").to_pylist(), _free(["auto", 0.5], "int64").to_pylist()
    ([1.0, 0.5], ['auto', '0.5'])
    """
    pa = _pyarrow()
    there = [value for value in values if value is not None]
    kinds = {type(value) for value in there}
    if not kinds:
        return pa.array(values, otherwise)
    if kinds == {bool}:
        return pa.array(values, "bool")
    if kinds == {int} and all(-(2**63) <= value < 2**63 for value in there):
        return pa.array(values, "int64")
    if kinds <= {int, float} and float in kinds and all(map(_is_exact, there)):
        return pa.array([None if v is None else float(v) for v in values], "double")
    texts = [v if v is None or isinstance(v, str) else json.dumps(v) for v in values]
    return pa.array(texts, "string")


def _is_exact(value: int | float) -> bool:
    """Return whether a float holds a number exactly."""
    return isinstance(value, float) or (abs(value) < 2**1023 and int(float(value)) == value)


def _pyarrow() -> Any:
    with needs("files"):
        import pyarrow
    return pyarrow


def read_table(folder: Path, name: str, rows: int) -> pa.Table:
    """Read a table of a data set, which may be a stranger's: nothing large is decoded.

    Args:
        folder: the data set's.
        name: ``RUNS`` or ``SNAPSHOTS``.
        rows: how many it must have.

    Raises:
        DamageError: it cannot be read, or is no such table.
        FormatError: it is a link.
        MissingExtraError: pyarrow is not installed.
    """
    _pyarrow()
    import pyarrow.parquet as pq

    file, limit = FolderObjects(folder).file(name), _BASE_BYTES + rows * _ROW_BYTES
    with _readable(file, f"{rows} rows, at most {limit:,} bytes of numbers and text"):
        if os.path.getsize(file) > limit:
            raise ValueError(f"a file of {os.path.getsize(file)} bytes")
        with pq.ParquetFile(file) as stored:
            texts = _checked(stored, rows, limit)
        # Equal texts stay one text until their sizes are known.
        with pq.ParquetFile(file, read_dictionary=texts) as stored:
            table = stored.read(use_threads=False)
        for text in texts:
            table = _decoded(table, text, limit)
        if len(table) != rows:
            raise ValueError(f"{len(table)} rows")
        table.validate(full=True)  # damaged text may not be UTF-8
    return table.replace_schema_metadata(None)  # what pandas wrote there is not needed


def read_schema(folder: Path, name: str) -> pa.Schema:
    """Read the columns of a table of a data set; the errors are those of ``read_table``."""
    _pyarrow()
    import pyarrow.parquet as pq

    file = FolderObjects(folder).file(name)
    with _readable(file, "a Parquet file"):
        return pq.read_schema(file)


@contextlib.contextmanager
def _readable(file: str, expected: str) -> Iterator[None]:
    """Read a table inside; whatever Arrow raises is damage."""
    try:
        yield
    except (_pyarrow().ArrowException, ValueError, OSError, MemoryError) as error:
        raise DamageError(
            "a table of the data set is damaged, or not what it should be",
            expected=expected,
            got=error,
            where=file,
            do="write it again: weighttraj repair",
        ) from error


def _checked(stored: pq.ParquetFile, rows: int, limit: int) -> list[str]:
    """Look at a table's metadata; returns the names of the columns of text.

    Raises:
        ValueError: it is no flat table of so many rows, or too large.
    """
    pa = _pyarrow()
    metadata, schema = stored.metadata, stored.schema_arrow
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    # Sizes of whole row groups: ``group.column(i)`` ends the process where the metadata is damaged.
    sizes = [group.total_byte_size for group in groups]
    if metadata.num_rows != rows or sum(group.num_rows for group in groups) != rows:
        raise ValueError(f"{metadata.num_rows} rows")
    if min(sizes, default=0) < 0 or sum(sizes) > limit:
        raise ValueError(f"row groups of {sizes[:5]} bytes")
    plain = (
        pa.types.is_boolean,
        pa.types.is_integer,
        pa.types.is_floating,
        pa.types.is_string,
        pa.types.is_null,
    )
    odd = [field.name for field in schema if not any(is_plain(field.type) for is_plain in plain)]
    if odd or len(set(schema.names)) < len(schema.names):
        raise ValueError(f"columns of other types, or twice the same: {(odd or schema.names)[:5]}")
    return [field.name for field in schema if pa.types.is_string(field.type)]


def _decoded(table: pa.Table, name: str, limit: int) -> pa.Table:
    """Return a table with a column of text as plain text.

    Raises:
        ValueError: that would be too large.
    """
    import pyarrow.compute as pc

    index, column = table.column_names.index(name), table.column(name)
    sizes = (pc.max(pc.binary_length(chunk.dictionary)).as_py() for chunk in column.chunks)
    longest = max((size or 0 for size in sizes), default=0)
    if longest * len(table) > limit:
        raise ValueError(f"texts of {longest} bytes in {len(table)} rows")
    return table.set_column(index, name, column.cast("string"))


def check_tables(dataset: Dataset) -> list[str]:
    """Say where the tables of a complete data set contradict its runs.

    A column that a table lacks is no contradiction: an older version wrote it. Without pyarrow
    nothing is compared.
    """
    try:
        _pyarrow()
    except MissingExtraError:
        return []
    folder = Path(dataset.path)
    problems: list[str] = []
    for name, table in ((RUNS, runs_table), (SNAPSHOTS, snapshots_table)):
        if os.path.lexists(folder / name):
            problems += _contradictions(folder, name, table(dataset))
    return problems


def _contradictions(folder: Path, name: str, expected: pa.Table) -> Iterator[str]:
    try:
        stored = read_table(folder, name, len(expected))
    except FormatError as error:
        yield str(error)
        return
    mend = "(weighttraj repair writes it again)"
    for column in stored.column_names:
        where = f"{folder / name}, column {printable(shortened(column, 100))}"
        if column not in expected.column_names:
            yield f"{where}: the runs have no such values {mend}"
            continue
        rows = _differing(stored.column(column), expected.column(column), column in _NORMS)
        if len(rows):
            row = int(rows[0])
            got, want = (
                printable(shortened(repr(t.column(column)[row].as_py()), 100))
                for t in (stored, expected)
            )
            yield f"{where}, row {row}: {got}, but the runs say {want} {mend}"


def _differing(one: pa.ChunkedArray, other: pa.ChunkedArray, computed: bool) -> np.ndarray:
    """Rows in which two columns differ; where numbers are computed, by more than rounding does."""
    pa = _pyarrow()
    if all(pa.types.is_floating(column.type) for column in (one, other)):
        a, b = one.to_numpy(), other.to_numpy()  # null becomes NaN
        with np.errstate(invalid="ignore"):
            same = np.isclose(a, b, rtol=1e-9, atol=0) if computed else a == b
        return np.flatnonzero(~(same | (np.isnan(a) & np.isnan(b))))
    if one.equals(other):
        return np.zeros(0, int)
    pairs = zip(one.to_pylist(), other.to_pylist(), strict=True)
    return np.flatnonzero([a != b for a, b in pairs])


def _write(folder: Path, name: str, table: pa.Table) -> None:
    import pyarrow.parquet as pq

    with replacing(folder / name, root=folder) as file:
        pq.write_table(table, file, compression="zstd")
