"""Runs as files for programs that do not know this package."""

from __future__ import annotations

import csv
import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file

import weighttraj as wt
from tests.store.test_store import LAYOUT, weights, write
from weighttraj.atomic import appearing
from weighttraj.errors import DamageError, StoreExistsError
from weighttraj.format import ParamLayout, RunInfo
from weighttraj.format.schema import to_json
from weighttraj.run import PIECE_BYTES
from weighttraj.tools.export import export_npy, export_safetensors
from weighttraj.writer import RunWriter


@pytest.fixture
def run(tmp_path: Path) -> wt.Run:
    return write(tmp_path / "run.zarr")


def test_numpy_alone_reads_the_files(run: wt.Run, tmp_path: Path) -> None:
    folder = export_npy(run, tmp_path / "npy")
    flat = np.load(folder / "weights.npy")
    assert flat.dtype == np.float32
    assert flat.tobytes() == weights(20).tobytes()
    with (folder / "layout.csv").open(newline="") as text:
        lines = list(csv.DictReader(text))
    assert lines == [{"name": "w", "shape": "3x4", "offset": "0", "size": "12", "role": "weight"}]
    table = np.genfromtxt(folder / "snapshots.csv", delimiter=",", names=True)
    assert table["t"].tolist() == list(range(20))
    scalars = {name: array for name, array in run.arrays.items() if array.dims == ("time",)}
    assert len(scalars) == 11
    for name, array in scalars.items():
        column = table[name.removeprefix("index/").replace("/", "_")]
        assert np.array_equal(column, array[:], equal_nan=True), name
    names = {p.name for p in folder.iterdir()}
    assert names == {
        *("weights.npy", "layout.csv", "snapshots.csv", "run.json", "digest.npy"),
        *("obs_norm.mean.npy", "obs_norm.var.npy", "critic.weights.npy", "probe.observations.npy"),
        *("optimizer.exp_avg.npy", "optimizer.exp_avg_sq.npy"),
    }
    for name in ("obs_norm/mean", "probe/observations", "digest"):
        loaded = np.load(folder / f"{name.replace('/', '.')}.npy")
        assert np.array_equal(loaded, run[name][:])
    assert json.loads((folder / "run.json").read_text()) == to_json(run.info)


def test_numbers_in_the_table_are_exact(full_run: wt.Run, tmp_path: Path) -> None:
    folder = export_npy(full_run, tmp_path / "npy")
    with (folder / "snapshots.csv").open(newline="") as text:
        lines = list(csv.DictReader(text))
    for name in ("train/approx_kl", "index/learning_rate", "obs_norm/count"):
        column = [float(line[name.removeprefix("index/").replace("/", "_")]) for line in lines]
        assert np.array_equal(column, full_run[name][:], equal_nan=True)


def test_long_runs_are_copied_in_pieces(tmp_path: Path) -> None:
    size = PIECE_BYTES // 16  # four rows a piece
    layout = ParamLayout.of({"w": ((size,), "other", ("fixed",))})
    rows = np.tile(weights(5, 1024), size // 1024)
    with RunWriter(tmp_path / "r.zarr", RunInfo(run_id="r", layout=layout, block=2)) as writer:
        for row in rows:
            writer.append(row, num_timesteps=0)
    folder = export_npy(wt.open_run(tmp_path / "r.zarr"), tmp_path / "npy")
    assert np.array_equal(np.load(folder / "weights.npy", mmap_mode="r"), rows)


def test_a_run_without_snapshots_gives_empty_files(tmp_path: Path) -> None:
    RunWriter(tmp_path / "r.zarr", RunInfo(run_id="r", layout=LAYOUT)).close()
    folder = export_npy(wt.open_run(tmp_path / "r.zarr"), tmp_path / "npy")
    assert np.load(folder / "weights.npy").shape == (0, 12)
    assert len((folder / "snapshots.csv").read_text().splitlines()) == 1


def test_names_from_the_metadata_are_no_paths(tmp_path: Path) -> None:
    honest, odd = write(tmp_path / "run.zarr")._store, "train/../../x,\n"

    class Hostile:
        """An array has another name, as in metadata that somebody made up."""

        path, info = honest.path, honest.info
        specs = honest.specs | {odd: replace(honest.specs["train/approx_kl"], name=odd)}

        def read(self, name: str, key: object) -> np.ndarray:
            return honest.read("train/approx_kl" if name == odd else name, key)

        def chunk_rows(self, name: str) -> int:
            return honest.chunk_rows("train/approx_kl" if name == odd else name)

    folder = export_npy(wt.Run(honest.path, Hostile), tmp_path / "deep" / "er" / "npy")
    assert {p.name for p in tmp_path.iterdir()} == {"run.zarr", "run.zarr.lock", "deep"}
    with (folder / "snapshots.csv").open(newline="") as text:
        assert next(csv.DictReader(text))["train_.._.._x,\n"] == "nan"


@pytest.mark.parametrize("t", [0, 7, -1])
def test_a_snapshot_as_safetensors(full_run: wt.Run, tmp_path: Path, t: int) -> None:
    path = export_safetensors(full_run, t, tmp_path / "snapshot.safetensors")
    tensors = load_file(path)
    assert full_run.layout.flatten(tensors).tobytes() == full_run.weights[t].tobytes()
    obs, ret = full_run.obs_norm(t), full_run.ret_norm(t)
    assert obs is not None
    assert ret is not None
    assert tensors["obs_norm/mean"].tobytes() == obs.mean.tobytes()
    assert tensors["obs_norm/var"].tobytes() == obs.var.tobytes()
    assert (tensors["obs_norm/count"], tensors["ret_norm/var"]) == (obs.count, ret.var)
    assert len(tensors) == len(full_run.layout.params) + 6
    with safe_open(path, "numpy") as file:
        metadata = file.metadata()
    assert metadata["run_id"] == full_run.id
    assert metadata["t"] == str(t % len(full_run))
    assert metadata["num_timesteps"] == str(full_run.num_timesteps[t])
    assert metadata["env_id"] == "InvertedPendulum-v4"
    assert json.loads(metadata["policy"])["activation"] == "tanh"
    assert json.loads(metadata["obs_norm"])["epsilon"] == 1e-8


def test_a_run_that_says_little_gives_tensors_too(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "r.zarr", RunInfo(run_id="r", layout=LAYOUT)) as writer:
        writer.append(weights(1)[0], num_timesteps=0)
    path = export_safetensors(wt.open_run(tmp_path / "r.zarr"), 0, tmp_path / "s.safetensors")
    tensors = load_file(path)
    assert list(tensors) == ["w"]
    assert hashlib.sha256(tensors["w"].tobytes()).digest() == bytes(
        wt.open_run(tmp_path / "r.zarr")["digest"][0]
    )
    with safe_open(path, "numpy") as file:
        assert file.metadata()["env_id"] == ""
        assert file.metadata()["obs_norm"] == "null"


def test_there_are_no_snapshots_beyond_the_last(run: wt.Run, tmp_path: Path) -> None:
    with pytest.raises(IndexError):
        export_safetensors(run, 20, tmp_path / "s.safetensors")
    assert not list(tmp_path.glob("*s.safetensors*"))


def test_what_exists_is_not_overwritten(run: wt.Run, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(StoreExistsError, match="a file"):
        export_npy(run, tmp_path / "mine")
    with pytest.raises(StoreExistsError, match="a file"):
        export_safetensors(run, 0, tmp_path / "mine")
    assert (tmp_path / "mine").read_text() == "mine"


def test_a_damaged_run_leaves_nothing(run: wt.Run, tmp_path: Path) -> None:
    chunk = run.path / "policy/weights/c/2/0"
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(DamageError):
        export_npy(run, tmp_path / "npy")
    assert {p.name for p in tmp_path.iterdir()} == {"run.zarr", "run.zarr.lock"}


def test_a_draft_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "thing"
    with pytest.raises(ZeroDivisionError), appearing(path) as draft:
        draft.mkdir()
        (draft / "half").write_text("half")
        raise ZeroDivisionError
    assert list((tmp_path / "new").iterdir()) == []
    with appearing(path) as draft:
        draft.mkdir()
        (draft / "whole").write_text("whole")
        assert not path.exists()
        left = draft
    assert (path / "whole").read_text() == "whole"
    left.mkdir(parents=True)  # as a killed process would have left it
    (left.parent / "lock").touch()
    (left / "half").write_text("half")
    (path / "whole").unlink()
    path.rmdir()
    with appearing(path) as draft:
        draft.write_text("a file")
    assert path.read_text() == "a file"
    assert not left.exists()
    with pytest.raises(StoreExistsError), appearing(tmp_path / "new" / "late") as draft:
        draft.write_text("ours")
        (tmp_path / "new" / "late").write_text("theirs")
    assert (tmp_path / "new" / "late").read_text() == "theirs"
