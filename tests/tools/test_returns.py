"""Returns are added to finished runs: all of them or none, and nothing else changes."""

from __future__ import annotations

import errno
import json
import shutil
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from zarr.storage import LocalStore, ZipStore

import weighttraj as wt
from tests.store.test_store import INFO, LAYOUT, append, weights, write
from weighttraj import Evaluation
from weighttraj.errors import DamageError, FormatError, StoreLockedError
from weighttraj.format import RunInfo
from weighttraj.store import objects
from weighttraj.store.catalog import check_manifest
from weighttraj.store.live import lock_run
from weighttraj.store.objects import packed_order, write_zip
from weighttraj.store.zarr_run import RunStore, group_document, member_documents
from weighttraj.tools import pack as packing
from weighttraj.tools.pack import same_as_packed, unpacked
from weighttraj.tools.returns import locked_path
from weighttraj.writer import RunWriter

ROOT = Path(__file__).parents[2]
V1 = ROOT / "tests/golden/v1"
PROFILES = ("default", "archive")
EVAL = Evaluation(
    seeds=(5, 6, 7),
    deterministic=(True, False, True),
    every=5,
    normalizer="final",
    simulator="mujoco.batch",
    packages={"mujoco": "3.3.0"},
)


def played(n: int = 20, episodes: int = 3, every: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths of every so many snapshots; the second one has an unstable episode."""
    returns, lengths = np.full((n, episodes), np.nan), np.full((n, episodes), -1)
    rows = np.arange(0, n, every)
    returns[rows] = rows[:, None] + np.arange(episodes) / 3
    lengths[rows] = 1000
    returns[every : every + 1, 1], lengths[every : every + 1, 1] = np.nan, 17
    return returns, lengths


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with every array, as a folder and packed. Do not write to it."""
    folder = tmp_path_factory.mktemp("originals")
    for kind in ("folder", *PROFILES):
        dressed(folder / kind, kind)
    return folder


Make = Callable[[str], Path]


@pytest.fixture
def make(originals: Path, tmp_path: Path) -> Make:
    """Puts a run of some kind into the test's folder, with nothing beside it."""

    def copy(kind: str) -> Path:
        name = "run.zarr" if kind == "folder" else "run.zarr.zip"
        source = originals / kind / name
        return Path((shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name))

    return copy


def dressed(path: Path, kind: str, n: int = 20, info: RunInfo = INFO) -> Path:
    """A run as a folder, or packed in a profile; there is nothing beside it."""
    with RunWriter(path / "run.zarr", info) as writer:
        for t, row in enumerate(weights(n)):
            if info is INFO:
                append(writer, t, row)
            else:
                writer.append(row, num_timesteps=t)
    run = wt.open_run(writer.path)
    if kind == "folder":
        return run.path
    packed = wt.pack(run.path, profile=kind)
    shutil.rmtree(run.path)
    return packed


def store(path: Path, evaluation: Evaluation = EVAL) -> wt.Run:
    wt.store_returns(path, evaluation, *played(episodes=len(evaluation.seeds)))
    return wt.open_run(path)


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def files(folder: Path) -> dict[str, bytes]:
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {name: path.read_bytes() for name, path in found.items()}


def beside(path: Path) -> list[str]:
    return sorted(p.name for p in path.parent.iterdir() if not p.name.endswith(".lock"))


def by_zarr(path: Path) -> dict[str, np.ndarray]:
    """All arrays, rows first, as plain Zarr reads them."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Numcodecs codecs are not in")
        plain: Any = ZipStore(path) if path.is_file() else LocalStore(path, read_only=True)
        found = {}
        for name, array in zarr.open_group(plain, mode="r").members(max_depth=None):
            if isinstance(array, zarr.Array):
                first = array.metadata.dimension_names[0] in ("time", "iteration")
                found[name] = array[:] if first else array[:].T
        plain.close()
    return found


# There and back


@pytest.mark.parametrize("kind", ["folder", *PROFILES])
def test_returns_are_read_as_they_were_stored(make: Make, kind: str) -> None:
    path = make(kind)
    before = {name: array[:].tobytes() for name, array in wt.open_run(path).arrays.items()}
    assert wt.open_run(path).evaluation is None
    run = store(path)
    returns, lengths = played()
    assert run.evaluation == EVAL
    assert (run.returns.shape, run.returns.dtype) == ((20, 3), np.float64)
    assert run.returns.dims == ("time", "episode")
    assert run.returns[:].tobytes() == returns.tobytes()
    assert run["eval/lengths"].dtype == np.int32
    assert np.array_equal(run["eval/lengths"][:], lengths)
    assert before == {n: a[:].tobytes() for n, a in run.arrays.items() if not n.startswith("eval/")}
    assert wt.verify(path) == []
    assert wt.lint(path) == []
    assert beside(path) == [path.name]


@pytest.mark.parametrize("kind", ["folder", *PROFILES])
def test_plain_zarr_reads_them(make: Make, kind: str) -> None:
    path = make(kind)
    before = by_zarr(path)
    store(path)
    after = by_zarr(path)
    assert after.keys() - before.keys() == {"eval/returns", "eval/lengths"}
    assert np.array_equal(after["eval/returns"], played()[0], equal_nan=True)
    assert np.array_equal(after["eval/lengths"], played()[1])
    assert all(after[name].tobytes() == before[name].tobytes() for name in before)


@settings(max_examples=8, deadline=None)
@given(
    n=st.integers(0, 12),
    episodes=st.integers(1, 4),
    block=st.integers(1, 9),
    status=st.sampled_from(["complete", "crashed"]),
    profile=st.sampled_from(PROFILES),
    data=st.data(),
)
def test_every_bit_survives_and_the_order_of_packing_does_not_matter(
    tmp_path_factory: pytest.TempPathFactory,
    n: int,
    episodes: int,
    block: int,
    status: Any,
    profile: Any,
    data: st.DataObject,
) -> None:
    folder = tmp_path_factory.mktemp("returns")
    writer = RunWriter(folder / "run.zarr", RunInfo(run_id="r", layout=LAYOUT, block=block))
    for t, row in enumerate(weights(n)):
        writer.append(row, num_timesteps=t)
    writer.close(status)
    finite = st.floats(allow_nan=False, allow_infinity=False)
    episode = st.one_of(
        st.tuples(finite, st.integers(0, 2**31 - 1)),
        st.tuples(st.just(float("nan")), st.integers(-1, 2**31 - 1)),
    )
    drawn = data.draw(st.lists(episode, min_size=n * episodes, max_size=n * episodes))
    returns = np.array([value for value, _ in drawn], float).reshape(n, episodes)
    lengths = np.array([length for _, length in drawn], np.int64).reshape(n, episodes)
    evaluation = Evaluation(
        seeds=tuple(
            data.draw(st.lists(st.integers(0, 2**40), min_size=episodes, max_size=episodes))
        ),
        deterministic=tuple(
            data.draw(st.lists(st.booleans(), min_size=episodes, max_size=episodes))
        ),
    )
    first = wt.pack(folder / "run.zarr", profile=profile)
    wt.store_returns(first, evaluation, returns, lengths)
    wt.store_returns(folder / "run.zarr", evaluation, returns, lengths)
    later = wt.pack(folder / "run.zarr", profile=profile, out=folder / "later.zip")
    assert first.read_bytes() == later.read_bytes()
    for path in (first, folder / "run.zarr"):
        run = wt.open_run(path)
        assert run.evaluation == evaluation
        assert run.returns[:].tobytes() == returns.tobytes()
        assert np.array_equal(run["eval/lengths"][:], lengths)
        assert wt.verify(path) == []


@pytest.mark.parametrize("kind", ["folder", *PROFILES])
def test_many_episodes_lie_in_several_chunks(tmp_path: Path, kind: str) -> None:
    path = dressed(tmp_path, kind, 9)
    n = 20_000
    wide = Evaluation(seeds=tuple(range(n)), deterministic=(False,) * n)
    wt.store_returns(path, wide, *played(9, n, 2))
    run = wt.open_run(path)
    assert run.returns[:].tobytes() == played(9, n, 2)[0].tobytes()
    assert np.array_equal(run["eval/lengths"][2, 15_000:], played(9, n, 2)[1][2, 15_000:])
    assert np.array_equal(by_zarr(path)["eval/lengths"], played(9, n, 2)[1])
    assert wt.verify(path) == []


@pytest.mark.parametrize("profile", PROFILES)
def test_the_other_objects_of_a_packed_run_stay_as_they_are(make: Make, profile: str) -> None:
    path = make(profile)
    before = members(path)
    store(path)
    after = members(path)
    added = {name for name in after if name.startswith("eval/")}
    assert added == {
        "eval/zarr.json",
        *(
            f"eval/{array}/{name}"
            for array in ("returns", "lengths")
            for name in ("zarr.json", "c/0/0")
        ),
    }
    assert after.keys() == before.keys() | added
    assert [name for name in before if before[name] != after[name]] == ["zarr.json"]
    assert list(after) == sorted(after, key=packed_order)
    assert same_as_packed(path)


def test_large_members_are_copied_piece_by_piece(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make("default")
    before = members(path)
    monkeypatch.setattr("weighttraj.store.objects._PIECE_BYTES", 100)
    store(path)
    after = members(path)
    assert all(after[name] == before[name] for name in before if name != "zarr.json")
    assert max(map(len, before.values())) > 300
    assert same_as_packed(path)


@pytest.mark.parametrize("profile", PROFILES)
def test_returns_of_a_packed_run_are_replaced(tmp_path: Path, profile: str) -> None:
    path = dressed(tmp_path / "one", profile)
    store(path, Evaluation(seeds=tuple(range(9000)), deterministic=(True,) * 9000))
    assert sum(name.startswith("eval/returns/c") for name in members(path)) == (
        2 if profile == "archive" else 1
    )
    store(path)
    other = dressed(tmp_path / "other", profile)
    store(other)
    assert path.read_bytes() == other.read_bytes()
    store(path)
    assert path.read_bytes() == other.read_bytes()


def test_the_name_of_the_folder_finds_the_packed_run(tmp_path: Path, make: Make) -> None:
    make("default")
    assert store(tmp_path / "run.zarr").evaluation == EVAL
    assert beside(tmp_path / "run.zarr") == ["run.zarr.zip"]


def test_a_folder_keeps_the_returns_it_has(make: Make) -> None:
    path = make("folder")
    store(path)
    before, inode = files(path), (path / "zarr.json").stat().st_ino
    store(path)
    assert (path / "zarr.json").stat().st_ino == inode
    returns, lengths = played()
    for evaluation, values in ((replace(EVAL, every=4), returns), (EVAL, returns + 1)):
        with pytest.raises(FormatError, match=r"(?s)has other returns.*weighttraj\.pack"):
            wt.store_returns(path, evaluation, values, lengths)
    assert files(path) == before
    packed = wt.pack(path)
    wt.store_returns(packed, EVAL, returns + 1, lengths)
    assert np.array_equal(wt.open_run(packed).returns[:], returns + 1, equal_nan=True)


@pytest.mark.parametrize("kind", ["folder", *PROFILES])
def test_what_a_later_version_wrote_stays(make: Make, kind: str) -> None:
    """An array, its chunks and keys of the metadata that this version does not know."""
    path = with_unknowns(make(kind))
    before = members(path) if path.is_file() else files(path)
    run = store(path)
    after = members(path) if path.is_file() else files(path)
    assert sorted(name for name in before if before[name] != after[name]) == ["zarr.json"]
    assert {"eval/later/zarr.json", "eval/later/c/0"} < before.keys()
    attributes = json.loads(after["zarr.json"])["attributes"]
    assert attributes["weighttraj"]["later"] == {"a": 1}
    assert attributes["weighttraj_later"] == "b"
    tags = attributes["weighttraj_crc32c"]
    assert tags["eval/later"] == tags["index/phase"]
    assert run.evaluation == EVAL
    assert "eval/later" not in run.arrays
    assert wt.verify(path) == []


def with_unknowns(path: Path) -> Path:
    """The run as a later version could have written it."""
    if path.is_dir():
        return unknowns_into(path)
    with unpacked(path) as folder:
        unknowns_into(folder)
        write_zip(path, packing._members(folder))
    return path


def unknowns_into(folder: Path) -> Path:
    run = RunStore.open(folder)
    documents = {**run.documents, "eval/later": run.documents["index/phase"]}
    shutil.copytree(folder / "index/phase", folder / "eval/later")
    for name, content in member_documents(documents).items():
        (folder / name).write_bytes(content)
    attributes = {**run.attributes, "weighttraj_later": "b"}
    attributes["weighttraj"] = {**attributes["weighttraj"], "later": {"a": 1}}
    tags = {**run.tags, "eval/later": run.tags["index/phase"]}
    (folder / "zarr.json").write_bytes(group_document(run.info, documents, tags, attributes))
    assert wt.verify(folder) == []
    return folder


@pytest.mark.parametrize("name", ["default.zarr.zip", "archive.zarr.zip", "folder.zarr"])
def test_runs_of_version_1_take_returns(tmp_path: Path, name: str) -> None:
    source, path = V1 / "dataset/runs" / name, tmp_path / name
    (shutil.copytree if source.is_dir() else shutil.copy)(source, path)
    before = {n: array[:].tobytes() for n, array in wt.open_run(path).arrays.items()}
    with pytest.raises(FormatError, match="weighttraj returns DATASET"):
        wt.open_run(path).returns  # noqa: B018
    run = store(path)
    assert run.returns[:].tobytes() == played()[0].tobytes()
    assert before == {n: a[:].tobytes() for n, a in run.arrays.items() if not n.startswith("eval/")}
    assert wt.verify(path) == []


# What a run says of its returns


def test_mean_returns_are_over_the_episodes_of_a_mode(make: Make) -> None:
    run = store(make("default"))
    by_mode = np.full(20, np.nan)
    by_mode[::5] = np.arange(0, 20, 5) + 1 / 3
    assert np.allclose(run.mean_return(), by_mode, equal_nan=True)
    sampled = by_mode.copy()
    sampled[5] = np.nan  # its only sampled episode became unstable
    assert np.allclose(run.mean_return(deterministic=False), sampled, equal_nan=True)
    assert run.final_mean_return == run.mean_return()[15]


@pytest.mark.parametrize(("mode", "name"), [(True, "sampled"), (False, "deterministic")])
def test_a_mode_that_was_not_played_is_named(make: Make, mode: bool, name: str) -> None:
    run = store(make("folder"), replace(EVAL, deterministic=(mode,) * 3))
    with pytest.raises(FormatError, match=f"(?s)no such episode.*expected: {name}"):
        run.mean_return(deterministic=not mode)
    assert run.final_mean_return == run.mean_return(deterministic=mode)[15]


@pytest.mark.parametrize("ask", [lambda r: r.returns, lambda r: r.mean_return()])
def test_a_run_without_returns_says_how_to_get_them(make: Make, ask: Any) -> None:
    run = wt.open_run(make("folder"))
    with pytest.raises(FormatError, match=r"(?s)stores no returns.*weighttraj returns DATASET"):
        ask(run)
    assert np.isnan(run.final_mean_return)


def test_the_final_return_is_that_of_the_last_evaluated_snapshot(make: Make) -> None:
    path = make("default")
    returns, lengths = played()
    returns[15, 0], lengths[15, 0] = np.nan, 3  # unstable: evaluated, and yet no mean
    wt.store_returns(path, EVAL, returns, lengths)
    assert np.isnan(wt.open_run(path).final_mean_return)
    wt.store_returns(path, EVAL, np.full((20, 3), np.nan), np.full((20, 3), -1))
    assert np.isnan(wt.open_run(path).final_mean_return)


# Refusals


def test_a_run_that_is_collected_takes_no_returns(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run.zarr", INFO) as writer:
        append(writer, 0, weights(1)[0])
        writer.flush()
        with pytest.raises(StoreLockedError):
            wt.store_returns(writer.path, EVAL, *played(1))
    killed = RunWriter(tmp_path / "killed.zarr", INFO)
    append(killed, 0, weights(1)[0])
    killed.flush()
    killed._lock.release()
    with pytest.raises(FormatError, match=r"(?s)finished run only.*got: collecting"):
        wt.store_returns(killed.path, EVAL, *played(1))
    killed.close()


def test_there_must_be_a_run(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no run at"):
        wt.store_returns(tmp_path / "run.zarr", EVAL, *played())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["folder", "default"])
def test_a_run_has_one_writer(make: Make, kind: str) -> None:
    path = make(kind)
    lock = lock_run(locked_path(path))
    with pytest.raises(StoreLockedError, match="another process"):
        store(path)
    lock.release()
    store(path)
    store(path)  # and lets go of it


RETURNS, LENGTHS = played()


def with_value(array: np.ndarray, value: float) -> np.ndarray:
    changed = array.copy()
    changed[5, 2] = value
    return changed


@pytest.mark.parametrize(
    ("returns", "lengths", "said"),
    [
        (RETURNS[:19], LENGTHS[:19], r"eval/returns has the wrong.*float64 \(20, 3\).*\(19, 3\)"),
        (RETURNS[:, :2], LENGTHS[:, :2], r"eval/returns has the wrong.*\(20, 2\)"),
        (RETURNS, LENGTHS[:, 0], r"eval/lengths has the wrong.*integers \(20, 3\).*\(20,\)"),
        (RETURNS.astype(np.float32), LENGTHS, "eval/returns has the wrong.*got: float32"),
        (np.zeros((20, 3), np.int64), LENGTHS, "eval/returns has the wrong.*got: int64"),
        (RETURNS, LENGTHS.astype(float), "eval/lengths has the wrong.*got: float64"),
        (RETURNS, LENGTHS > 0, "eval/lengths has the wrong.*got: bool"),
        (with_value(RETURNS, np.inf), LENGTHS, "infinite returns.*got: 1; .*snapshot 5, episode 2"),
        (with_value(RETURNS, -np.inf), LENGTHS, "infinite returns.*return -inf, length 1000"),
        (RETURNS, with_value(LENGTHS, -2), "no number of steps.*length -2"),
        (RETURNS, with_value(LENGTHS, 2**31), "no number of steps.*length 2147483648"),
        (RETURNS, with_value(LENGTHS, -1), "not played.*length -1.*snapshot 5, episode 2"),
    ],
)
def test_values_that_say_nothing_are_refused(
    complete: Path, returns: np.ndarray, lengths: np.ndarray, said: str
) -> None:
    before = complete.read_bytes()
    with pytest.raises(FormatError, match=f"(?s){said}"):
        wt.store_returns(complete, EVAL, returns, lengths)
    assert complete.read_bytes() == before


@pytest.fixture(scope="module")
def complete(originals: Path) -> Path:
    """A packed run. Do not write to it."""
    return originals / "default/run.zarr.zip"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint64, np.int32, ">i2"])
def test_any_integers_are_lengths(tmp_path: Path, complete: Path, dtype: Any) -> None:
    path = Path(shutil.copy(complete, tmp_path))
    lengths = np.arange(60).reshape(20, 3).astype(dtype)
    wt.store_returns(path, EVAL, RETURNS.astype(">f8"), lengths)
    assert np.array_equal(wt.open_run(path)["eval/lengths"][:], np.arange(60).reshape(20, 3))
    assert wt.open_run(path).returns[:].tobytes() == RETURNS.tobytes()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"seeds": (), "deterministic": ()}, "0 seeds, 0 modes"),
        ({"seeds": (1, 2)}, "2 seeds, 3 modes"),
        ({"deterministic": (True,)}, "3 seeds, 1 modes"),
        ({"seeds": (1,) * (2**20 + 1), "deterministic": (True,) * (2**20 + 1)}, "1048577 seeds"),
        ({"seeds": (1, -2, 3)}, "smallest seed -2"),
        ({"every": 0}, "every 0"),
        ({"every": 2**49}, "every 562949953421312"),
    ],
)
def test_an_evaluation_says_how_each_episode_was_played(values: Any, said: str) -> None:
    with pytest.raises(FormatError, match=said):
        replace(EVAL, **values)


# Damage


@pytest.mark.parametrize("kind", ["folder", *PROFILES])
def test_a_flipped_bit_in_the_returns_is_found_and_cut(make: Make, kind: str) -> None:
    path = make(kind)
    store(path)
    flip_a_return(path)
    with pytest.raises(DamageError, match="eval/returns"):
        wt.open_run(path).returns[:]
    assert np.array_equal(wt.open_run(path).weights[:], weights(20))
    assert any("eval/returns" in problem for problem in wt.verify(path))


def flip_a_return(path: Path) -> None:
    if path.is_dir():
        file, place = path / "eval/returns/c/0/0", 20
    else:
        file = path
        with zipfile.ZipFile(path) as archive:
            place = archive.getinfo("eval/returns/c/0/0").header_offset + 30 + 18 + 20
    content = bytearray(file.read_bytes())
    content[place] ^= 1
    file.write_bytes(content)


def test_repair_drops_damaged_returns_and_no_snapshots(make: Make) -> None:
    path = make("folder")
    before = by_zarr(path)
    store(path)
    flip_a_return(path)
    assert "damaged returns; --cut drops them" in wt.repair(path)[-1]
    assert wt.open_run(path).evaluation == EVAL
    assert "weighttraj returns evaluates" in wt.repair(path, cut=True)[-1]
    run = wt.open_run(path)
    assert (run.evaluation, run.info.status, len(run)) == (None, "complete", 20)
    assert by_zarr(path).keys() == before.keys()
    assert wt.verify(path) == []
    assert wt.repair(path) == []
    assert store(path).returns[:].tobytes() == RETURNS.tobytes()


def test_repair_cuts_returns_with_their_snapshots(make: Make) -> None:
    path = make("folder")
    store(path)
    (path / "policy/weights/c/1/0").write_bytes(b"")
    assert "cut to 8 snapshots" in wt.repair(path, cut=True)[-1]
    run = wt.open_run(path)
    assert run.returns[:].tobytes() == RETURNS[:8].tobytes()
    assert wt.verify(path) == []


@pytest.mark.parametrize("place", ["policy/weights/c/0/0", "index/epoch/c/0"])
def test_a_damaged_packed_run_is_left_as_it_is(tmp_path: Path, complete: Path, place: str) -> None:
    path = Path(shutil.copy(complete, tmp_path))
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        content[archive.getinfo(place).header_offset + 30 + len(place) + 5] ^= 1
    path.write_bytes(content)
    with pytest.raises(DamageError, match=rf"(?s)left as it was.*1 objects.*{place}"):
        store(path)
    assert path.read_bytes() == content
    assert beside(path) == [path.name]


def test_returns_that_do_not_read_back_are_not_stored(
    tmp_path: Path, complete: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Path(shutil.copy(complete, tmp_path))
    monkeypatch.setattr(RunStore, "read", lambda self, name, key: np.zeros(3))
    with pytest.raises(DamageError, match=r"(?s)left as it was.*2 objects.*eval/returns"):
        wt.store_returns(path, EVAL, RETURNS, LENGTHS)
    assert path.read_bytes() == complete.read_bytes()


def test_a_full_disk_leaves_the_run_as_it_was(
    tmp_path: Path, complete: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Path(shutil.copy(complete, tmp_path))
    pieces, seen = objects._pieces, []

    def full(name: str, source: Any) -> Any:
        seen.append(name)
        if name == "digest/c/0/0":
            raise OSError(errno.ENOSPC, "No space left on device")
        return pieces(name, source)

    monkeypatch.setattr(objects, "_pieces", full)
    with pytest.raises(OSError, match="No space left"):
        store(path)
    assert len(seen) > 20
    assert path.read_bytes() == complete.read_bytes()
    assert beside(path) == [path.name]


# Kills


KILL_AT_EVERY_CHANGE = """
import os, shutil, signal, sys
from pathlib import Path
import weighttraj as wt
from tests.tools.test_returns import EVAL, played

source, out, name = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]

def child(folder, n):
    count = 0
    def hook(event, arguments):
        nonlocal count
        change = event in ("os.rename", "shutil.rmtree")
        write = os.O_WRONLY | os.O_RDWR | os.O_CREAT
        change |= event == "open" and isinstance(arguments[2], int) and bool(arguments[2] & write)
        # Files are opened and renamed in their opened folder, by their names alone.
        if change and (str(folder) in str(arguments[0]) or str(arguments[0]).endswith(".draft")):
            count += 1
            if count == n:
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
    wt.store_returns(folder / name, EVAL, *played())

n = 0
while True:
    n += 1
    shutil.copytree(source, out / str(n))
    pid = os.fork()
    if not pid:
        try:
            child(out / str(n), n)
            os._exit(0)
        finally:
            os._exit(1)
    _, status = os.waitpid(pid, 0)
    if not os.WIFSIGNALED(status):
        print(n - 1)
        sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.parametrize("kind", ["folder", "default"])
def test_a_kill_leaves_the_run_as_it_was_or_as_it_is_to_be(tmp_path: Path, kind: str) -> None:
    path = dressed(tmp_path / "before", kind, 20, RunInfo(run_id="run", layout=LAYOUT, block=10))
    first = Evaluation(seeds=(1, 2), deterministic=(True, True)) if kind == "default" else None
    if first:  # will be replaced
        store(path, first)
    done = Path(shutil.copytree(path.parent, tmp_path / "done")) / path.name
    store(done)
    (tmp_path / "killed").mkdir()
    command = [sys.executable, "-W", "ignore", "-c", KILL_AT_EVERY_CHANGE]
    command += [str(path.parent), str(tmp_path / "killed"), path.name]
    said = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert said.returncode == 0, said.stderr
    kills, states = int(said.stdout), []
    for n in range(1, kills + 1):
        killed = tmp_path / "killed" / str(n) / path.name
        states.append(wt.open_run(killed).evaluation)
        if kind == "default":
            assert killed.read_bytes() == (done if states[-1] == EVAL else path).read_bytes()
        else:
            assert all("weighttraj repair" in what for what in wt.verify(killed)), n
        store(killed)
        if kind == "default":
            assert killed.read_bytes() == done.read_bytes()
        else:
            whole = {k: v for k, v in files(killed).items() if k.rpartition("/")[2][0] != "."}
            assert whole == files(done), n
        assert beside(killed) == [path.name]
    if kind == "folder":
        wt.repair(killed)  # removes drafts
        assert files(killed) == files(done)
    # Into a folder, the commit is the last change; beside a file, the draft is left to be removed.
    committed = states.index(EVAL) if EVAL in states else kills
    assert committed > 10
    assert states == [first] * committed + [EVAL] * (kills - committed)
    assert (committed < kills) == (kind == "default")


# Data sets


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """A copy of version 1's data set: packed runs of both profiles and a folder."""
    return Path(shutil.copytree(V1 / "dataset", tmp_path / "dataset"))


def evaluate(dataset: Path, ids: tuple[str, ...]) -> None:
    for run_id in ids:
        run = wt.open(dataset)[run_id]
        wt.store_returns(run.path, EVAL, *played(len(run)))


def test_a_data_set_is_unsealed_changed_and_sealed(dataset: Path) -> None:
    wt.unseal(dataset)
    assert wt.open(dataset).info.status == "complete"
    evaluate(dataset, ("default", "archive", "folder"))
    said = wt.verify(dataset)  # as after a kill
    assert len(said) == 1
    assert "manifest is missing" in said[0]
    assert "give it again" in said[0]
    wt.unseal(dataset)
    evaluate(dataset, ("default", "archive", "folder"))
    wt.seal(dataset)
    assert check_manifest(dataset) == []
    assert wt.verify(dataset, deep=True) == []
    assert wt.lint(dataset) == wt.lint(V1 / "dataset")
    assert wt.repair(dataset) == []
    assert [run.evaluation for run in wt.open(dataset)] == [EVAL] * 3


def test_repair_also_finishes_what_was_stopped(dataset: Path) -> None:
    wt.unseal(dataset)
    evaluate(dataset, ("default",))
    assert "tables and manifest written anew" in wt.repair(dataset)[-1]
    assert wt.verify(dataset, deep=True) == []
    assert wt.open(dataset)["default"].evaluation == EVAL


def test_a_changed_run_of_a_sealed_data_set_is_found(dataset: Path) -> None:
    evaluate(dataset, ("default",))
    assert any("default.zarr.zip: changed" in problem for problem in wt.verify(dataset))


def test_only_a_data_set_is_unsealed(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no data set"):
        wt.unseal(tmp_path)


def test_the_tables_have_the_mean_returns(dataset: Path) -> None:
    evaluate(dataset, ("default",))
    sampled = replace(EVAL, deterministic=(False,) * 3)
    path = wt.open(dataset)["archive"].path
    wt.store_returns(path, sampled, *played())
    wt.seal(dataset)
    runs = pq.read_table(dataset / "tables/runs.parquet")
    means = dict(
        zip(runs["run_id"].to_pylist(), runs["final_mean_return"].to_pylist(), strict=True)
    )
    found = {run.id: run.final_mean_return for run in wt.open(dataset)}
    assert means == {i: None if np.isnan(value) else value for i, value in found.items()}
    assert [i for i, value in means.items() if value is None] == ["folder"]
    assert "final_return" in runs.column_names
    table = pq.read_table(dataset / "tables/snapshots.parquet")
    by_mode, drawn = table["mean_return_deterministic"], table["mean_return_sampled"]
    assert (by_mode.null_count, drawn.null_count) == (60 - 4, 60 - 3 - 3)
    frame = pd.read_parquet(dataset / "tables/snapshots.parquet")
    for run, mode, column in (
        ("default", True, "mean_return_deterministic"),
        ("default", False, "mean_return_sampled"),
        ("archive", False, "mean_return_sampled"),
    ):
        mine = frame[frame.run_id == run][column]
        assert np.array_equal(mine, wt.open(dataset)[run].mean_return(mode), equal_nan=True)


def test_the_tables_without_returns_have_the_same_columns(dataset: Path) -> None:
    wt.seal(dataset)
    runs = pq.read_schema(dataset / "tables/runs.parquet")
    snapshots = pq.read_schema(dataset / "tables/snapshots.parquet")
    assert runs.field("final_mean_return").type == pa.float64()
    for name in ("mean_return_deterministic", "mean_return_sampled"):
        assert snapshots.field(name).type == pa.float64()
        assert pd.read_parquet(dataset / "tables/snapshots.parquet")[name].isna().all()


def test_runs_are_selected_by_their_returns(dataset: Path) -> None:
    evaluate(dataset, ("default",))
    good = wt.open(dataset).select(final_mean_return=lambda value: value > 10)
    assert [run.id for run in good] == ["default"]


@pytest.mark.parametrize("damage", ["returns", "returns and weights"])
def test_repair_of_a_data_set_drops_damaged_returns_only(dataset: Path, damage: str) -> None:
    evaluate(dataset, ("archive",))
    wt.seal(dataset)
    path = dataset / "runs/archive.zarr.zip"
    flip_a_return(path)
    if damage == "returns and weights":
        content = bytearray(path.read_bytes())
        with zipfile.ZipFile(path) as archive:
            content[archive.getinfo("policy/weights/c/0/0").header_offset + 100] ^= 1
        path.write_bytes(content)
    steps = wt.repair(dataset, cut=True)
    if damage == "returns":
        assert "damaged returns dropped" in steps[0]
        assert wt.open(dataset)["archive"].evaluation is None
        assert path.read_bytes() != b""
        assert wt.verify(dataset, deep=True) == []
    else:
        assert "collect the recipe again" in steps[0]
        assert not path.exists()


@pytest.mark.parametrize("damage", ["compressed", "folder"])
def test_repair_drops_what_is_no_packed_run(dataset: Path, damage: str) -> None:
    path = dataset / "runs/archive.zarr.zip"
    content = members(path)
    path.unlink()
    if damage == "folder":
        path.mkdir()
    else:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, member in content.items():
                archive.writestr(name, member)
    assert "collect the recipe again" in wt.repair(dataset, cut=True)[0]
    assert [run.id for run in wt.open(dataset)] == ["default", "folder"]


def test_dropping_returns_leaves_all_else_as_it_is(dataset: Path) -> None:
    evaluate(dataset, ("archive",))
    path = dataset / "runs/archive.zarr.zip"
    flip_a_return(path)
    wt.repair(dataset, cut=True)
    before, after = members(V1 / "dataset/runs/archive.zarr.zip"), members(path)
    assert list(after) == list(before)
    assert [name for name in before if before[name] != after[name]] == ["zarr.json"]


# Other ways in and out


@pytest.mark.parametrize("kind", ["folder", *PROFILES])
def test_hdf5_keeps_returns_there_and_back(tmp_path: Path, make: Make, kind: str) -> None:
    run = store(make(kind))
    file = wt.export_hdf5(run, tmp_path / "run.h5")
    there = wt.open(file).runs[0]
    assert there.evaluation == EVAL
    assert there.returns[:].tobytes() == RETURNS.tobytes()
    for mode in (True, False):
        assert np.array_equal(there.mean_return(mode), run.mean_return(mode), equal_nan=True)
    assert wt.verify(file) == []
    back = wt.open(wt.import_hdf5(file, tmp_path / "back")).runs[0]
    if run.path.is_file():
        assert back.path.read_bytes() == run.path.read_bytes()
    else:
        assert files(back.path) == files(run.path)


def test_an_export_for_numpy_has_the_returns(tmp_path: Path, make: Make) -> None:
    folder = wt.export_npy(store(make("folder")), tmp_path / "npy")
    assert np.load(folder / "eval.returns.npy").tobytes() == RETURNS.tobytes()
    assert np.array_equal(np.load(folder / "eval.lengths.npy"), LENGTHS)
    assert (
        json.loads((folder / "run.json").read_text())["evaluation"]["simulator"] == "mujoco.batch"
    )


def test_a_crashed_run_that_goes_on_keeps_its_returns(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    with pytest.raises(ZeroDivisionError), RunWriter(path, INFO) as writer:
        for t, row in enumerate(weights(11)):
            append(writer, t, row)
        raise ZeroDivisionError
    wt.store_returns(path, EVAL, *played(11))
    run = write(path, 20, resume=True)
    assert (len(run), run.info.status, run.evaluation) == (20, "complete", EVAL)
    returns, lengths = played(11)
    assert run.returns[:11].tobytes() == returns.tobytes()
    assert np.array_equal(run["eval/lengths"][:11], lengths)
    assert np.isnan(run.returns[11:]).all()  # not evaluated
    assert (run["eval/lengths"][11:] == -1).all()
    assert wt.verify(path) == []


def test_a_new_run_does_not_take_over_an_evaluation(tmp_path: Path, make: Make) -> None:
    info = store(make("folder")).info
    again = replace(info, run_id="again", n_committed=0, n_committed_iterations=0)
    assert write(tmp_path / "again.zarr", 5, again).evaluation is None


def test_bad_evaluations_in_metadata_are_refused(make: Make) -> None:
    path = make("folder")
    store(path)
    good = (path / "zarr.json").read_text()
    for old, new in (('"every": 5', '"every": 0'), ('"final"', '"mine"')):
        assert good.count(old) == 1
        (path / "zarr.json").write_text(good.replace(old, new))
        with pytest.raises(FormatError, match="not a valid RunInfo"):
            wt.open_run(path)
