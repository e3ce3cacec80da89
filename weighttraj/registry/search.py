"""Runs of all data sets, by what they are."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from weighttraj.errors import DamageError, RegistryError, WeightTrajError, missing_extra
from weighttraj.format import open_dataset
from weighttraj.format.tables import RUNS, run_row
from weighttraj.registry.local import LocalDataset, local_datasets

if TYPE_CHECKING:
    import pandas as pd


def search(
    query: str = "",
    datasets: Iterable[LocalDataset] | None = None,
    *,
    damaged: Callable[[WeightTrajError], object] | None = None,
) -> pd.DataFrame:
    """Runs that fit a condition, over all data sets that are here.

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
    try:
        import pandas as pd
        import pyarrow  # noqa: F401  pandas needs it for the tables
    except ModuleNotFoundError as error:
        raise missing_extra(str(error.name), "sb3") from error
    tables = []
    for dataset in local_datasets() if datasets is None else datasets:
        try:
            table = _table(dataset.path)
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


def _table(path: Path) -> pd.DataFrame:
    """The runs of a data set."""
    import pandas as pd

    file = path / RUNS
    if not file.is_file():  # a data set that is still being collected has no table yet
        return pd.DataFrame([run_row(run) for run in open_dataset(path)])
    try:
        return pd.read_parquet(file)
    except Exception as error:  # pyarrow's and pandas', which are of every kind
        raise DamageError(
            "the table of a data set's runs cannot be read",
            got=error,
            where=file,
            do="restore it from a copy, or give the data set another place",
        ) from error


__all__ = ["search"]
