"""Data sets in one HDF5 file: there and back, and files that nobody should trust."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import weighttraj as wt
from tests.store.test_store import INFO, LAYOUT, MASK, weights, write
from weighttraj.collect.costs import COSTS
from weighttraj.errors import DamageError, FormatError, NewerFormatError, StoreExistsError
from weighttraj.format import ParamLayout, RunInfo
from weighttraj.format.schema import to_json
from weighttraj.opening import open_hdf5
from weighttraj.run import ArrayStore
from weighttraj.store.zarr_run import checksum
from weighttraj.tools.hdf5 import export_hdf5, import_hdf5
from weighttraj.writer import RunWriter

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run and the file of it. Do not write to them."""
    path = tmp_path_factory.mktemp("made")
    export_hdf5(write(path / "run.zarr"), path / "run.h5")
    return path


@pytest.fixture
def run(made: Path, tmp_path: Path) -> wt.Run:
    return wt.open_run(shutil.copytree(made / "run.zarr", tmp_path / "run.zarr"))


@pytest.fixture
def file(made: Path, run: wt.Run, tmp_path: Path) -> Path:
    return Path(shutil.copy(made / "run.h5", tmp_path / "run.h5"))


def bits(run: wt.Run) -> dict[str, tuple[tuple[int, ...], bytes]]:
    return {name: (array.shape, array[:].tobytes()) for name, array in run.arrays.items()}


def files(folder: Path) -> dict[str, bytes]:
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {name: path.read_bytes() for name, path in found.items()}


# There and back


def test_a_data_set_comes_back_in_the_same_bytes(small_dataset: Path, tmp_path: Path) -> None:
    file = export_hdf5(small_dataset, tmp_path / "small.h5")
    back = import_hdf5(file, tmp_path / "back")
    before, after = files(small_dataset), files(back)
    assert len(before) > 6
    beside = (".lock", COSTS)  # neither is an object of the data set
    before = {name: content for name, content in before.items() if not name.endswith(beside)}
    assert after == before
    assert wt.verify(back) == []


def test_everything_of_a_data_set_works_from_the_file(small_dataset: Path, tmp_path: Path) -> None:
    here = wt.open(small_dataset)
    there = open_hdf5(export_hdf5(here, tmp_path / "small.h5"))
    assert repr(there).splitlines()[:-1] == repr(here).splitlines()[:-1]  # the last is the path
    assert [run.id for run in there.split("test")] == ["seed0002", "seed0003"]
    for one, other in zip(here, there, strict=True):
        assert bits(one) == bits(other)
        assert to_json(one.info) == to_json(other.info)
        stats = other.obs_norm(7)
        assert stats is not None
        assert np.array_equal(stats.mean, one["obs_norm/mean"][7])
    assert isinstance(there.runs[0]._store, ArrayStore)
    raw = np.random.default_rng(0).normal(size=(9, 4))
    actions = [
        ds.runs[1].load_policy(5).predict(raw, deterministic=True)[0] for ds in (here, there)
    ]
    assert np.array_equal(*actions)
    window = there.split("train").to_torch(window=10)[3]["weights"]
    assert np.array_equal(window, here.split("train").to_torch(window=10)[3]["weights"])


@settings(max_examples=8, deadline=None)
@given(
    n=st.integers(0, 20),
    block=st.integers(1, 9),
    nans=st.lists(st.integers(0, 2**51 - 1), min_size=20, max_size=20),
)
def test_every_length_and_every_bit_survives(
    tmp_path_factory: pytest.TempPathFactory, n: int, block: int, nans: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("h5")
    odd = (np.array(nans, np.uint64) | np.uint64(0x7FF8_0000_0000_0000)).view(np.float64)
    info = RunInfo(run_id="r", layout=LAYOUT, block=block, diagnostics=("odd",))
    with RunWriter(folder / "r.zarr", info) as writer:
        for t, row in enumerate(weights(n)):
            writer.append(row, num_timesteps=t, train={"odd": odd[t]})
    there = export_hdf5(folder / "r.zarr", folder / "r.h5")
    back = wt.open(import_hdf5(there, folder / "back")).runs[0]
    run = wt.open_run(folder / "r.zarr")
    assert run["train/odd"][:].tobytes() == odd[:n].tobytes()
    assert bits(back) == bits(open_hdf5(there).runs[0]) == bits(run)
    assert to_json(back.info) == to_json(run.info)
    assert wt.verify(back.path) == []


@pytest.mark.parametrize(
    "key", [0, -1, slice(3, 17), slice(2, 20, 5), slice(-3, None), [4, 1, -1], MASK, slice(5, 5)]
)
def test_rows_and_columns_are_those_of_the_run(run: wt.Run, file: Path, key: object) -> None:
    there = open_hdf5(file).runs[0]
    for name, array in run.arrays.items():
        if array.shape[0] == 20:
            assert np.array_equal(there[name][key], array[key], equal_nan=True), name
            assert there[name][key].shape == array[key].shape
    columns = (key, slice(3, 7))
    assert np.array_equal(there.weights[columns], weights(20)[columns])
    assert np.array_equal(there.weights[key, 5], weights(20)[key, 5])


def test_rows_of_several_blocks_and_rows_larger_than_a_chunk(tmp_path: Path) -> None:
    layout = ParamLayout.of({"w": ((300_000,), "other", ("fixed",))})
    rows = weights(10, 300_000)
    with RunWriter(tmp_path / "run.zarr", RunInfo(run_id="r", layout=layout, block=4)) as writer:
        for row in rows:
            writer.append(row, num_timesteps=0)
    file = export_hdf5(tmp_path / "run.zarr", tmp_path / "r.h5")
    with h5py.File(file) as root:
        assert root["runs/r/policy/weights"].chunks == (3, 300_000)
    run = open_hdf5(file).runs[0]
    for key in (slice(1, 9), [9, 0, 4, 0], 5):
        assert np.array_equal(run.weights[key], rows[key])
        assert np.array_equal(run.weights[key, 7:9], rows[key, 7:9])
    with pytest.raises(IndexError):
        run.weights[10]


def test_a_snapshot_larger_than_a_chunk_is_split(tmp_path: Path) -> None:
    layout = ParamLayout.of({"w": ((1_100_000,), "other", ("fixed",))})
    rows = np.tile(weights(2, 1000), 1100)
    with RunWriter(tmp_path / "run.zarr", RunInfo(run_id="r", layout=layout)) as writer:
        for row in rows:
            writer.append(row, num_timesteps=0)
    file = export_hdf5(tmp_path / "run.zarr", tmp_path / "r.h5")
    with h5py.File(file) as root:
        assert root["runs/r/policy/weights"].chunks == (1, 1 << 20)
    assert np.array_equal(open_hdf5(file).runs[0].weights[:], rows)


def test_one_run_is_a_data_set_of_one_run(file: Path) -> None:
    dataset = open_hdf5(file)
    assert (dataset.info.id, dataset.info.status) == ("run", "complete")
    assert [run.id for run in dataset] == ["run"]


def test_a_selection_is_a_data_set_of_its_own(small_dataset: Path, tmp_path: Path) -> None:
    test = wt.open(small_dataset).split("test")
    back = wt.open(import_hdf5(export_hdf5(test, tmp_path / "t.h5"), tmp_path / "back"))
    assert [(run.id, run.split) for run in back] == [("seed0002", "test"), ("seed0003", "test")]


def test_a_run_that_crashed_or_is_collected_keeps_its_status(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "r.zarr", RunInfo(run_id="r", layout=LAYOUT, block=4))
    for row in weights(9):
        writer.append(row, num_timesteps=0)
    back = import_hdf5(export_hdf5(tmp_path / "r.zarr", tmp_path / "r.h5"), tmp_path / "back")
    assert wt.open(back).info.status == "collecting"
    assert (wt.open(back).runs[0].info.status, len(wt.open(back).runs[0])) == ("collecting", 8)
    writer.close("crashed")


def test_h5py_alone_reads_it(file: Path) -> None:
    kinds = {}
    with h5py.File(file) as root:
        found = root["runs/run/policy/weights"]
        assert np.array_equal(found[:], weights(20))
        assert [dim.label for dim in found.dims] == ["time", "param"]
        assert (found.compression, found.shuffle, found.fletcher32) == ("gzip", True, True)
        assert np.isnan(found.fillvalue)
        assert root["runs/run/index/phase"].fillvalue == -1
        assert json.loads(root["runs/run/run.json"][()])["weighttraj"] == to_json(INFO) | {
            "status": "complete",
            "n_committed": 20,
            "n_committed_iterations": 4,
        }
        root.visititems(lambda name, item: kinds.update({name: getattr(item, "dtype", None)}))
    assert len(kinds) > 20
    assert {kind.kind for kind in kinds.values() if kind is not None} == set("fiuS")
    assert file.read_bytes()[8] == 3  # the superblock of HDF5 1.10, which has a checksum


def test_equal_runs_give_equal_files(run: wt.Run, file: Path, tmp_path: Path) -> None:
    assert export_hdf5(run, tmp_path / "again.h5").read_bytes() == file.read_bytes()


# All or nothing


def test_what_exists_is_not_overwritten(run: wt.Run, file: Path, tmp_path: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(StoreExistsError, match="choose another path"):
        export_hdf5(run, file)
    assert file.read_bytes() == before
    (tmp_path / "taken").mkdir()
    with pytest.raises(StoreExistsError, match="a folder"):
        import_hdf5(file, tmp_path / "taken")


def test_a_damaged_source_leaves_nothing(run: wt.Run, file: Path, tmp_path: Path) -> None:
    chunk = sorted((run.path / "optimizer/exp_avg/c").rglob("2/0"))[0]
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(DamageError, match="optimizer/exp_avg"):
        export_hdf5(run, tmp_path / "out.h5")
    content = bytearray(file.read_bytes())
    with h5py.File(file) as root:
        content[root["runs/run/critic/weights"].id.get_chunk_info(0).byte_offset + 5] ^= 1
    file.write_bytes(content)
    with pytest.raises(DamageError):
        import_hdf5(file, tmp_path / "out")
    assert not list(tmp_path.glob("*out*"))


def test_a_killed_export_leaves_no_file_under_its_name(tmp_path: Path) -> None:
    layout = ParamLayout.of({"w": ((100_000,), "other", ("fixed",))})
    with RunWriter(tmp_path / "run.zarr", RunInfo(run_id="r", layout=layout)) as writer:
        for row in weights(100, 100_000):
            writer.append(row, num_timesteps=0)
    out = tmp_path / "out.h5"
    code = "import sys; from weighttraj.tools.hdf5 import export_hdf5; export_hdf5(*sys.argv[1:])"
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "run.zarr"), str(out)], cwd=ROOT
    )
    while not list(tmp_path.glob(".out.h5.*.draft")):
        assert child.poll() is None
        time.sleep(0.01)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert not out.exists()
    assert np.array_equal(
        open_hdf5(export_hdf5(tmp_path / "run.zarr", out)).runs[0].weights[99],
        weights(100, 100_000)[99],
    )


# Processes


def weights_of(run: wt.Run) -> bytes:
    return run.weights[:].tobytes()


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
@pytest.mark.parametrize(
    "method", ["fork", "spawn", pytest.param("forkserver", marks=pytest.mark.long)]
)
def test_other_processes_read_it(file: Path, method: str) -> None:
    run = open_hdf5(file).runs[0]
    expected = weights_of(run)
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.map(weights_of, [run] * 4) == [expected] * 4
    assert weights_of(pickle.loads(pickle.dumps(run))) == expected  # noqa: S301
    assert weights_of(run) == expected


# Damage

FLIPS = """
import collections, sys
from pathlib import Path
import numpy as np
from weighttraj.errors import WeightTrajError
from weighttraj.tools.hdf5 import open_hdf5

path = Path(sys.argv[1])
whole, rng, count = path.read_bytes(), np.random.default_rng(0), collections.Counter()
truth = {name: array[:].tobytes() for name, array in open_hdf5(path).runs[0].arrays.items()}
for _ in range(200):
    flipped = bytearray(whole)
    flipped[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
    path.write_bytes(flipped)
    outcomes = {"right"}
    try:
        arrays = open_hdf5(path).runs[0].arrays
    except WeightTrajError:
        arrays, outcomes = {}, {"refused"}
    for name, array in arrays.items():
        try:
            outcomes.add("right" if array[:].tobytes() == truth[name] else "WRONG")
        except WeightTrajError:
            outcomes.add("refused")
    count[min(outcomes)] += 1  # WRONG < refused < right
print(dict(count))
"""


def test_no_flipped_bit_gives_wrong_numbers(file: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FLIPS, str(file)], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr  # HDF5 did not crash
    count = eval(done.stdout)  # noqa: S307
    assert count.keys() == {"refused", "right"}
    assert count["refused"] > 100


def test_a_truncated_file_is_damage(file: Path) -> None:
    content = file.read_bytes()
    for size in (len(content) - 1, len(content) // 2, 100, 9):
        file.write_bytes(content[:size])
        with pytest.raises(DamageError, match=r"run\.h5"):
            open_hdf5(file)
    file.write_bytes(b"")
    with pytest.raises(FormatError, match="no HDF5 file"):
        open_hdf5(file)


def test_a_lost_chunk_whose_checksum_is_right_is_found(file: Path) -> None:
    with h5py.File(file, "r+") as root:
        found = root["runs/run/critic/weights"]  # one that neither shuffle nor gzip made smaller
        found.id.write_direct_chunk((0, 0), bytes(20 * 5 * 4 + 4), filter_mask=0b011)
    with h5py.File(file) as root:
        assert not root["runs/run/critic/weights"][:].any()  # HDF5 has nothing to say
    with pytest.raises(DamageError, match="not what was written"):
        open_hdf5(file).runs[0]["critic/weights"][3]


def rewrite(file: Path, name: str, change: Callable[[dict[str, object]], object]) -> None:
    """Change metadata and give them the checksum that they should have."""
    with h5py.File(file, "r+") as root:
        document = json.loads(root[name][()])
        del document["sha256"], root[name]
        change(document)
        document["sha256"] = checksum(document)
        root[name] = np.bytes_(json.dumps(document))


def test_forged_weights_do_not_match_their_digest(file: Path) -> None:
    from weighttraj.store.hdf5_run import sha256

    with h5py.File(file, "r+") as root:
        root["runs/run/policy/weights"][5, 5] = 42
        block = sha256(root["runs/run/policy/weights"][:])
    rewrite(
        file,
        "runs/run/run.json",
        lambda d: d["arrays"]["policy/weights"].update(sha256=[block]),  # type: ignore[index]
    )
    run = open_hdf5(file).runs[0]
    assert np.array_equal(run.weights[6], weights(20)[6])
    with pytest.raises(DamageError, match="digest"):
        run.weights[5]


def test_changed_metadata_do_not_match_their_checksum(file: Path) -> None:
    for name in ("dataset.json", "runs/run/run.json"):
        content = file.read_bytes()
        with h5py.File(file, "r+") as root:
            text = bytes(root[name][()])
            del root[name]
            root[name] = np.bytes_(text.replace(b'"status": "complete"', b'"status": "crashed"'))
        with pytest.raises(FormatError):
            open_hdf5(file).runs[0].info  # noqa: B018
        file.write_bytes(content)
    assert open_hdf5(file).runs[0].info.status == "complete"


def test_a_newer_file_is_refused(file: Path) -> None:
    content = file.read_bytes()
    rewrite(file, "dataset.json", lambda d: d.update(format_version=2))
    with pytest.raises(NewerFormatError, match="got: 2"):
        open_hdf5(file)
    file.write_bytes(content)
    rewrite(file, "runs/run/run.json", lambda d: d["weighttraj"].update(format_version=2))  # type: ignore[attr-defined]
    with pytest.raises(NewerFormatError, match="got: 2"):
        open_hdf5(file).runs[0].info  # noqa: B018


def test_other_files_are_not_ours(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        open_hdf5(tmp_path / "no.h5")
    (tmp_path / "text.h5").write_text("This is no HDF5 file.")
    with pytest.raises(FormatError, match="no HDF5 file"):
        open_hdf5(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as root:
        root["data"] = 1
    with pytest.raises(FormatError, match=r"no data set of weighttraj[\s\S]*'data'"):
        open_hdf5(tmp_path / "other.h5")


def test_a_run_that_the_file_lacks_is_named(small_dataset: Path, tmp_path: Path) -> None:
    file = export_hdf5(small_dataset, tmp_path / "small.h5")
    with h5py.File(file, "r+") as root:
        del root["runs/seed0002"]
    with pytest.raises(DamageError, match="seed0002"):
        open_hdf5(file)
    rewrite(file, "dataset.json", lambda d: d.update(status="collecting"))
    assert len(open_hdf5(file)) == 3
    with h5py.File(file, "r+") as root:
        root["runs/seed0002"] = root["runs/seed0001"]
    with pytest.raises(FormatError, match="not the one that the data set lists"):
        open_hdf5(file)["seed0002"].info  # noqa: B018


# Files that nobody should trust

NAME = "policy/weights"


def elsewhere(group: h5py.Group) -> None:
    group[NAME] = h5py.ExternalLink("/tmp/other.h5", "/weights")  # noqa: S108


def soft(group: h5py.Group) -> None:
    group["kept"] = np.zeros((20, 12), np.float32)
    group[NAME] = h5py.SoftLink(f"{group.name}/kept")


def soft_folder(group: h5py.Group) -> None:
    group.create_dataset(f"kept/{NAME}", data=weights(20), chunks=True)
    del group["policy"]
    group["policy"] = h5py.SoftLink(f"{group.name}/kept/policy")


def external(group: h5py.Group) -> None:
    group.create_dataset(NAME, (20, 12), "<f4", external=[("/etc/passwd", 0, 960)])


def virtual(group: h5py.Group) -> None:
    layout = h5py.VirtualLayout((20, 12), "<f4")
    layout[:] = h5py.VirtualSource("/tmp/other.h5", "x", (20, 12))  # noqa: S108
    group.create_virtual_dataset(NAME, layout)


def contiguous(group: h5py.Group) -> None:
    group[NAME] = weights(20)


def unknown_filter(group: h5py.Group) -> None:
    group.create_dataset(NAME, data=weights(20), chunks=(20, 12), scaleoffset=3)


def huge_chunk(group: h5py.Group) -> None:
    group.create_dataset(NAME, (20, 12), "<f4", maxshape=(None, 12), chunks=(1 << 25, 12))


def wrong_type(group: h5py.Group) -> None:
    group.create_dataset(NAME, data=weights(20).astype(np.float64), chunks=(20, 12))


def big_endian(group: h5py.Group) -> None:
    group.create_dataset(NAME, data=weights(20).astype(">f4"), chunks=(20, 12))


def objects(group: h5py.Group) -> None:
    group.create_dataset(NAME, (20, 12), h5py.vlen_dtype(np.float32), chunks=(20, 12))


def wrong_shape(group: h5py.Group) -> None:
    group.create_dataset(NAME, (1 << 40, 12), "<f4", maxshape=(None, 12), chunks=(20, 12))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (elsewhere, "is a link"),
        (soft, "is a link"),
        (soft_folder, "is a link"),
        (external, "stored in a way"),
        (virtual, "stored in a way"),
        (contiguous, "stored in a way"),
        (unknown_filter, "stored in a way"),
        (huge_chunk, "stored in a way"),
        (wrong_type, "not what the run's metadata says"),
        (big_endian, "not what the run's metadata says"),
        (objects, "not what the run's metadata says"),
        (wrong_shape, "not what the run's metadata says"),
    ],
)
def test_arrays_that_no_reader_should_meet(
    file: Path, change: Callable[[h5py.Group], None], says: str
) -> None:
    with h5py.File(file, "r+") as root:
        del root[f"runs/run/{NAME}"]
        change(root["runs/run"])
    with pytest.raises(FormatError, match=says):
        open_hdf5(file).runs[0].weights[:]


def test_arrays_and_chunks_that_are_missing_are_named(file: Path) -> None:
    content = file.read_bytes()
    with h5py.File(file, "r+") as root:
        del root["runs/run/index/phase"]
    with pytest.raises(DamageError, match="/runs/run/index/phase"):
        open_hdf5(file).runs[0].weights[:]
    file.write_bytes(content)
    with h5py.File(file, "r+") as root:
        del root["runs/run/index/phase"]
        root["runs/run"].create_dataset("index/phase", (20,), "<i8", chunks=(20,), fillvalue=-1)
    with pytest.raises(DamageError, match="committed data is missing"):
        open_hdf5(file).runs[0].weights[:]


def huge(group: h5py.Group, name: str) -> None:
    group.create_dataset(name, (), "S17000000")


def variable(group: h5py.Group, name: str) -> None:
    group[name] = "{}"


def table(group: h5py.Group, name: str) -> None:
    group[name] = np.array([b"{}", b"{}"])


def outside(group: h5py.Group, name: str) -> None:
    group.create_dataset(name, (1,), "S64", external=[("/etc/passwd", 0, 64)])


def number(group: h5py.Group, name: str) -> None:
    group[name] = 1


@pytest.mark.parametrize("name", ["dataset.json", "runs/run/run.json"])
@pytest.mark.parametrize("change", [huge, variable, table, outside, number])
def test_metadata_that_no_reader_should_meet(
    file: Path, name: str, change: Callable[[h5py.Group, str], None]
) -> None:
    with h5py.File(file, "r+") as root:
        del root[name]
        change(root, name)
    with pytest.raises(FormatError, match="at most 16777216 bytes"):
        open_hdf5(file).runs[0].info  # noqa: B018


@pytest.mark.parametrize(
    "blocks",
    [
        None,
        {"rows": 0, "sha256": []},
        {"rows": 7, "sha256": ["0" * 64] * 2},
        {"rows": 1 << 40, "sha256": ["0" * 64]},
        {"rows": "20", "sha256": []},
    ],
)
def test_blocks_that_do_not_cover_the_rows_are_refused(file: Path, blocks: object) -> None:
    def change(document: dict[str, object]) -> None:
        document["arrays"][NAME] = blocks  # type: ignore[index]

    rewrite(file, "runs/run/run.json", change)
    with pytest.raises(FormatError, match="blocks of an array"):
        open_hdf5(file).runs[0].info  # noqa: B018


def test_ids_from_the_file_do_not_lead_out_of_the_folder(file: Path, tmp_path: Path) -> None:
    rewrite(file, "dataset.json", lambda d: d["runs"][0].update(path="../../run.zarr"))  # type: ignore[index]
    with pytest.raises(FormatError, match="under its own name"):
        import_hdf5(file, tmp_path / "back")
    assert not (tmp_path / "back").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_file_is_readable(file: Path) -> None:
    shutil.copy(file, file.with_name("copy.h5"))
    file.chmod(0o400)
    assert np.array_equal(open_hdf5(file).runs[0].weights[:], weights(20))
