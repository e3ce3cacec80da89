"""Writer, reader and storage together: what was committed is what is read."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from zarr.storage import LocalStore

import weighttraj as wt
from weighttraj.errors import (
    DamageError,
    FormatError,
    NewerFormatError,
    ReplayError,
    SnapshotError,
    StoreExistsError,
    StoreLockedError,
)
from weighttraj.format import ObsNorm, ParamLayout, PolicySpec, RunInfo
from weighttraj.store.catalog import read_dataset_info, write_dataset_info
from weighttraj.store.live import LiveStore
from weighttraj.writer import RunWriter

LAYOUT = ParamLayout.of({"w": ((3, 4), "weight", ("hidden_0", "observation"))})
MASK = np.arange(20) % 3 == 1
INFO = RunInfo(
    run_id="run",
    layout=LAYOUT,
    policy=PolicySpec(kind="other", observation_shape=(4,)),
    obs_norm=ObsNorm(source="test", epsilon=1e-8, shape=(4,)),
    ret_norm=True,
    diagnostics=("approx_kl",),
    critic_layout=ParamLayout.of({"v": ((5,), "other", ("fixed",))}),
    optimizer_moments=True,
    probe_observations=2,
    block=8,
)


def weights(n: int, size: int = 12) -> np.ndarray:
    return np.random.default_rng(7).normal(size=(n, size)).astype(np.float32)


def append(writer: RunWriter, t: int, row: np.ndarray) -> None:
    writer.append(
        row,
        num_timesteps=10 * t,
        iteration=t // 5,
        gradient_step=t,
        learning_rate=0.5,
        obs_norm=(np.full(4, t), np.ones(4), float(t)),
        ret_norm=(np.array(0.0), np.array(2.0), 1.0),
        train={"approx_kl": 0.25} if t % 2 else {},
        critic=np.full(5, t, np.float32),
        moments=(np.zeros(12, np.float32), np.ones(12, np.float32)),
    )
    if t % 5 == 0:
        writer.append_iteration(np.full((2, 4), t, np.float32))


def write(path: Path, n: int = 20, info: RunInfo = INFO, *, resume: bool = False) -> wt.Run:
    with RunWriter(path, info, resume=resume) as writer:
        for t, row in enumerate(weights(n)):
            append(writer, t, row)
    return wt.open_run(path)


@pytest.fixture
def run(tmp_path: Path) -> wt.Run:
    return write(tmp_path / "run.zarr")


def in_a_process(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    root = Path(__file__).parents[2]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)


def chunk_files(run: wt.Run, array: str = "") -> list[Path]:
    return sorted(p for p in (run.path / array).rglob("c/**/*") if p.is_file())


def test_what_is_written_is_read(run: wt.Run) -> None:
    assert len(run) == 20
    assert run.info.status == "complete"
    assert np.array_equal(run.weights[:], weights(20))
    assert run.num_timesteps.tolist() == [10 * t for t in range(20)]
    assert run.phase.tolist() == [-1] * 20
    assert np.array_equal(run["train/approx_kl"][:], [np.nan, 0.25] * 10, equal_nan=True)
    assert run["critic/weights"][3].tolist() == [3] * 5
    assert run["optimizer/exp_avg_sq"][:].min() == 1
    assert run["probe/observations"][:, 0, 0].tolist() == [0, 5, 10, 15]
    stats = run.obs_norm(-1)
    assert stats is not None
    assert (stats.mean.tolist(), stats.count) == ([19] * 4, 19)
    assert wt.verify(run.path) == []


@pytest.mark.parametrize(
    "key", [0, -1, slice(3, 17), slice(2, 20, 5), slice(-3, None), [4, 1, -1], MASK]
)
def test_rows_are_selected_as_numpy_does(run: wt.Run, key: object) -> None:
    assert np.array_equal(run.weights[key], weights(20)[key])
    assert np.array_equal(np.asarray(run.weights), weights(20))


def test_columns_are_selected_as_numpy_does(run: wt.Run) -> None:
    assert np.array_equal(run.weights[2:9, 3:7], weights(20)[2:9, 3:7])


@pytest.mark.parametrize("key", [20, -21, [0, 20], slice(None, None, -1), 1.5, [True]])
def test_rows_that_are_not_committed_are_refused(run: wt.Run, key: object) -> None:
    with pytest.raises(IndexError):
        run.weights[key]


def test_unknown_arrays_are_answered_with_the_known_ones(run: wt.Run) -> None:
    with pytest.raises(KeyError, match="it stores policy/weights, digest"):
        run["policy/wieghts"]


def test_repr_shows_shapes_not_contents(run: wt.Run) -> None:
    assert repr(run) == "<Run run:  seed None, weights (time 20, param 12), complete>"
    assert "'time': 20, 'param': 12" in repr(run.weights)


def test_wide_weights_are_sharded_and_read_back(tmp_path: Path) -> None:
    layout = ParamLayout.of({"w": ((40_000,), "other", ("fixed",))})
    rows = weights(10, 40_000)
    with RunWriter(tmp_path / "run.zarr", RunInfo(run_id="r", layout=layout, block=4)) as writer:
        for row in rows:
            writer.append(row, num_timesteps=0)
    run = wt.open_run(tmp_path / "run.zarr")
    assert len(chunk_files(run, "policy/weights")) == 3
    assert np.array_equal(run.weights[1:9], rows[1:9])


@settings(max_examples=15, deadline=None)
@given(n=st.integers(0, 20), block=st.integers(1, 9))
def test_any_length_and_block_size_round_trips(
    tmp_path_factory: pytest.TempPathFactory, n: int, block: int
) -> None:
    info = RunInfo(run_id="r", layout=LAYOUT, block=block)
    path = tmp_path_factory.mktemp("store") / "run.zarr"
    with RunWriter(path, info) as writer:
        for t, row in enumerate(weights(n)):
            writer.append(row, num_timesteps=t)
    run = wt.open_run(path)
    assert np.array_equal(run.weights[:], weights(n))
    assert wt.verify(path) == []


def test_plain_zarr_reads_it_without_our_code(run: wt.Run) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        group = zarr.open_group(LocalStore(run.path, read_only=True), mode="r")
    array = group["policy/weights"]
    assert array.metadata.dimension_names == ("time", "param")
    assert np.array_equal(array[:], weights(20))
    assert group.attrs["weighttraj"]["n_committed"] == 20


def test_no_pickle_lies_on_disk(run: wt.Run) -> None:
    names = {p.name for p in run.path.rglob("*") if p.is_file()}
    assert {name for name in names if not name.isdigit()} == {"zarr.json"}


# Commit


def test_readers_see_committed_blocks_only(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    writer = RunWriter(path, INFO)
    for t, row in enumerate(weights(19)):
        append(writer, t, row)
    run = wt.open_run(path)
    assert (len(run), run.info.status) == (16, "collecting")
    assert np.array_equal(run.weights[:], weights(16))
    assert wt.verify(path) == []
    writer.flush()
    assert len(wt.open_run(path)) == 19
    writer.close()
    assert wt.open_run(path).info.status == "complete"


KILLED_WHILE_WRITING = """
import os, signal, sys
from pathlib import Path
from tests.store.test_store import INFO, RunWriter, append, weights
from weighttraj.store import live as storage

def kill_at(n):
    calls = 0
    def hook(path, content, **options):
        nonlocal calls
        calls += 1
        if calls == n:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(path, content, **options)
    return hook

original, place, n = storage.replace_file, sys.argv[2], int(sys.argv[3])
if place == "commit":
    storage.replace_file = kill_at(n)
else:
    original, calls = os.replace, 0
    def put(draft, target, **folders):
        global calls
        calls += 1
        if calls == n:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(draft, target, **folders)
    os.replace = put
with RunWriter(Path(sys.argv[1]), INFO) as writer:
    for t, row in enumerate(weights(20)):
        append(writer, t, row)
        print(writer.info.n_committed, flush=True)
"""


@pytest.mark.parametrize(
    ("place", "n"),
    [
        ("commit", 2),
        ("commit", 12),
        ("commit", 30),
        ("object", 25),
        ("object", 45),
        ("object", 60),
    ],
)
def test_a_killed_writer_leaves_what_it_had_committed(tmp_path: Path, place: str, n: int) -> None:
    path = tmp_path / "run.zarr"
    done = in_a_process(KILLED_WHILE_WRITING, path, place, n)
    assert done.returncode == -9, done.stderr
    reported = int((done.stdout.split() or ["0"])[-1])
    run = wt.open_run(path)
    assert len(run) >= reported
    assert np.array_equal(run.weights[:], weights(20)[: len(run)])
    assert all("weighttraj repair" in problem for problem in wt.verify(path))
    wt.repair(path)
    assert wt.verify(path) == []
    assert np.array_equal(write(path, resume=True).weights[:], weights(20))
    assert wt.verify(path) == []


def test_an_exception_commits_what_came_before_it(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    with pytest.raises(ZeroDivisionError), RunWriter(path, INFO) as writer:
        for t, row in enumerate(weights(11)):
            append(writer, t, row)
        raise ZeroDivisionError
    run = wt.open_run(path)
    assert (len(run), run.info.status) == (11, "crashed")
    assert wt.verify(path) == []


def test_an_interrupt_at_any_line_of_append_shifts_no_row(tmp_path: Path) -> None:
    rows, place = weights(12), 0
    while True:
        path, calls = tmp_path / f"{place}.zarr", 0

        def interrupt(frame: Any, event: str, _: object, place: int = place) -> Any:
            nonlocal calls
            if frame.f_code.co_filename.endswith("writer.py"):
                calls += event == "line"
                if calls == place:
                    calls += 1
                    raise KeyboardInterrupt
                return interrupt
            return None

        writer = RunWriter(path, INFO)
        for t in range(9):
            append(writer, t, rows[t])
        try:
            sys.settrace(interrupt)
            append(writer, 9, rows[9])
            done = True
        except KeyboardInterrupt:
            done = False
        finally:
            sys.settrace(None)
        writer.close("crashed")
        run = wt.open_run(path)
        assert len(run) in (9, 10)
        assert np.array_equal(run.weights[:], rows[: len(run)])
        assert run.num_timesteps.tolist() == [10 * t for t in range(len(run))]
        if done:
            break
        place += 7
    assert place > 50


def test_a_continued_run_has_the_bytes_of_an_undisturbed_one(tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole.zarr", tmp_path / "broken.zarr"
    write(whole)
    with pytest.raises(ZeroDivisionError), RunWriter(broken, INFO) as writer:
        for t, row in enumerate(weights(11)):
            append(writer, t, row)
        raise ZeroDivisionError
    write(broken, resume=True)
    files = [p.relative_to(whole) for p in whole.rglob("*") if p.is_file()]
    assert len(files) > 40
    for file in files:
        assert (whole / file).read_bytes() == (broken / file).read_bytes(), file


def test_a_continued_run_must_repeat_itself(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    writer = RunWriter(path, INFO)
    for t, row in enumerate(weights(9)):
        append(writer, t, row)
    writer.close("crashed")
    with (
        pytest.raises(ReplayError, match="snapshot 0"),
        RunWriter(path, INFO, resume=True) as again,
    ):
        append(again, 0, weights(9)[1])
    assert np.array_equal(wt.open_run(path).weights[:], weights(9))


def test_a_continued_run_must_reach_what_it_had(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    writer = RunWriter(path, INFO)
    for t, row in enumerate(weights(9)):
        append(writer, t, row)
    writer.close("crashed")
    with pytest.raises(ReplayError, match="at least 9"):
        write(path, 3, resume=True)
    assert len(wt.open_run(path)) == 9


def test_other_settings_do_not_continue_a_run(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    RunWriter(path, INFO).close("crashed")
    other = RunInfo(run_id="run", layout=LAYOUT, seed=3)
    with pytest.raises(FormatError, match="other settings"):
        RunWriter(path, other, resume=True)


def test_a_complete_run_is_not_continued(run: wt.Run) -> None:
    with pytest.raises(FormatError, match="complete"):
        RunWriter(run.path, INFO, resume=True)


def test_an_existing_path_is_not_overwritten(run: wt.Run, tmp_path: Path) -> None:
    with pytest.raises(StoreExistsError, match="resume=True"):
        RunWriter(run.path, INFO)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(StoreExistsError, match="a file"):
        RunWriter(tmp_path / "file", INFO)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_run_has_one_writer(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    writer = RunWriter(path, INFO)
    with pytest.raises(StoreLockedError, match="another process"):
        RunWriter(path, INFO, resume=True)
    writer.close("crashed")
    RunWriter(path, INFO, resume=True).close("crashed")


def test_a_closed_writer_takes_nothing(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "run.zarr", INFO)
    writer.close()
    writer.close()
    with pytest.raises(SnapshotError, match="closed"):
        append(writer, 0, weights(1)[0])


# Bad snapshots


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[RunWriter]:
    with RunWriter(tmp_path / "run.zarr", INFO) as writer:
        append(writer, 0, weights(1)[0])
        yield writer


def test_weights_that_are_not_finite_are_refused(writer: RunWriter) -> None:
    bad = weights(1)[0].copy()
    bad[[3, 7]] = np.nan, np.inf
    with pytest.raises(SnapshotError, match="2 of 12 NaN or infinite, the first at 3"):
        append(writer, 1, bad)
    writer.close()
    assert len(wt.open_run(writer.path)) == 1


def test_a_wrong_shape_is_refused(writer: RunWriter) -> None:
    with pytest.raises(SnapshotError, match=r"expected: \(12,\)\n  got: \(11,\)"):
        append(writer, 1, weights(1)[0][:11])


def test_a_missing_value_is_named(writer: RunWriter) -> None:
    with pytest.raises(SnapshotError, match="obs_norm/mean"):
        writer.append(weights(1)[0], num_timesteps=1)


def test_a_value_that_the_run_does_not_store_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(SnapshotError, match="train/loss"),
        RunWriter(tmp_path / "r.zarr", RunInfo(run_id="r", layout=LAYOUT)) as writer,
    ):
        writer.append(weights(1)[0], num_timesteps=1, train={"loss": 1.0})


# Damage


def test_a_flipped_bit_is_found_by_reading_and_by_verify(run: wt.Run) -> None:
    for file in chunk_files(run):
        whole = file.read_bytes()
        flipped = bytearray(whole)
        flipped[len(whole) // 2] ^= 4
        file.write_bytes(bytes(flipped))
        assert wt.verify(run.path), file
        file.write_bytes(whole)
    assert wt.verify(run.path) == []
    file = chunk_files(run, "policy/weights")[1]
    file.write_bytes(file.read_bytes()[:-1] + b"\0")
    assert np.array_equal(wt.open_run(run.path).weights[:8], weights(8))
    with pytest.raises(DamageError, match="policy/weights"):
        wt.open_run(run.path).weights[8:]


@pytest.mark.parametrize("damage", ["missing", "truncated", "empty"])
def test_missing_and_truncated_chunks_are_found(run: wt.Run, damage: str) -> None:
    for file in chunk_files(run):
        whole = file.read_bytes()
        if damage == "missing":
            file.unlink()
        else:
            file.write_bytes(whole[:-3] if damage == "truncated" else b"")
        assert wt.verify(run.path), file
        file.write_bytes(whole)
    assert wt.verify(run.path) == []


def test_rewritten_weights_do_not_match_their_digest(run: wt.Run) -> None:
    other = weights(8)
    other[5, 5] = 42.0
    store = LiveStore.open(run.path)
    store.write("policy/weights", 0, other)
    store.commit(run.info)
    with pytest.raises(DamageError, match="digest"):
        wt.open_run(run.path).weights[5]
    assert "digest" in wt.verify(run.path)[0]


def test_weights_rewritten_by_zarr_are_not_what_was_committed(run: wt.Run) -> None:
    array = zarr.open_array(LocalStore(run.path), path="policy/weights", mode="r+")
    array[5, 5] = 42.0
    with pytest.raises(DamageError, match="another chunk"):
        wt.open_run(run.path).weights[5]


def test_a_chunk_in_the_place_of_another_is_found(run: wt.Run) -> None:
    first, second, _ = chunk_files(run, "index/num_timesteps")
    second.write_bytes(first.read_bytes())
    assert np.array_equal(wt.open_run(run.path)["index/num_timesteps"][:8], 10 * np.arange(8))
    with pytest.raises(DamageError, match="another chunk"):
        wt.open_run(run.path)["index/num_timesteps"][:]
    assert "another chunk" in wt.verify(run.path)[0]


def test_damaged_metadata_is_found(run: wt.Run) -> None:
    for file in run.path.rglob("zarr.json"):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        assert wt.verify(run.path), file
        if file.parent != run.path:  # the run's own metadata say what it was
            assert np.array_equal(wt.open_run(run.path).weights[:], weights(20))
            assert "mended" in wt.repair(run.path)[0]
        file.write_bytes(whole)
    assert wt.verify(run.path) == []


def test_changed_metadata_do_not_match_their_checksum(run: wt.Run) -> None:
    text = (run.path / "zarr.json").read_text()
    (run.path / "zarr.json").write_text(text.replace('"epsilon": 1e-08', '"epsilon": 3e-08'))
    with pytest.raises(DamageError, match="checksum"):
        wt.open_run(run.path)


def test_a_newer_store_is_refused(run: wt.Run) -> None:
    document = json.loads((run.path / "zarr.json").read_text())
    document["attributes"]["weighttraj"]["format_version"] = 2
    (run.path / "zarr.json").write_text(json.dumps(document))
    with pytest.raises(NewerFormatError, match="got: 2"):
        wt.open_run(run.path)


def test_something_else_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no zarr\.json"):
        wt.open_run(tmp_path)
    zarr.create_group(LocalStore(tmp_path / "plain.zarr"))
    with pytest.raises(FormatError, match="no run of weighttraj"):
        wt.open_run(tmp_path / "plain.zarr")


def test_counters_that_go_back_are_found(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    with RunWriter(path, RunInfo(run_id="r", layout=LAYOUT)) as writer:
        for t in (1, 2, 1):
            writer.append(weights(3)[t], num_timesteps=t)
    assert "index/num_timesteps: goes back at row 2" in wt.verify(path)[0]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_run_is_readable(run: wt.Run) -> None:
    run.path.chmod(0o500)
    assert np.array_equal(wt.open_run(run.path).weights[:], weights(20))


def test_a_full_disk_leaves_what_was_committed(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    writer = RunWriter(path, INFO)
    for t, row in enumerate(weights(8)):
        append(writer, t, row)
    # A file-size limit of the process stands for the disk: writes beyond it fail with EFBIG.
    script = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from tests.store.test_store import *\n"
        "writer = RunWriter(Path(sys.argv[1]), INFO, resume=True)\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        "for t, row in enumerate(weights(16)): append(writer, t, row)\n"
    )
    writer.close("crashed")
    done = in_a_process(script, path)
    assert "File too large" in done.stderr
    assert len(wt.open_run(path)) == 8
    assert wt.verify(path) == []


def test_a_run_can_be_sent_to_another_process(run: wt.Run) -> None:
    run.weights[:]
    again = pickle.loads(pickle.dumps(run))  # noqa: S301
    assert np.array_equal(again.weights[:], run.weights[:])


# Data sets


def test_a_data_set_opens_while_it_is_collected(small_dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "dataset"
    shutil.copytree(small_dataset, path)
    (path / "runs/seed0001.zarr.zip").unlink()
    with pytest.raises(DamageError, match="lacks a run that it lists"):
        wt.open(path)
    assert "lacks a run" in wt.verify(path)[0]
    write_dataset_info(path, replace(read_dataset_info(path), status="collecting"))
    assert [run.id for run in wt.open(path)] == ["seed0000", "seed0002", "seed0003"]


def test_splits_are_by_run(small_dataset: Path) -> None:
    dataset = wt.open(small_dataset)
    assert len(dataset) == 4
    assert [run.info.seed for run in dataset.split("train")] == [0, 1]
    assert [run.info.seed for run in dataset.split("test")] == [2, 3]
    with pytest.raises(FormatError, match="expected: one of \\['test', 'train'\\]"):
        dataset.split("validation")
    assert dataset[0] is dataset["seed0000"]
    assert dataset[-1].seed == 3


def test_a_data_set_is_seen_at_a_glance(small_dataset: Path) -> None:
    dataset = wt.open(small_dataset)
    lines = repr(dataset).splitlines()
    assert len(lines) <= 12
    told = dict(line.split(maxsplit=1) for line in lines[1:])
    assert told["runs"] == "4 runs: 2 train, 2 test"
    assert told["training"] == "PPO on InvertedPendulum-v4"
    assert "weights float32 (time 49, param 122), one every 2 gradient steps" in repr(dataset)
    assert "<td style='text-align:left'>4 runs: 2 train, 2 test</td>" in dataset._repr_html_()


def test_one_run_opens_as_a_data_set_of_one_run(small_dataset: Path, tmp_path: Path) -> None:
    for path in (write(tmp_path / "run.zarr").path, small_dataset / "runs/seed0000.zarr.zip"):
        (run,) = wt.open(path)
        assert run["digest"][:].tobytes() == wt.open_run(path)["digest"][:].tobytes()
    with pytest.raises(FileNotFoundError):
        wt.open_run(small_dataset)


def test_a_run_under_anothers_name_is_refused(small_dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "dataset"
    shutil.copytree(small_dataset, path)
    shutil.copy(path / "runs/seed0000.zarr.zip", path / "runs/seed0001.zarr.zip")
    with pytest.raises(FormatError, match="not the one that the data set lists"):
        _ = wt.open(path)["seed0001"].weights


def test_a_kill_between_a_rewritten_block_and_its_commit_loses_nothing(tmp_path: Path) -> None:
    """A block that was committed half full is written again, whole, before the commit says so."""
    path = tmp_path / "run.zarr"
    script = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from tests.store.test_store import INFO, RunWriter, append, weights\n"
        "from weighttraj.store import live\n"
        "writer = RunWriter(Path(sys.argv[1]), INFO, resume=True)\n"
        "kill = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)\n"
        "for t, row in enumerate(weights(16)):\n"
        "    if t == 15: live.replace_file = kill\n"
        "    append(writer, t, row)\n"
    )
    for status in ("crashed", "collecting"):
        shutil.rmtree(path, ignore_errors=True)
        writer = RunWriter(path, INFO)
        for t, row in enumerate(weights(11)):
            append(writer, t, row)
        writer.close(status)
        done = in_a_process(script, path)
        assert done.returncode == -9, done.stderr
        run = wt.open_run(path)
        assert np.array_equal(run.weights[:], weights(11))
        assert wt.verify(path) == []
        assert np.array_equal(write(path, resume=True).weights[:], weights(20))
        assert wt.verify(path) == []
