"""What happens to data when the world does not cooperate: kills, flips, full disks, and others.

Small versions of tests/benchmarks/stress_format.py, which does the same in large numbers.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from tests.benchmarks.stress_format import (
    DAMAGES,
    RECIPE,
    contents,
    deletions,
    flips,
    forked,
    fuzz,
    judge,
    kills,
    make_samples,
    whole,
)
from tests.disk import grow
from weighttraj.collect import collect
from weighttraj.collect.costs import COSTS
from weighttraj.collect.settings import Seeds
from weighttraj.errors import CollectError, StoreLockedError
from weighttraj.load.cache import CachedWeights, CacheError

ONE_RUN = replace(RECIPE, seeds=Seeds(train=[0]))
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What nobody disturbed: two runs of 25 snapshots. Do not write to it."""
    path = tmp_path_factory.mktemp("faults") / "reference"
    collect(RECIPE, path)
    return path


@pytest.fixture(scope="module")
def samples(reference: Path) -> Path:
    """Data sets and run folders. Do not write to them."""
    make_samples(reference, reference.with_name("samples"))
    return reference.with_name("samples")


# fork() in a process with threads; the children only collect, or end
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_killed_collectors_lose_nothing_that_was_committed(reference: Path) -> None:
    result = kills(reference, seed=1, first=0, n=4)
    assert result.broken == []
    assert result.counts["kills by time"] + result.counts["kills by operation"] >= 1
    assert result.counts["data sets completed"] >= 1


def test_a_flipped_bit_is_found_and_never_read(samples: Path) -> None:
    result = flips(samples, seed=1, first=0, n=40)
    assert result.broken == []
    assert result.counts["flips refused"] > 10
    assert result.counts.total() == 40


def test_lost_and_strange_objects_are_found(samples: Path) -> None:
    result = deletions(samples, seed=1, first=0, n=60)
    assert result.broken == []
    assert {name.rpartition(" ")[0] for name in result.counts} == set(DAMAGES)


@pytest.mark.parametrize("names", [("index/epoch/c/0", "index/iteration/c/0")])
def test_a_chunk_in_the_place_of_another_is_found(
    samples: Path, tmp_path: Path, names: tuple[str, str]
) -> None:
    path = Path(shutil.copytree(samples / "complete.zarr", tmp_path / "run.zarr"))
    shutil.copyfile(*(path / name for name in names))
    assert judge(path, contents(samples / "complete.zarr")) == ("refused", [])


def test_mutated_metadata_are_refused_by_an_error_of_ours(samples: Path) -> None:
    result = fuzz(samples, seed=1, first=0, n=100)
    assert result.broken == []
    assert result.counts.total() == 100
    assert result.counts["fuzz forged refused"] > 5
    assert result.counts["fuzz plain refused"] > 30


# A full disk


def test_collecting_goes_on_after_a_full_disk(reference: Path, disk: Path) -> None:
    truth = contents(reference)
    seen = []
    # Too small for the first block, the second, the last, packing, the tables, ...
    for size in ("128k", "300k", "400k", "620k", "700k", "760k"):
        grow(disk, size)
        try:
            collect(ONE_RUN, disk / "data")
        except (CollectError, OSError) as error:
            assert "No space left on device" in str(error)  # noqa: PT017
            seen.append(type(error))
        assert all("weighttraj repair" in what for what in wt.verify(disk / "data", deep=True))
        for run in wt.open(disk / "data"):
            expected = truth[run.id][1]["policy/weights"]
            assert run.weights[:].tobytes() == expected[: run.weights[:].nbytes]
    assert len(seen) >= 4
    grow(disk, "4m")
    collect(ONE_RUN, disk / "data")
    assert whole(disk / "data", {"": None, "seed0000": truth["seed0000"]}) == []


def test_packing_onto_a_full_disk_leaves_nothing(reference: Path, disk: Path) -> None:
    source = wt.open(reference).runs[0].path
    with pytest.raises(OSError, match="No space left") as caught:
        wt.pack(source, out=disk / "run.zarr.zip")
    assert caught.value.errno == errno.ENOSPC
    assert list(disk.iterdir()) == []
    grow(disk, "2m")
    wt.pack(source, out=disk / "run.zarr.zip")
    again = wt.open_run(disk / "run.zarr.zip")
    assert np.array_equal(again.weights[:], wt.open_run(source).weights[:])
    assert wt.verify(again.path) == []


def test_sealing_on_a_full_disk_goes_on(reference: Path, disk: Path) -> None:
    grow(disk, "4m")
    path = Path(shutil.copytree(reference, disk / "data"))
    (path / "MANIFEST.sha256").unlink()
    shutil.rmtree(path / "tables")
    used = sum(p.stat().st_blocks * 512 for p in path.rglob("*"))
    (disk / "ballast").write_bytes(bytes((4 << 20) - used - (12 << 10)))
    with pytest.raises(OSError, match="No space left"):
        wt.seal(path)
    assert [p.name for p in path.rglob(".*")] == [COSTS]
    assert contents(path) == contents(reference)
    (disk / "ballast").unlink()
    wt.seal(path)
    assert wt.verify(path, deep=True) == []


def test_a_full_disk_of_the_cache_is_one_error(
    reference: Path, disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", str(disk / "cache"))
    (disk / "ballast").write_bytes(bytes(56 << 10))
    run = wt.open(reference).runs[0]
    with pytest.raises(CacheError, match="No space left"):
        CachedWeights(run).map()
    assert not list(disk.rglob("*.draft"))
    (disk / "ballast").unlink()
    assert np.array_equal(CachedWeights(run).map(), run.weights[:])


# Other people's folders, other writers, other clocks


AS_NOBODY = """
import os, sys
from pathlib import Path
import pyarrow.compute
import weighttraj as wt
from tests.benchmarks.stress_format import contents
from weighttraj.errors import WeightTrajError
os.environ["WEIGHTTRAJ_CACHE"] = "/proc/nothing"
for path in map(Path, sys.argv[1:]):
    contents(path)  # what Python loads on the way, others may not read
if os.geteuid() == 0:
    os.seteuid(65534)
for path in map(Path, sys.argv[1:]):
    contents(path)
    assert wt.verify(path, deep=True) == [], path
for action in (wt.repair, lambda p: wt.pack(p), lambda p: wt.RunWriter(p, None, resume=True)):
    try:
        action(Path(sys.argv[1]))
    except (OSError, WeightTrajError) as error:
        print(error)
    else:
        print("done?")
"""


def test_a_folder_that_cannot_be_written_is_read(samples: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:  # pytest's own are closed to others
        for name in ("complete.zarr", "default"):
            shutil.copytree(samples / name, Path(folder) / name)
        for path in [Path(folder), *Path(folder).rglob("*")]:
            path.chmod(0o555 if path.is_dir() else 0o444)
        command = [sys.executable, "-W", "ignore", "-c", AS_NOBODY]
        command += [f"{folder}/complete.zarr", f"{folder}/default"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
        for path in [Path(folder), *Path(folder).rglob("*")]:
            path.chmod(0o755)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Permission denied") == 3


SECOND_WRITER = """
import sys
import weighttraj as wt
from weighttraj.errors import StoreLockedError
try:
    wt.RunWriter(sys.argv[1], wt.open_run(sys.argv[1]).info, resume=True)
except StoreLockedError as error:
    print(error)
"""


def test_a_run_has_one_writer_among_all_processes(samples: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(samples / "crashed.zarr", tmp_path / "run.zarr"))
    info = wt.open_run(path).info
    writer = wt.RunWriter(path, info, resume=True)
    command = [sys.executable, "-W", "ignore", "-c", SECOND_WRITER, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "another process is writing this run" in done.stdout
    with pytest.raises(StoreLockedError):
        wt.repair(path)
    writer.close("crashed")
    assert contents(path) == contents(samples / "crashed.zarr")
    again = subprocess.run(command, capture_output=True, text=True, check=True)
    assert again.stdout == ""


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
@pytest.mark.parametrize("then", [2**31, 0])
def test_a_clock_that_jumps_changes_nothing(reference: Path, tmp_path: Path, then: int) -> None:
    out = tmp_path / "data"
    assert forked(out, operation=1000).ended() == "killed"
    assert (out / "runs/seed0000.zarr").is_dir()
    for path in [out, *out.rglob("*")]:
        os.utime(path, (then, then))
    collect(RECIPE, out)
    assert whole(out, contents(reference)) == []


def test_no_module_asks_for_the_time_or_age_of_anything() -> None:
    # The one date is that of provenance, for the record; the pauses are those between requests. Of
    # two objects that one server holds, an upload asks which is older, by that server's clock. How
    # long a collection took is written down, and progress is told now and then.
    asks = re.compile(r"time\.(time|monotonic|sleep)\(|st_[mca]time|getmtime|datetime")
    files = sorted((ROOT / "weighttraj").rglob("*.py"))
    assert len(files) > 20
    found = {p.name for p in files if asks.search(p.read_text())}
    assert found <= {"costs.py", "describe.py", "returns.py", "store.py", "upload.py"}
