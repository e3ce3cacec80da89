"""FORMAT.md is in step with the code: its tables are read and compared."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import weighttraj.format
from tests.golden.make import INFO
from weighttraj.format import FORMAT_VERSION, DatasetInfo, Evaluation, RunEntry, RunInfo
from weighttraj.format.schema import arrays_of
from weighttraj.store.catalog import DATASET, MANIFEST
from weighttraj.store.codecs import KNOWN_CODECS, MAX_CHUNK_PARAMS, MAX_NARROW
from weighttraj.tools.tables import RUNS, SNAPSHOTS

SPEC = Path(weighttraj.format.__file__).with_name("FORMAT.md").read_text()


def table(first_heading: str) -> list[list[str]]:
    """Cells of the table whose header begins with a word."""
    lines = SPEC.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {first_heading} |"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def test_the_version() -> None:
    assert SPEC.startswith(f"# The weighttraj format, version {FORMAT_VERSION}\n")


def test_the_arrays() -> None:
    specified = {}
    for cells in table("array"):
        for name in names(cells[0]):
            specified[name] = (cells[1], tuple(cells[2].split(", ")))
    coded = {}
    evaluation = Evaluation(seeds=(0,), deterministic=(True,))
    for spec in arrays_of(dataclasses.replace(INFO, evaluation=evaluation)).values():
        name = "train/<name>" if spec.name.startswith("train/") else spec.name
        coded[name] = (spec.dtype, spec.dims)
    assert specified == coded


def test_the_codecs() -> None:
    assert {name for cells in table("codec") for name in names(cells[0])} == KNOWN_CODECS
    assert f"{MAX_CHUNK_PARAMS:,} columns" in SPEC
    assert f"up to {MAX_NARROW:,} parameters" in SPEC


def test_the_objects() -> None:
    objects = [name for cells in table("object") for name in names(cells[0])]
    assert {DATASET, MANIFEST, RUNS, SNAPSHOTS} < set(objects)
    for path in objects[1:3]:
        RunEntry(id="x", path=path.replace("<run id>", "x").rstrip("/"))


def test_the_metadata() -> None:
    for kind in (RunInfo, DatasetInfo, RunEntry, Evaluation):
        for field in dataclasses.fields(kind):
            assert f"`{field.name}`" in SPEC, f"{kind.__name__}.{field.name}"
