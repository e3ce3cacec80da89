from __future__ import annotations

import pickle
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from weighttraj import run as reader
from weighttraj.errors import DamageError
from weighttraj.load import CachedWeights, CacheError, cache_folder, cache_size, clear_cache
from weighttraj.tools.pack import pack

ROOT = Path(__file__).parents[2]
HEADER = 128
WIDE_BYTES = HEADER + 4 * 300 * 20_000


@pytest.fixture
def run(small_dataset: Path) -> wt.Run:
    return wt.open(small_dataset).runs[0]


def python(code: str, *args: object, shell: str = "") -> subprocess.Popen[str]:
    command = [sys.executable, "-c", code, *map(str, args)]
    if shell:
        command = ["unshare", "--mount", "sh", "-c", f'{shell} && exec "$@"', "sh", *command]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    )


def names(cache: Path) -> list[str]:
    """Everything there but the locks."""
    return sorted(file.name for file in cache.iterdir() if not file.name.endswith(".lock"))


def test_an_entry_is_the_run_as_a_plain_npy_file(run: wt.Run, cache: Path) -> None:
    cached = CachedWeights(run)
    rows = cached.map()
    assert np.array_equal(rows, run.weights[:])
    assert rows.dtype == np.float32
    assert (rows.flags.c_contiguous, rows.flags.writeable) == (True, False)
    assert names(cache) == [f"{cached.key}.npy"]
    assert np.array_equal(np.load(cached.path, mmap_mode="r"), run.weights[:])
    assert repr(cached) == "<CachedWeights of seed0000: time 49, param 122>"


def test_an_entry_is_made_once_and_read_from_then_on(run: wt.Run) -> None:
    cached = CachedWeights(run)
    cached.map()
    made = cached.path.stat()
    again = CachedWeights(wt.open_run(run.path))
    assert np.array_equal(again.map(), run.weights[:])
    assert (made.st_ino, made.st_mtime_ns) == (
        again.path.stat().st_ino,
        again.path.stat().st_mtime_ns,
    )


def test_a_run_is_decoded_in_pieces(wide_run: wt.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "PIECE_BYTES", 1 << 20)
    sizes = [len(piece) for piece in CachedWeights(wide_run)._pieces()]
    assert sizes == [HEADER, *[8 * 80_000] * 37, 4 * 80_000]
    assert np.array_equal(CachedWeights(wide_run).map(), wide_run.weights[:])


def test_a_copy_and_a_packed_copy_of_a_run_have_its_entry(
    wide_run: wt.Run, run: wt.Run, tmp_path: Path
) -> None:
    shutil.copytree(wide_run.path, tmp_path / "copy.zarr")
    pack(wide_run.path, out=tmp_path / "packed.zarr.zip")
    copies = [wt.open_run(tmp_path / name) for name in ("copy.zarr", "packed.zarr.zip")]
    keys = [CachedWeights(copy).key for copy in copies]
    assert keys == [CachedWeights(wide_run).key] * 2
    assert CachedWeights(run).key not in keys


def test_a_run_that_grows_gets_another_entry(tmp_path: Path, cache: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    info = wt.RunInfo(run_id="r", layout=layout, block=4)
    with wt.RunWriter(tmp_path / "r.zarr", info) as writer:
        for t in range(6):
            writer.append(np.full(3, t, np.float32), num_timesteps=t)
        early = CachedWeights(wt.open_run(tmp_path / "r.zarr"))
        assert early.map()[:, 0].tolist() == [0, 1, 2, 3]
        for t in range(6, 9):
            writer.append(np.full(3, t, np.float32), num_timesteps=t)
        late = CachedWeights(wt.open_run(tmp_path / "r.zarr"))
        assert late.map()[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
        assert early.map()[:, 0].tolist() == [0, 1, 2, 3]
    assert names(cache) == sorted(f"{cached.key}.npy" for cached in (early, late))


@pytest.mark.parametrize("harm", ["shorter", "longer", "empty", "header", "other shape"])
def test_an_entry_that_is_not_whole_is_made_again(run: wt.Run, harm: str) -> None:
    cached = CachedWeights(run)
    cached.map()
    whole = cached.path.read_bytes()
    transposed = np.zeros((122, 49), np.float32)
    bad = {
        "shorter": whole[:-4],
        "longer": whole + b"\0",
        "empty": b"",
        "header": whole.replace(b"<f4", b"<i4", 1),
        "other shape": whole[:HEADER].replace(b"(49, 122)", b"(122, 49)") + transposed.tobytes(),
    }
    cached.path.unlink()
    cached.path.write_bytes(bad[harm])
    assert np.array_equal(cached.map(), run.weights[:])
    assert cached.path.read_bytes() == whole


def test_it_is_pickled_as_a_name_not_as_data(wide_run: wt.Run) -> None:
    cached = CachedWeights(wide_run)
    rows = cached.map()
    text = pickle.dumps(cached)
    assert len(text) < 50_000
    assert np.array_equal(pickle.loads(text).map(), rows)  # noqa: S301


# Two processes, and dead ones

MAP = """
import sys, time
from pathlib import Path
import weighttraj as wt
from weighttraj.load import CachedWeights
print("ready", flush=True)
sys.stdin.readline() if sys.argv[2:] else None
cached = CachedWeights(wt.open_run(sys.argv[1]))
rows = cached.map()
maps = [line.split() for line in open("/proc/self/maps") if str(cached.path) in line]
print(len(maps), maps[0][4], maps[0][5:], float(rows.sum(dtype="f8")))
"""


def test_two_processes_that_want_an_entry_at_once_make_it_once(
    wide_run: wt.Run, cache: Path
) -> None:
    command = [sys.executable, "-c", MAP, str(wide_run.path), "wait"]
    both = [
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
        )
        for _ in range(2)
    ]
    for process in both:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in both:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    said = [process.communicate(timeout=120)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert said[0] == said[1]  # the inode that each has mapped among it, and that it is not deleted
    assert "deleted" not in said[0]
    assert names(cache) == [f"{CachedWeights(wide_run).key}.npy"]


KILLED_AT_A_BYTE = """
import resource, signal, sys
import weighttraj as wt
from weighttraj.load import CachedWeights
cached = CachedWeights(wt.open_run(sys.argv[1]))
signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # the system kills it, amid a write
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
cached.map()
"""


@pytest.mark.parametrize("size", [50, WIDE_BYTES // 2, WIDE_BYTES - 1])
def test_a_killed_process_leaves_no_entry_and_its_draft_goes(
    wide_run: wt.Run, cache: Path, size: int
) -> None:
    process = python(KILLED_AT_A_BYTE, wide_run.path, size)
    said = process.communicate(timeout=120)
    assert process.returncode == -signal.SIGXFSZ, said
    (draft,) = names(cache)
    assert draft.endswith(".draft")
    assert cache_size() == size
    cached = CachedWeights(wide_run)
    assert np.array_equal(cached.map(), wide_run.weights[:])
    assert names(cache) == [f"{cached.key}.npy"]


def test_a_process_killed_by_hand_leaves_no_entry(wide_run: wt.Run, cache: Path) -> None:
    process = python(KILLED_WHEN_IT_WRITES, wide_run.path)
    said = process.communicate(timeout=120)
    assert process.returncode == -signal.SIGKILL, said
    assert [name for name in names(cache) if name.endswith(".npy")] == []
    assert np.array_equal(CachedWeights(wide_run).map(), wide_run.weights[:])


KILLED_WHEN_IT_WRITES = """
import os, signal, sys
import weighttraj as wt
from weighttraj import run
from weighttraj.load import CachedWeights
run.PIECE_BYTES = 1
pieces = CachedWeights._pieces
def kill_at(self):
    written = 0
    for piece in pieces(self):
        if written > 10_000_000:
            os.kill(os.getpid(), signal.SIGKILL)
        yield piece
        written += piece.nbytes
CachedWeights._pieces = kill_at
CachedWeights(wt.open_run(sys.argv[1])).map()
"""


# Folders that do not serve


def test_a_folder_that_cannot_be_made_is_an_error_that_names_the_variable(
    run: wt.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("mine")
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(CacheError, match="set WEIGHTTRAJ_CACHE to a folder on another disk"):
        CachedWeights(run).map()


LIMITED = """
import resource, sys
import weighttraj as wt
from weighttraj.tools.pack import pack
from weighttraj.load import CachedWeights, CacheError
if sys.argv[2:]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000_000, 10_000_000))
try:
    CachedWeights(wt.open_run(sys.argv[1])).map()
except CacheError as error:
    print(error)
"""


def test_a_write_that_the_system_refuses_leaves_nothing(wide_run: wt.Run, cache: Path) -> None:
    said, trouble = python(LIMITED, wide_run.path, "limited").communicate(timeout=120)
    assert "File too large" in said, trouble
    assert "set WEIGHTTRAJ_CACHE" in said
    assert names(cache) == []


def test_a_full_disk_is_said_and_leaves_nothing(wide_run: wt.Run, cache: Path) -> None:
    cache.mkdir()
    mount = f"mount -t tmpfs -o size=8m tmpfs {cache}"
    command = [str(shutil.which("unshare")), "--mount", "sh", "-c", mount]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no small disk can be mounted here")
    code = LIMITED + "import os; print(sorted(n for n in os.listdir(os.environ['WEIGHTTRAJ_CACHE'])"
    code += " if not n.endswith('.lock')))"
    said, trouble = python(code, wide_run.path, shell=mount).communicate(timeout=120)
    assert "No space left on device" in said, trouble
    assert "set WEIGHTTRAJ_CACHE" in said
    assert said.endswith("\n[]\n")


def test_damage_in_the_run_is_found_and_nothing_is_kept(
    wide_run: wt.Run, tmp_path: Path, cache: Path
) -> None:
    path = tmp_path / "damaged.zarr"
    shutil.copytree(wide_run.path, path)
    chunk = sorted((path / "policy/weights/c").glob("*/0"))[-1]
    content = bytearray(chunk.read_bytes())
    content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(DamageError, match="cannot be decoded"):
        CachedWeights(wt.open_run(path)).map()
    assert names(cache) == []


def test_the_folder_is_where_the_variables_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", "~/here")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "here"
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative, so to be ignored")
    assert cache_folder() == tmp_path / ".cache/weighttraj"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg/weighttraj"


# Size, and clearing


def test_clearing_removes_entries_and_drafts_and_no_file_of_others(
    wide_run: wt.Run, run: wt.Run, cache: Path
) -> None:
    assert (cache_size(), clear_cache()) == (0, 0)
    rows = CachedWeights(wide_run).map()
    CachedWeights(run).map()
    (cache / f".{'0' * 64}.{'1' * 16}.draft").write_bytes(b"12345")
    (cache / "notes.npy").write_text("mine")
    size = WIDE_BYTES + HEADER + 4 * 49 * 122 + 5
    assert cache_size() == size
    assert clear_cache() == size
    assert names(cache) == ["notes.npy"]
    assert cache_size() == 0
    assert np.array_equal(rows, wide_run.weights[:])  # a map outlives its name
    assert np.array_equal(CachedWeights(wide_run).map(), rows)


READ_ON = """
import sys
import weighttraj as wt
from weighttraj.load import CachedWeights
run = wt.open_run(sys.argv[1])
rows = CachedWeights(run).map()
print("mapped", flush=True)
sys.stdin.readline()
assert (rows == run.weights[:]).all()
"""


def test_another_process_reads_on_while_the_cache_is_cleared(wide_run: wt.Run, cache: Path) -> None:
    command = [sys.executable, "-c", READ_ON, str(wide_run.path)]
    reader = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert reader.stdout is not None
    assert reader.stdout.readline() == "mapped\n"
    assert clear_cache() == WIDE_BYTES
    assert names(cache) == []
    reader.communicate("go on\n", timeout=120)
    assert reader.returncode == 0
