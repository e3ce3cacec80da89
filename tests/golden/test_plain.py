"""Files of format version 1 read by other libraries: nothing of ours is imported here."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr
import zarr
from zarr.storage import LocalStore, ZipStore

DATASET = Path(__file__).parent / "v1/dataset"
RUNS = {
    "default": DATASET / "runs/default.zarr.zip",
    "archive": DATASET / "runs/archive.zarr.zip",
    "folder": DATASET / "runs/folder.zarr",
}


def expected_weights(size: int) -> np.ndarray:
    row = (np.arange(size) % 251 - 125) / 64
    return (row + np.arange(20)[:, None] / 1024).astype(np.float32)


@pytest.fixture(params=RUNS)
def store(request: pytest.FixtureRequest) -> Iterator[Any]:
    path = RUNS[request.param]
    with warnings.catch_warnings():
        # Zarr warns that PCodec is in no specification.
        warnings.filterwarnings("ignore", "Numcodecs codecs are not in")
        opened = ZipStore(path) if path.is_file() else LocalStore(path, read_only=True)
        yield opened
        opened.close()


def test_plain_zarr_reads_a_run(store: Any) -> None:
    group = zarr.open(store, mode="r")
    weights = group["policy/weights"]
    values = weights[:]
    if weights.metadata.dimension_names[0] == "param":
        values = values.T
    info = group.attrs["weighttraj"]
    assert info["n_committed"] == 20
    assert np.array_equal(values, expected_weights(values.shape[1]))
    for row, digest in zip(values, group["digest"][:], strict=True):
        assert hashlib.sha256(np.ascontiguousarray(row)).digest() == digest.tobytes()
    assert np.array_equal(group["index/gradient_step"][:], 2 * np.arange(20))


def test_xarray_reads_a_run_as_a_tree(store: Any) -> None:
    with xr.open_datatree(store, engine="zarr") as tree:
        weights = tree["policy/weights"].transpose("time", "param").values
        assert np.array_equal(weights, expected_weights(weights.shape[1]))
        assert tree["index"].sizes["time"] == 20


def test_the_checksums_follow_from_the_text() -> None:
    text = (DATASET / "dataset.json").read_text()
    document = json.loads(text)
    stored = document.pop("sha256")
    plain = json.dumps(document, sort_keys=True, separators=(",", ":"))
    assert hashlib.sha256(plain.encode()).hexdigest() == stored
    for line in (DATASET / "MANIFEST.sha256").read_text().splitlines():
        sha256, size, path = line.split("  ")
        content = (DATASET / path).read_bytes()
        assert (hashlib.sha256(content).hexdigest(), len(content)) == (sha256, int(size))


def test_pandas_alone_reads_the_tables() -> None:
    runs = pd.read_parquet(DATASET / "tables/runs.parquet")
    assert runs[["run_id", "split", "n_params"]].values.tolist() == [
        ["default", "train", 14],
        ["archive", "validation", 14],
        ["folder", "test", 16_400],
    ]
    snapshots = pd.read_parquet(DATASET / "tables/snapshots.parquet")
    assert len(snapshots) == 60
    assert snapshots.query("run_id == 'archive' and t == 3").gradient_step.item() == 6


def test_h5py_alone_reads_the_file() -> None:
    with h5py.File(DATASET.parent / "dataset.h5") as file:
        assert json.loads(file["dataset.json"][()])["id"] == "golden"
        for name, size in (("default", 14), ("archive", 14), ("folder", 16_400)):
            assert np.array_equal(file[f"runs/{name}/policy/weights"][:], expected_weights(size))
