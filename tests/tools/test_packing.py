"""A packed run is the same run in one file, and our decoder reads what plain Zarr reads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zarr
from filelock import FileLock
from hypothesis import given, settings
from hypothesis import strategies as st
from zarr.storage import LocalStore, ZipStore

import weighttraj as wt
from tests.store.test_store import INFO, write
from weighttraj.errors import DamageError, FormatError
from weighttraj.format import ParamLayout, RunInfo
from weighttraj.store.objects import ZipObjects
from weighttraj.store.zarr_run import RunStore, group_document, member_documents
from weighttraj.tools.pack import cut, same_as_packed
from weighttraj.writer import RunWriter

PROFILES = ("default", "archive")


def wide(path: Path, n: int, columns: int, block: int = 4) -> wt.Run:
    layout = ParamLayout.of({"w": ((columns,), "other", ("fixed",))})
    rng = np.random.default_rng(0)
    with RunWriter(path, RunInfo(run_id="wide", layout=layout, block=block)) as writer:
        for t in range(n):
            writer.append(rng.normal(size=columns).astype(np.float32), num_timesteps=t)
    return wt.open_run(path)


@pytest.mark.parametrize("profile", PROFILES)
def test_packing_keeps_every_array_bit_by_bit(tmp_path: Path, profile: str) -> None:
    run = write(tmp_path / "run.zarr")
    path = wt.pack(run.path, profile=profile)
    assert path == tmp_path / "run.zarr.zip"
    packed = wt.open_run(path)
    assert packed.info == replace(run.info, profile=profile)
    assert packed.keys() == run.keys()
    for name, array in run.arrays.items():
        assert packed[name][:].tobytes() == array[:].tobytes(), name
    assert wt.verify(path) == []


def test_a_path_that_ends_in_a_slash_is_the_same(tmp_path: Path) -> None:
    run = write(tmp_path / "run.zarr")
    assert wt.pack(f"{run.path}/") == tmp_path / "run.zarr.zip"


def test_a_part_of_a_run_that_says_no_iterations(tmp_path: Path) -> None:
    run = wide(tmp_path / "run.zarr", 30, 5)
    assert run.iteration[:].tolist() == [-1] * 30
    part = wt.open_run(cut(run.path, tmp_path / "part.zarr.zip", steps=(10, 19)))
    np.testing.assert_array_equal(part.weights[:], run.weights[10:20])
    assert wt.verify(part.path) == []


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("columns", [16_384, 16_385, 40_000])
def test_wide_runs_are_packed_in_several_chunks(tmp_path: Path, profile: str, columns: int) -> None:
    run = wide(tmp_path / "wide.zarr", 70, columns)
    packed = wt.open_run(wt.pack(run.path, profile=profile))
    names = packed._store.objects.names
    assert sum(name.startswith("policy/weights/c/") for name in names) > 1
    assert np.array_equal(packed.weights[:], run.weights[:])
    assert np.array_equal(packed.weights[33:61], run.weights[33:61])
    assert np.array_equal(packed.weights[5:9, 16_380:16_384], run.weights[5:9, 16_380:16_384])
    assert np.array_equal(packed.weights[[3, 69]], run.weights[[3, 69]])
    assert np.array_equal(packed.weights[-1], run.weights[-1])


def by_zarr(path: Path) -> np.ndarray:
    """Weights (time, param) as plain Zarr reads them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Numcodecs codecs are not in")
        store = ZipStore(path) if path.is_file() else LocalStore(path, read_only=True)
        array = zarr.open(store, mode="r")["policy/weights"]
        values = array[:]
        store.close()
        return values.T if array.metadata.dimension_names[0] == "param" else values


@settings(max_examples=25, deadline=None)
@given(
    n=st.integers(1, 30),
    columns=st.sampled_from([1, 3, 1025]),
    block=st.integers(1, 9),
    profile=st.sampled_from(PROFILES),
    data=st.data(),
)
def test_both_decoders_give_the_same_rows(
    tmp_path_factory: pytest.TempPathFactory,
    n: int,
    columns: int,
    block: int,
    profile: str,
    data: st.DataObject,
) -> None:
    run = wide(tmp_path_factory.mktemp("wide") / "w.zarr", n, columns, block)
    start = data.draw(st.integers(0, n))
    stop = data.draw(st.integers(start, n))
    low = data.draw(st.integers(0, columns - 1))
    rows = np.array(data.draw(st.lists(st.integers(0, n - 1), min_size=1, max_size=5)))
    for path in (run.path, wt.pack(run.path, profile=profile)):
        expected, read = by_zarr(path), partial(RunStore.open(path).read, "policy/weights")
        assert np.array_equal(read(slice(start, stop)), expected[start:stop])
        for select in (
            np.s_[start:stop, low:],
            np.s_[start:stop:2, low],
            np.s_[start:stop, [low, 0]],
            np.s_[rows, low:],
            np.s_[rows[0]],
        ):
            assert np.array_equal(read(select), expected[select])


def test_equal_runs_are_equal_files(tmp_path: Path) -> None:
    one = wt.pack(write(tmp_path / "a/run.zarr").path)
    other = wt.pack(write(tmp_path / "b/run.zarr").path)
    assert one.read_bytes() == other.read_bytes()
    again = wt.pack(one, out=tmp_path / "again.zip")
    assert one.read_bytes() == again.read_bytes()
    assert same_as_packed(one)


def test_what_a_killed_packing_left_goes_with_the_next(tmp_path: Path) -> None:
    run = write(tmp_path / "run.zarr")
    code = (
        "import os, signal, sys; from weighttraj import atomic; "
        "from weighttraj.tools.pack import pack; "
        "killed = lambda path: path.suffix == '.zip' and os.kill(os.getpid(), signal.SIGKILL); "
        "atomic.sync = killed; pack(sys.argv[1])"
    )
    ended = subprocess.run([sys.executable, "-c", code, str(run.path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    (left,) = tmp_path.glob(".*")
    assert (left / "run.zarr.zip").exists()
    with FileLock(left / "lock"):  # as another process does while it packs
        wt.pack(run.path)
        assert left.exists()
    wt.pack(run.path)
    assert list(tmp_path.glob(".*")) == []


def test_only_finished_runs_are_packed(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "run.zarr", INFO)
    with pytest.raises(FormatError, match="only a finished run"):
        wt.pack(tmp_path / "run.zarr")
    writer.close("crashed")
    assert wt.open_run(wt.pack(tmp_path / "run.zarr")).info.status == "crashed"
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "run.zarr",
        "run.zarr.lock",
        "run.zarr.zip",
    ]


def test_a_packed_run_takes_no_more_snapshots(tmp_path: Path) -> None:
    path = wt.pack(write(tmp_path / "run.zarr").path)
    with pytest.raises(FormatError, match="packed run is finished"):
        RunWriter(path, INFO, resume=True)


def test_the_path_of_a_folder_finds_the_file_it_became(tmp_path: Path) -> None:
    run = write(tmp_path / "run.zarr")
    wt.pack(run.path)
    os.rename(run.path, tmp_path / "elsewhere")
    assert wt.open_run(tmp_path / "run.zarr").path == tmp_path / "run.zarr"
    assert len(wt.open_run(tmp_path / "run.zarr")) == 20


def test_every_byte_of_a_packed_run_counts(tmp_path: Path) -> None:
    """Also those of the zip file's own headers, which no reader looks at."""
    path = wt.pack(write(tmp_path / "run.zarr").path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    places = [*rng.integers(0, len(whole), 60), *range(30), *range(len(whole) - 22, len(whole))]
    for place in places:
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(flipped))
        assert wt.verify(path), place


def test_a_truncated_file_is_found_when_it_is_opened(tmp_path: Path) -> None:
    path = wt.pack(write(tmp_path / "run.zarr").path)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(DamageError, match="no whole zip file"):
        wt.open_run(path)


def test_arrays_of_a_later_version_are_read_over_and_not_lost(tmp_path: Path) -> None:
    """Readers ignore arrays that they do not know; packing them anew would lose them."""
    run = write(tmp_path / "run.zarr")
    store = run._store
    documents = {**store.documents, "eval/later": store.documents["index/phase"]}
    (run.path / "eval").mkdir()
    for name, content in member_documents(documents).items():
        (run.path / name).parent.mkdir(exist_ok=True)
        (run.path / name).write_bytes(content)
    (run.path / "eval/later/c").mkdir()
    for file in (run.path / "index/phase/c").iterdir():
        (run.path / "eval/later/c" / file.name).write_bytes(file.read_bytes())
    (run.path / "zarr.json").write_bytes(group_document(run.info, documents, store.tags, {}))
    assert wt.verify(run.path) == []
    assert "eval/later" not in wt.open_run(run.path).arrays
    with pytest.raises(FormatError, match=r"(?s)does not know.*eval/later"):
        wt.pack(run.path)


def test_plain_zarr_reads_a_packed_run(tmp_path: Path) -> None:
    run = write(tmp_path / "run.zarr")
    for profile in PROFILES:
        assert np.array_equal(by_zarr(wt.pack(run.path, profile=profile)), run.weights[:])
    assert ZipObjects(tmp_path / "run.zarr.zip").names[0] == "zarr.json"
