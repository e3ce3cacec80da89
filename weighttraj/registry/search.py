"""Runs of all data sets, by what they are."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from weighttraj.errors import RegistryError, WeightTrajError, needs
from weighttraj.frames import HYPERPARAMETER
from weighttraj.opening import open_dataset
from weighttraj.registry.local import LocalDataset, local_datasets
from weighttraj.tools.tables import RUN_COLUMNS, RUNS, read_table, runs_table

if TYPE_CHECKING:
    import pandas as pd


def search(
    query: str = "",
    datasets: Iterable[LocalDataset] | None = None,
    *,
    damaged: Callable[[WeightTrajError], object] | None = None,
) -> pd.DataFrame:
    """Return runs that fit a condition, over all data sets that are here.

    >>> search("env == 'HalfCheetah-v4' and final_return > 3000")  # doctest: +SKIP

    Args:
        query: a condition on the columns, in the language of ``pandas.DataFrame.query``; names
            with a point stand between backticks: ``hyperparameters.gamma``. Empty: all runs.
        datasets: where to look; None: in all of ``local_datasets()``.
        damaged: is told what is wrong with a data set that cannot be read, which is left out; None:
            that is raised.

    Returns:
        A row for each run: ``dataset``, and the columns of its table of runs.

    Raises:
        FormatError: a data set, or its table of runs, is damaged.
        RegistryError: the query cannot be understood, or names what no run has.
        MissingExtraError: pandas or pyarrow is not installed.
    """
    with needs("files"):
        import pandas as pd
        import pyarrow  # noqa: F401  pandas needs it for the tables
    tables = []
    for dataset in local_datasets() if datasets is None else datasets:
        try:
            table = _table(dataset)
        except WeightTrajError as error:
            if damaged is None:
                raise
            damaged(error)
            continue
        table.insert(0, "dataset", dataset.id)
        if len(table):
            tables.append(table.dropna(axis="columns", how="all"))
    if not tables:
        return pd.DataFrame()
    rows = pd.concat(tables, ignore_index=True)
    if not query:
        return rows
    try:
        fits = rows.eval(query, engine="python")
        if not isinstance(fits, pd.Series) or not pd.api.types.is_bool_dtype(fits):
            raise TypeError("this is no condition")
    except Exception as error:  # the parser's, Python's, numpy's: whatever a user can type
        raise RegistryError(
            "the query cannot be understood",
            expected=f"a condition on {', '.join(rows.columns)}",
            got=f"{query}: {error}",
            do="quote text, and put names with a point between backticks: "
            "\"env == 'HalfCheetah-v4' and `hyperparameters.gamma` < 1\"",
        ) from error
    return rows.loc[fits].reset_index(drop=True)


def _table(dataset: LocalDataset) -> pd.DataFrame:
    """Return the runs of a data set. Columns that the format does not have are left out."""
    if not os.path.lexists(dataset.path / RUNS):  # one that is still being collected has no table
        table = runs_table(open_dataset(dataset.path))
    else:
        table = read_table(dataset.path, RUNS, len(dataset.info.runs))
    known = [c for c in table.column_names if c in RUN_COLUMNS or c.startswith(HYPERPARAMETER)]
    frame: pd.DataFrame = table.select(known).to_pandas(ignore_metadata=True)
    return frame
