"""Upload and download: whole or not at all, resumable, checked; against real servers."""

from __future__ import annotations

import multiprocessing
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import tipl
import weighttraj as wt
from tests.remote import servers
from tests.remote.conftest import Bucket, files_of, objects_of
from tests.shell import shell
from weighttraj.errors import (
    DamageError,
    FormatError,
    RegistryError,
    RemoteError,
    StoreExistsError,
    StoreLockedError,
)
from weighttraj.format import DatasetInfo, ParamLayout, RunEntry, RunInfo
from weighttraj.registry.download import source_of
from weighttraj.registry.upload import CLAIM
from weighttraj.remote import RemotePath
from weighttraj.remote.store import RemoteStore, store_at
from weighttraj.store.catalog import read_dataset_info, write_dataset_info
from weighttraj.writer import RunWriter


def store_of(address: str) -> RemoteStore:
    return store_at(RemotePath.parse(address).root)


# Upload


def test_what_is_published_is_what_is_here(bucket: Bucket, published: Path) -> None:
    place = wt.upload(published, f"{bucket.address}/team/small-v1")
    assert str(place) == f"{bucket.address}/team/small-v1"
    there = {k.removeprefix("team/small-v1/"): v for k, v in objects_of(bucket).items()}
    assert there == files_of(published)
    assert wt.upload(published, str(place)) == place  # nothing to do


def test_the_list_of_runs_is_written_last(moto_bucket: Bucket, published: Path) -> None:
    store, seen = store_of(moto_bucket.address), []
    write = store.write

    def watched(name: str, content: bytes | Path, *, new: bool = False) -> bool:
        seen.append(name)
        return write(name, content, new=new)

    store.write = watched  # type: ignore[method-assign]
    try:
        wt.upload(published, moto_bucket.address)
    finally:
        del store.write  # type: ignore[method-assign]
    assert seen[0] == CLAIM
    assert seen[-2:] == ["MANIFEST.sha256", "dataset.json"]


def test_what_is_published_stays(bucket: Bucket, published: Path, large: Path) -> None:
    wt.upload(published, bucket.address)
    before = objects_of(bucket)
    with pytest.raises(RegistryError, match="what is published stays"):
        wt.upload(large, bucket.address)
    assert objects_of(bucket) == before


def test_another_upload_is_not_disturbed(bucket: Bucket, published: Path, large: Path) -> None:
    store_of(bucket.address).write(CLAIM, (large / "MANIFEST.sha256").read_bytes())
    with pytest.raises(RegistryError, match=r"(?s)something else is being uploaded.*UPLOADING"):
        wt.upload(published, bucket.address)
    assert list(objects_of(bucket)) == [CLAIM]
    wt.upload(large, bucket.address)  # whose claim it is
    assert objects_of(bucket) == files_of(large)


def test_what_lies_there_from_before_is_written_over(bucket: Bucket, published: Path) -> None:
    """Whoever takes back the list of runs publishes anew; sizes say nothing of what lies there."""
    wt.upload(published, bucket.address)
    store = store_of(bucket.address)
    for name in ("dataset.json", "MANIFEST.sha256"):
        store.delete(name)
    readme = (published / "README.md").read_bytes()
    store.write("README.md", readme[::-1])
    wt.upload(published, bucket.address)
    assert objects_of(bucket) == files_of(published)


def test_what_lies_there_from_before_is_not_taken_for_begun(
    bucket: Bucket, published: Path
) -> None:
    store = store_of(bucket.address)
    store.write("README.md", (published / "README.md").read_bytes()[::-1])
    store.write(CLAIM, (published / "MANIFEST.sha256").read_bytes())  # and stopped there
    time.sleep(1.1)  # an S3 server's clock counts seconds
    store.write("tables/runs.parquet", published / "tables/runs.parquet")
    before = store.stat("tables/runs.parquet")
    time.sleep(1.1)
    wt.upload(published, bucket.address)
    assert objects_of(bucket) == files_of(published)
    assert store.stat("tables/runs.parquet") == before  # what came since the claim stays


def test_two_publishers_at_once(bucket: Bucket, published: Path, large: Path) -> None:
    """One of them wins, and what it published is whole."""
    outcomes: list[object] = []

    def publish(path: Path) -> None:
        try:
            outcomes.append(wt.upload(path, bucket.address))
        except RegistryError as error:
            outcomes.append(error)

    threads = [threading.Thread(target=publish, args=(path,)) for path in (published, large)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(isinstance(outcome, RegistryError) for outcome in outcomes) == 1
    assert objects_of(bucket) in (files_of(published), files_of(large))


@pytest.mark.parametrize("times", [5, pytest.param(20, marks=pytest.mark.long)])
def test_killed_many_times_readers_never_see_a_half(
    moto_bucket: Bucket, large: Path, tmp_path: Path, times: int
) -> None:
    """Each time a reader finds no data set, or all of it; in the end the bytes are the same."""
    code = (
        "import importlib, os, sys\n"
        "from weighttraj.remote.store import RemoteStore\n"
        "upload = importlib.import_module('weighttraj.registry.upload')\n"
        "upload._check = lambda *a: None  # what takes longest was done before\n"
        "write, calls = RemoteStore.write, []\n"
        "def deadly(*arguments, **options):\n"
        "    calls.append(1)\n"
        "    if len(calls) == int(sys.argv[3]):\n"
        "        os.kill(os.getpid(), 9)\n"
        "    return write(*arguments, **options)\n"
        "RemoteStore.write = deadly\n"
        "upload.upload(sys.argv[1], sys.argv[2])\n"
    )
    moments, killed, whole = random.Random(0), 0, files_of(large)
    for _ in range(times):
        moment = str(moments.choice((1, 2, 2, 3)))  # so many objects in, of those that are missing
        command = [sys.executable, "-c", code, str(large), moto_bucket.address, moment]
        killed += subprocess.run(command, check=False).returncode == -signal.SIGKILL
        try:
            dataset = wt.open(moto_bucket.address)
        except FileNotFoundError:
            continue
        assert [run.weights[:].shape for run in dataset] == [(1951, 122)] * 2
    assert killed >= 0.75 * times
    wt.upload(large, moto_bucket.address)
    assert objects_of(moto_bucket) == whole


def test_what_is_not_fit_to_be_published(published: Path, tmp_path: Path) -> None:
    address = f"file://{tmp_path}/out"
    bare = tmp_path / "bare"
    shutil.copytree(published, bare)
    (bare / "README.md").unlink()
    with pytest.raises(RegistryError, match=r"(?s)with a card.*weighttraj card"):
        wt.upload(bare, address)
    (bare / "README.md").write_text("# A card\n")
    with pytest.raises(RegistryError, match=r"(?s)to be cited.*## Citation"):
        wt.upload(bare, address)
    damaged = tmp_path / "damaged"
    shutil.copytree(published, damaged)
    file = damaged / "runs/seed0000.zarr.zip"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with pytest.raises(RegistryError, match="is damaged"):
        wt.upload(damaged, address)
    free = tmp_path / "free"
    shutil.copytree(published, free)
    info = read_dataset_info(free)
    write_dataset_info(free, wt.format.DatasetInfo(id=info.id, runs=info.runs, licence=""))
    with pytest.raises(RegistryError, match="with a licence"):
        wt.upload(free, address)
    assert not (tmp_path / "out").exists()


def test_what_looks_suspicious_is_held_back(published: Path, tmp_path: Path) -> None:
    twins = tmp_path / "twins"
    wt.registry.create([published / "runs/seed0000.zarr.zip"], tmp_path / "one")
    renamed = tmp_path / "twin.zarr.zip"
    from weighttraj.tools.pack import copy_packed

    copy_packed(published / "runs/seed0000.zarr.zip", renamed, "twin")
    wt.registry.create([published / "runs/seed0000.zarr.zip", renamed], twins)
    (twins / "README.md").write_text("# Twins\n\n## Citation\n\nNone.\n")
    wt.seal(twins)
    with pytest.raises(RegistryError, match=r"(?s)looks suspicious.*--despite-lint"):
        wt.upload(twins, f"file://{tmp_path}/out")
    wt.upload(twins, f"file://{tmp_path}/out", despite_lint=True)
    assert wt.verify(tmp_path / "out") == []


def test_web_servers_are_not_written_to(published: Path, server: servers.FileServer) -> None:
    with pytest.raises(RegistryError, match="can only be read from"):
        wt.upload(published, server.url)


# Download


def test_all_of_it(bucket: Bucket, published: Path, tmp_path: Path) -> None:
    wt.upload(published, f"{bucket.address}/small-v1")
    dataset = wt.download(f"{bucket.address}/small-v1")
    assert dataset.path == tmp_path / "store/small-v1"
    assert files_of(Path(dataset.path)) == files_of(published)
    assert wt.verify(dataset.path, deep=True) == []
    source = source_of(Path(dataset.path))
    assert source is not None
    assert source.repository == f"{bucket.address}/small-v1"
    # Again there is nothing to do; by its id it is found from now on.
    assert wt.download(f"{bucket.address}/small-v1").path == dataset.path
    assert wt.open("small-v1").path == dataset.path


def test_from_a_server_that_sends_whole_files_only(published: Path, tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    with servers.without_ranges(published.parent, tmp_path / "log") as url:
        dataset = wt.download(f"{url}/small-v1")
    assert files_of(Path(dataset.path)) == files_of(published)


def test_some_runs(server: servers.FileServer, tmp_path: Path, published: Path) -> None:
    dataset = wt.download(f"{server.url}/small-v1", tmp_path / "part", runs=["seed0002"])
    assert [run.id for run in dataset] == ["seed0002"]
    assert wt.verify(dataset.path, deep=True) == []
    assert dataset.info.recipe["part"]["runs"] == "1 of 4"
    run = "runs/seed0002.zarr.zip"
    assert (tmp_path / "part" / run).read_bytes() == (published / run).read_bytes()
    assert not any("seed0003" in request.path for request in server.log)


def folders(path: Path, snapshots: int) -> Path:
    """A data set whose runs are not packed."""
    entries = tuple(RunEntry(id=i, path=f"runs/{i}.zarr", split="train") for i in ("a", "b"))
    layout = ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    for entry in entries:
        info = RunInfo(run_id=entry.id, layout=layout, block=2)
        with RunWriter(path / entry.path, info) as writer:
            for t in range(snapshots):
                writer.append(np.full(3, t, np.float32), num_timesteps=t)
    (path / "README.md").write_text("# Folders\n")
    write_dataset_info(path, DatasetInfo(id="folders", runs=entries, status="complete"))
    wt.seal(path)
    return path


def test_some_runs_that_are_folders(tmp_path: Path) -> None:
    folder = folders(tmp_path / "folders", 3)
    dataset = wt.download(folder.as_uri(), tmp_path / "part", runs=["b"])
    assert [run.id for run in dataset] == ["b"]
    assert not (tmp_path / "part/runs/a.zarr").exists()
    assert wt.verify(dataset.path, deep=True) == []


@pytest.mark.parametrize("runs", [None, ["a"]])
def test_what_a_stopped_download_left_of_something_else_goes(
    tmp_path: Path, runs: list[str] | None
) -> None:
    draft = folders(tmp_path / ".here.download", 9)
    (draft / "runs/.b.part").write_bytes(b"stopped")
    address = folders(tmp_path / "folders", 3).as_uri()  # published again since, and shorter
    dataset = wt.download(address, tmp_path / "here", runs=runs)
    straight = wt.download(address, tmp_path / "straight", runs=runs)
    assert wt.verify(dataset.path) == []
    assert files_of(Path(dataset.path)) == files_of(Path(straight.path))
    assert not list((tmp_path / "here").rglob("*.part"))


def test_what_was_cut_for_another_request_is_not_kept(large: Path, tmp_path: Path) -> None:
    first = wt.download(large.as_uri(), tmp_path / "first", steps=(0, 20_000))
    other = first.runs[0].path.name
    for name, asked in {"steps": {"steps": (40_000, 60_000)}, "whole": {"arrays": []}}.items():
        draft = tmp_path / f".{name}.download"  # as it is left by a process that is killed
        (draft / "runs").mkdir(parents=True)
        shutil.copy(first.runs[0].path, draft / "runs" / other)
        found = wt.download(large.as_uri(), tmp_path / name, **asked)
        straight = wt.download(large.as_uri(), tmp_path / f"{name}-straight", **asked)
        for one, two in zip(found, straight, strict=True):
            np.testing.assert_array_equal(one.num_timesteps, two.num_timesteps)
        assert files_of(Path(found.path)) == files_of(Path(straight.path))


def test_some_steps_and_arrays(
    large_server: servers.FileServer, large: Path, tmp_path: Path
) -> None:
    address, whole = f"{large_server.url}/large-v1", wt.open(large)
    dataset = wt.download(address, tmp_path / "part", steps=(20_000, 60_000), arrays=["eval"])
    assert wt.verify(dataset.path, deep=True) == []
    for part, run in zip(dataset, whole, strict=True):
        rows = (run.num_timesteps >= 20_000) & (run.num_timesteps <= 60_000)
        np.testing.assert_array_equal(part.weights[:], run.weights[:][rows])
        np.testing.assert_array_equal(part.returns[:], run.returns[:][rows])
        np.testing.assert_array_equal(part.phase, run.phase[rows])
        assert "probe/observations" not in part.keys()  # noqa: SIM118  a run is no dict
        part.load_policy(3).predict(np.zeros(4), deterministic=True)
    whole_size = sum(file.stat().st_size for file in (large / "runs").iterdir())
    assert sum(r.sent for r in large_server.log if ".zip" in r.path) < whole_size


def test_a_part_that_is_none(large_server: servers.FileServer, tmp_path: Path) -> None:
    address = f"{large_server.url}/large-v1"
    with pytest.raises(FormatError, match=r"(?s)cannot be taken.*unknown groups \['critics'\]"):
        wt.download(address, tmp_path / "a", arrays=["critics"])
    with pytest.raises(FormatError, match="cannot be taken"):
        wt.download(address, tmp_path / "b", steps=(10**9, 10**10))
    with pytest.raises(RegistryError, match="no such run"):
        wt.download(address, tmp_path / "c", runs=["seed0099"])
    with pytest.raises(RegistryError, match="no run was named"):
        wt.download(address, tmp_path / "d", runs=[])


def test_it_goes_on_where_it_was_stopped(
    large_server: servers.FileServer, large: Path, tmp_path: Path
) -> None:
    address, whole = f"{large_server.url}/large-v1", sum(map(len, files_of(large).values()))
    large_server.fault("seed0001", 403)
    with pytest.raises(RemoteError, match="access denied"):
        wt.download(address, tmp_path / "here")
    assert not (tmp_path / "here").exists()
    large_server.fault("seed0001", "cut")
    dataset = wt.download(address, tmp_path / "here")
    assert files_of(Path(dataset.path)) == files_of(large)
    sent = sum(request.sent for request in large_server.log)
    small_files = 4 * sum(len(v) for k, v in files_of(large).items() if "runs/" not in k)
    assert sent <= whole + small_files  # no byte of a run twice
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".")]


def _download(address: str, out: Path) -> None:
    wt.download(address, out)


def test_killed_at_any_moment_it_goes_on(
    large_server: servers.FileServer, large: Path, tmp_path: Path
) -> None:
    context, waits = multiprocessing.get_context("spawn"), random.Random(1)
    for _ in range(4):
        process = context.Process(
            target=_download, args=(f"{large_server.url}/large-v1", tmp_path / "here")
        )
        process.start()
        deadline = time.monotonic() + 60
        while not large_server.log and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(waits.uniform(0, 0.03))
        process.kill()
        process.join()
        large_server.log.clear()
    dataset = wt.download(f"{large_server.url}/large-v1", tmp_path / "here")
    assert files_of(Path(dataset.path)) == files_of(large)


def test_wrong_bytes_are_not_kept(
    large_server: servers.FileServer, large: Path, tmp_path: Path
) -> None:
    large_server.fault(r"seed0001.*\.zip", lambda content: content[:-1] + b"x", times=2)
    with pytest.raises(DamageError, match=r"(?s)not what the manifest says.*seed0001"):
        wt.download(f"{large_server.url}/large-v1", tmp_path / "here")
    assert not (tmp_path / "here").exists()
    # The server sends the right ones now.
    dataset = wt.download(f"{large_server.url}/large-v1", tmp_path / "here")
    assert files_of(Path(dataset.path)) == files_of(large)


def test_a_beginning_of_other_bytes_is_thrown_away(
    large_server: servers.FileServer, large: Path, tmp_path: Path
) -> None:
    part = tmp_path / ".here.download/runs/.seed0001.zarr.zip.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"something else")
    dataset = wt.download(f"{large_server.url}/large-v1", tmp_path / "here")
    assert files_of(Path(dataset.path)) == files_of(large)


def test_a_file_that_is_not_there(large: Path, tmp_path: Path) -> None:
    shutil.copytree(large, tmp_path / "there")
    (tmp_path / "there/tables/runs.parquet").unlink()
    with servers.FileServer(tmp_path) as server, pytest.raises(DamageError, match="not at the"):
        wt.download(f"{server.url}/there", tmp_path / "here")


def without(folder: Path, name: str) -> bytes:
    """Take a file out of a manifest; returns what that was before."""
    manifest = folder / "MANIFEST.sha256"
    before = manifest.read_bytes()
    lines = before.decode().splitlines(keepends=True)
    manifest.write_text("".join(line for line in lines if name not in line))
    return before


@pytest.mark.parametrize("name", ["runs/seed0001", "dataset.json"])
@pytest.mark.parametrize("part", [{}, {"runs": ["seed0001"]}])
def test_a_manifest_that_leaves_out_what_must_be_there(
    name: str, part: dict[str, list[str]], published: Path, tmp_path: Path
) -> None:
    there, here = tmp_path / "there", tmp_path / "here"
    shutil.copytree(published, there)
    before = without(there, name)
    for _ in range(2):
        with pytest.raises(DamageError, match=f"(?s)leaves out files.*{name}"):
            wt.download(there.as_uri(), here, **part)
        assert [path.name for path in tmp_path.iterdir()] == ["there"]
    (there / "MANIFEST.sha256").write_bytes(before)
    dataset = wt.download(there.as_uri(), here, **part)
    assert len(dataset) == (1 if part else 4)
    assert wt.verify(here, deep=True) == []


def test_a_model_without_its_configuration_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_MODELS_PATH", str(tmp_path / "models"))
    there = tmp_path / "gate"
    tipl.push("tipl-gate-inverted-pendulum-v4", there.as_uri())
    before = without(there, "config.json")
    with pytest.raises(DamageError, match=r"(?s)leaves out files.*config\.json"):
        tipl.load(there.as_uri())
    (there / "MANIFEST.sha256").write_bytes(before)
    assert tipl.load(there.as_uri()).name == "gate"


def test_links_that_lie_in_the_way_are_not_followed(
    server: servers.FileServer, published: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine").write_text("mine")
    for name in (".a.download", ".b.download.lock"):
        (tmp_path / name).symlink_to(other if name == ".a.download" else other / "mine")
    for name in ("a", "b"):
        with pytest.raises(FormatError, match="a link lies where"):
            wt.download(f"{server.url}/small-v1", tmp_path / name)
    (tmp_path / ".c.download/runs").mkdir(parents=True)
    (tmp_path / ".c.download/runs/.seed0000.zarr.zip.part").symlink_to(other / "mine")
    (tmp_path / ".c.download/tables").symlink_to(other)
    wt.download(f"{server.url}/small-v1", tmp_path / "c")
    assert files_of(tmp_path / "c") == files_of(published)
    assert files_of(other) == {"mine": b"mine"}


def test_names_that_no_manifest_holds_are_refused_before_anything_changes(
    published: Path, tmp_path: Path
) -> None:
    for name in ("my notes.txt", "caf\u00e9.md", "-x"):
        path = tmp_path / f"odd{len(name)}"
        shutil.copytree(published, path)
        (path / name).write_text("x")
        before = files_of(path)
        for change in (wt.registry.write_card, wt.seal):
            with pytest.raises(FormatError, match=r"(?s)its manifest cannot hold.*rename the file"):
                change(path)
            assert files_of(path) == before
        (path / name).unlink()
        assert wt.verify(path) == []


def test_a_card_that_is_a_link_is_not_published(published: Path, tmp_path: Path) -> None:
    path, secret = tmp_path / "linked", tmp_path / "secret"
    shutil.copytree(published, path)
    secret.write_text("# my secret\n\n## Citation\n")
    (path / "README.md").unlink()
    (path / "README.md").symlink_to(secret)
    for publish in (wt.registry.write_card, lambda p: wt.upload(p, (tmp_path / "out").as_uri())):
        with pytest.raises(FormatError, match="refused to read a file"):
            publish(path)
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten(server: servers.FileServer, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    with pytest.raises(StoreExistsError):
        wt.download(f"{server.url}/small-v1", tmp_path / "here")


def test_one_process_at_a_time(server: servers.FileServer, tmp_path: Path) -> None:
    from filelock import FileLock

    (tmp_path / ".here.download").mkdir()
    with FileLock(tmp_path / ".here.download.lock"), pytest.raises(StoreLockedError):
        wt.download(f"{server.url}/small-v1", tmp_path / "here")


def test_a_full_disk(large_server: servers.FileServer, large: Path, disk: Path) -> None:
    with pytest.raises(FormatError, match=r"(?s)could not be written.*make room"):
        wt.download(f"{large_server.url}/large-v1", disk / "here")
    subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)  # noqa: S607
    dataset = wt.download(f"{large_server.url}/large-v1", disk / "here")
    assert files_of(Path(dataset.path)) == files_of(large)


# By name


def test_by_name(
    server: servers.FileServer, published: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(FileNotFoundError, match="WEIGHTTRAJ_REMOTE"):
        wt.load_dataset("small-v1")
    monkeypatch.setenv("WEIGHTTRAJ_REMOTE", f"{server.url}/")
    assert str(wt.load_dataset("small-v1").path) == f"{server.url}/small-v1"  # read from there
    assert wt.load_dataset("small-v1", download=True).path == tmp_path / "store/small-v1"
    server.stop()
    dataset = wt.load_dataset("small-v1", runs=["seed0001"])
    np.testing.assert_array_equal(dataset.runs[0].weights[:], wt.open(published).runs[1].weights[:])
    by_address = wt.load_dataset(f"{server.url}/small-v1", runs=["seed0001"])
    assert by_address.path == dataset.path


def test_another_data_set_of_that_name_is_not_taken_for_it(
    server: servers.FileServer, large: Path, tmp_path: Path
) -> None:
    shutil.copytree(large, tmp_path / "store/small-v1")
    dataset = wt.load_dataset(f"{server.url}/small-v1")
    assert len(dataset) == 4


# The command


def test_the_command(published: Path, tmp_path: Path) -> None:
    address = f"file://{tmp_path}/there/small-v1"

    def told(*arguments: str) -> str:
        done = shell("weighttraj", *arguments)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    assert f"published: {address}" in told("upload", str(published), address)
    assert "4 runs" in told("show", address)
    assert "weights (time 49" in told("show", f"{address}/runs/seed0000.zarr.zip")
    assert "4 runs in" in told("download", address)
    assert "small-v1" in told("list")
    part = ("--out", str(tmp_path / "part"), "--runs", "seed0001", "--steps", "0", "256")
    assert "1 runs in" in told("download", address, *part)


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    done = shell("weighttraj", "download", f"file://{tmp_path}")
    assert done.returncode == 1
    assert "no data set at" in done.stderr
    assert "Traceback" not in done.stderr
