"""The tables of a data set: their schema, and that they say what the runs say."""

from __future__ import annotations

import shutil
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import weighttraj as wt
from tests.benchmarks.stress_format import live_copy
from weighttraj import registry
from weighttraj.errors import DamageError
from weighttraj.registry.local import LocalDataset
from weighttraj.store.catalog import write_manifest
from weighttraj.store.live import LiveStore
from weighttraj.tools.tables import RUNS, SNAPSHOTS, read_table


@pytest.fixture
def dataset(small_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_dataset, tmp_path / "set"))


def of_runs(small_dataset: Path, tmp_path: Path, *settings: dict[str, Any], seed: Any = 0) -> Path:
    """A data set of short runs that have these hyper-parameters."""
    run = wt.open(small_dataset).runs[0]
    for i, hyperparameters in enumerate(settings):
        path = tmp_path / f"run{i}.zarr"
        live_copy(run, path, 8, 1, "complete")
        store = LiveStore.open(path)
        assert store.info.algorithm is not None
        algorithm = replace(store.info.algorithm, hyperparameters=hyperparameters)
        store.commit(replace(store.info, run_id=f"run{i}", seed=seed, algorithm=algorithm))
    paths = [tmp_path / f"run{i}.zarr" for i in range(len(settings))]
    return Path(registry.create(paths, tmp_path / "new").path)


@pytest.mark.parametrize(
    ("values", "kind", "stored"),
    [
        (["auto", 0.1], "string", ["auto", "0.1"]),
        ([1, 0.5], "double", [1.0, 0.5]),
        ([True, False], "bool", [True, False]),
        ([True, 2], "string", ["true", "2"]),
        ([2**63, 1], "string", [str(2**63), "1"]),
        ([-(2**63), 2**63 - 1], "int64", [-(2**63), 2**63 - 1]),
        ([2**53 + 1, 0.5], "string", [str(2**53 + 1), "0.5"]),
        ([10**400, 0.5], "string", [str(10**400), "0.5"]),
        ([None, 3], "int64", [None, 3]),
    ],
)
def test_hyperparameters_of_any_kind_have_a_column(
    values: list[Any], kind: str, stored: list[Any], small_dataset: Path, tmp_path: Path
) -> None:
    settings = [{} if value is None else {"x": value} for value in values]
    path = of_runs(small_dataset, tmp_path, *settings)
    column = pq.read_table(path / RUNS).column("hyperparameters.x")
    assert str(column.type) == kind
    assert column.to_pylist() == stored
    assert wt.verify(path) == []
    assert len(registry.search(datasets=[LocalDataset("new", path)])) == len(values)


@pytest.mark.parametrize(
    ("seed", "kind", "stored"), [(None, "int64", None), (2**70, "string", str(2**70))]
)
def test_a_seed_of_any_size_or_none_is_stored(
    seed: int | None, kind: str, stored: Any, small_dataset: Path, tmp_path: Path
) -> None:
    path = of_runs(small_dataset, tmp_path, {}, seed=seed)
    column = pq.read_table(path / RUNS).column("seed")
    assert str(column.type) == kind
    assert column.to_pylist() == [stored]
    assert wt.verify(path) == []


def forge(path: Path, name: str, change: Callable[[pa.Table], pa.Table], **options: Any) -> None:
    """Replace a table, and make the manifest right again, as whoever forges it can."""
    pq.write_table(change(pq.read_table(path / name)), path / name, **options)
    write_manifest(path)


def put(name: str, value: Any) -> Callable[[pa.Table], pa.Table]:
    """The first value of a column is another one."""

    def change(table: pa.Table) -> pa.Table:
        values = table.column(name).to_pylist()
        index = table.column_names.index(name)
        new = pa.array([value, *values[1:]], table.column(name).type)
        return table.set_column(index, name, new)

    return change


CONTRADICTIONS: dict[str, tuple[str, Callable[[pa.Table], pa.Table], str]] = {
    "a return": (RUNS, put("final_return", 1e9), "column final_return, row 0: 1000000000.0"),
    "an id": (RUNS, put("run_id", "seed9999"), "column run_id, row 0: 'seed9999'"),
    "a setting": (RUNS, put("hyperparameters.gamma", 0.0), "hyperparameters.gamma, row 0: 0.0"),
    "a counter": (SNAPSHOTS, put("num_timesteps", 7), "column num_timesteps, row 0: 7"),
    "a norm": (SNAPSHOTS, put("weight_norm", 7.0), "column weight_norm, row 0: 7.0"),
    "a null": (SNAPSHOTS, put("weight_norm", None), "column weight_norm, row 0: None"),
    "a column": (
        RUNS,
        lambda t: t.append_column("dataset", pa.array(["x"] * len(t))),
        "column dataset: the runs have no such values",
    ),
    "a row less": (RUNS, lambda t: t.slice(1), "got: 3 rows"),
    "a row more": (SNAPSHOTS, lambda t: pa.concat_tables([t, t.slice(0, 1)]), "rows"),
    "another order": (RUNS, lambda t: t.take(pa.array([1, 0, 2, 3])), "column run_id, row 0"),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_a_table_that_contradicts_the_runs_is_named_and_mended(dataset: Path, case: str) -> None:
    name, change, message = CONTRADICTIONS[case]
    before = {n: (dataset / n).read_bytes() for n in (RUNS, SNAPSHOTS)}
    forge(dataset, name, change)
    problem = wt.verify(dataset)[0]
    assert message in problem
    assert str(dataset / name) in problem
    wt.repair(dataset)
    assert wt.verify(dataset) == []
    assert {n: (dataset / n).read_bytes() for n in before} == before


def test_a_column_that_an_older_version_did_not_write_is_no_contradiction(dataset: Path) -> None:
    forge(dataset, RUNS, lambda table: table.drop_columns(["created", "hyperparameters.gamma"]))
    assert wt.verify(dataset) == []


def test_a_strangers_columns_do_not_spoil_a_search(dataset: Path, small_dataset: Path) -> None:
    def change(table: pa.Table) -> pa.Table:
        for name in ("dataset", "index", "x\x1b[2J"):
            table = table.append_column(name, pa.array(["theirs"] * len(table)))
        return table

    forge(dataset, RUNS, change)
    both = [LocalDataset("theirs", dataset), LocalDataset("ours", small_dataset)]
    found = registry.search("dataset == 'ours' and seed == 1", both)
    assert found["run_id"].tolist() == ["seed0001"]
    assert "index" not in found.columns


LARGE = 200_000_000
"""Bytes that a table of these would take."""


def long_text(table: pa.Table) -> pa.Table:
    return put("env", "x" * LARGE)(table)


def text_for_each_row(table: pa.Table) -> pa.Table:
    """One text, stored once, in each of many rows."""
    text = "x" * (LARGE // len(table))
    index = table.column_names.index("run_id")
    return table.set_column(index, "run_id", pa.array([text] * len(table)))


def of_rows(n: int) -> Callable[[pa.Table], pa.Table]:
    return lambda table: pa.table({name: [None] * n for name in table.column_names})


BOMBS: dict[str, Callable[[pa.Table], pa.Table]] = {
    "a long text": long_text,
    "a text for each row": text_for_each_row,
    "millions of rows": of_rows(5_000_000),
    "lists": lambda t: t.set_column(0, "run_id", pa.array([[0] * 10**6] * len(t))),
    "two columns of one name": lambda t: t.append_column("seed", t.column("seed")),
    "a table of something else": lambda t: pa.table({"x": [1] * len(t)}),
}


@pytest.mark.parametrize("name", [RUNS, SNAPSHOTS])
@pytest.mark.parametrize("case", BOMBS)
def test_a_table_that_explodes_is_refused(dataset: Path, case: str, name: str) -> None:
    if case == "a text for each row" and name == SNAPSHOTS:
        pytest.skip("within what so many rows may have")
    if name == SNAPSHOTS and case in ("a long text", "two columns of one name"):
        columns = {"a long text": "run_id", "two columns of one name": "seed"}
        pytest.skip(f"snapshots have no {columns[case]} of this kind")
    forge(dataset, name, BOMBS[case], compression="zstd")
    assert (dataset / name).stat().st_size < 2_000_000
    rows = 4 if name == RUNS else sum(map(len, wt.open(dataset)))
    pool = pa.default_memory_pool()
    before = pool.max_memory()
    tracemalloc.start()
    if case == "a table of something else":
        assert read_table(dataset, name, rows).column_names == ["x"]
    else:
        with pytest.raises(DamageError, match="what it should be"):
            read_table(dataset, name, rows)
    assert tracemalloc.get_traced_memory()[1] < 30_000_000
    tracemalloc.stop()
    assert pool.max_memory() <= max(before, 64 << 20)
    assert any(str(dataset / name) in problem for problem in wt.verify(dataset))


@pytest.mark.parametrize(
    "content", [b"", b"PAR1", b"PAR1" * 9, b"\0" * 999, b"PAR1\xff\xff\xff\x7fPAR1"]
)
def test_what_is_no_table_is_damage(dataset: Path, content: bytes) -> None:
    (dataset / RUNS).write_bytes(content)
    with pytest.raises(DamageError):
        registry.search(datasets=[LocalDataset("set", dataset)])
    write_manifest(dataset)
    assert any(RUNS in problem for problem in wt.verify(dataset))


def test_a_flipped_bit_of_a_table_ends_in_damage_or_in_values(tmp_path: Path) -> None:
    (tmp_path / RUNS).parent.mkdir()
    pq.write_table(pa.table({"run_id": ["a", "b"]}), tmp_path / RUNS, compression="zstd")
    whole = (tmp_path / RUNS).read_bytes()
    refused = 0
    for byte in range(len(whole)):
        for bit in range(8):
            content = bytearray(whole)
            content[byte] ^= 1 << bit
            (tmp_path / RUNS).write_bytes(content)
            try:
                assert len(read_table(tmp_path, RUNS, 2).to_pylist()) == 2
            except DamageError:
                refused += 1
    assert refused > len(whole)
