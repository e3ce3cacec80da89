"""Windows from where the data is: few requests, few bytes, every fault by its cause."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

import weighttraj as wt
from tests.remote import servers
from tests.remote.conftest import Bucket
from weighttraj.errors import DamageError, FormatError, RegistryError, RemoteError
from weighttraj.remote import RemotePath, is_remote
from weighttraj.remote.wait import TIMEOUT

ROOT = Path(__file__).parents[2]
RELEASED = ROOT / "datasets/inverted-pendulum-v4-ppo-v1/data"


# Addresses


@pytest.mark.parametrize(
    ("address", "root", "part", "name"),
    [
        ("s3://bucket/a/b/", "s3://bucket/a/b", "", "b"),
        ("https://host:1/a", "https://host:1/a", "", "a"),
        ("hf://org/name", "hf://org/name@main", "", "name"),
        ("hf://datasets/org/name@v1/runs/x.zarr", "hf://org/name@v1", "runs/x.zarr", "x.zarr"),
    ],
)
def test_addresses(address: str, root: str, part: str, name: str) -> None:
    place = RemotePath.parse(address)
    assert (str(place.root), place.part, place.name) == (root, part, name)
    assert is_remote(address)
    assert pickle.loads(pickle.dumps(place)) == place  # noqa: S301


def test_a_part_of_an_address() -> None:
    place = RemotePath.parse("hf://org/name", "a" * 40)
    assert place.commit == "a" * 40
    assert place.repository == "hf://org/name"
    assert str(place / "runs" / "x") == f"hf://org/name@{'a' * 40}/runs/x"
    assert RemotePath.parse("s3://b/a/x.zip").as_object() == RemotePath.parse("s3://b/a") / "x.zip"


@pytest.mark.parametrize("address", ["ftp://host/a", "hf://name", "hf://a/b@c@d", "s3://", "://x"])
def test_what_is_no_address(address: str) -> None:
    with pytest.raises(RegistryError, match="no address of a data set"):
        RemotePath.parse(address)


def test_only_the_hub_has_revisions() -> None:
    with pytest.raises(RegistryError, match="only the hub keeps revisions"):
        wt.open("s3://bucket/data", revision="main")
    with pytest.raises(RegistryError, match="only the hub keeps revisions"):
        wt.open("inverted-pendulum-v4-ppo-v1", revision="main")
    with pytest.raises(RegistryError, match="names another revision"):
        RemotePath.parse("hf://org/name@v1", "v2")


def test_what_needs_files_says_how_to_have_them(server: servers.FileServer) -> None:
    dataset = wt.open(f"{server.url}/small-v1")
    for needs in (Path, os.listdir):
        with pytest.raises(RegistryError, match=r"(?s)files on this machine.*weighttraj download"):
            needs(dataset.path)  # type: ignore[operator]
    run = f"{server.url}/small-v1/runs/seed0000.zarr.zip"
    for needs in (wt.verify, wt.lint, wt.seal, wt.unseal, wt.repair, wt.policies.fill_returns):
        with pytest.raises(RegistryError, match="weighttraj download"):
            needs(f"{server.url}/small-v1")  # type: ignore[operator]
    with pytest.raises(RegistryError, match="weighttraj download"):
        wt.pack(run)


# Reading


def same(remote: wt.Dataset, local: wt.Dataset) -> None:
    assert remote.info == local.info
    for theirs, ours in zip(remote, local, strict=True):
        assert theirs.info == ours.info
        assert theirs.split == ours.split
        for name in ours.keys():  # noqa: SIM118  a run is no dict
            np.testing.assert_array_equal(theirs[name][:], ours[name][:])


def test_over_http(server: servers.FileServer, published: Path) -> None:
    same(wt.open(f"{server.url}/small-v1"), wt.open(published))


def test_by_nginx(published: Path, tmp_path: Path) -> None:
    with servers.nginx(published.parent, tmp_path) as url:
        same(wt.open(f"{url}/small-v1"), wt.open(published))


def test_from_a_folder(published: Path) -> None:
    same(wt.open(f"file://{published}"), wt.open(published))


def test_from_s3(bucket: Bucket, published: Path) -> None:
    wt.upload(published, f"{bucket.address}/some/prefix")
    same(wt.open(f"{bucket.address}/some/prefix"), wt.open(published))


def test_runs_that_are_folders(published: Path, tmp_path: Path, full_run: wt.Run) -> None:
    shutil.copytree(Path(full_run.path), tmp_path / "run.zarr")
    with servers.FileServer(tmp_path) as server:
        remote = wt.open_run(f"{server.url}/run.zarr")
        np.testing.assert_array_equal(remote.weights[5:9], full_run.weights[5:9])
        with pytest.raises(FileNotFoundError, match="no run at"):
            wt.open_run(f"{server.url}/other.zarr")


def test_one_run_by_its_address(server: servers.FileServer, published: Path) -> None:
    local = wt.open(published).runs[0]
    remote = wt.open_run(f"{server.url}/small-v1/runs/{local.id}.zarr.zip")
    np.testing.assert_array_equal(remote.weights[:], local.weights[:])


def test_some_runs(server: servers.FileServer) -> None:
    assert [run.id for run in wt.open(f"{server.url}/small-v1", runs=["seed0002"])] == ["seed0002"]
    with pytest.raises(RegistryError, match=r"(?s)no such run.*seed0000, seed0001"):
        wt.open(f"{server.url}/small-v1", runs=["seed0009"])


def test_policies_and_windows(server: servers.FileServer, published: Path) -> None:
    remote, local = wt.open(f"{server.url}/small-v1"), wt.open(published)
    observation = np.zeros(local.runs[0].info.policy.observation_shape, np.float32)
    ours = local.runs[0].load_policy(9).predict(observation, deterministic=True)[0]
    theirs = remote.runs[0].load_policy(9).predict(observation, deterministic=True)[0]
    np.testing.assert_array_equal(ours, theirs)
    windows = remote.split("train").to_torch(window=5)
    loader = torch.utils.data.DataLoader(
        windows, batch_size=8, num_workers=1, multiprocessing_context="fork"
    )
    expected = local.split("train").to_torch(window=5)
    got = torch.cat([batch["weights"] for batch in loader])
    assert torch.equal(got, torch.stack([item["weights"] for item in expected]))


def test_a_window_of_fifty_runs_takes_five_requests_and_few_bytes() -> None:
    with servers.FileServer(RELEASED.parent) as server:
        dataset = wt.open(f"{server.url}/data")
        assert len(dataset) == 50
        run = dataset.runs[7]
        window = run.weights[100:120]
        assert len(server.log) <= 5
        np.testing.assert_array_equal(window, wt.open(RELEASED).runs[7].weights[100:120])
        chunks = zipfile.ZipFile(RELEASED / f"runs/{run.id}.zarr.zip").infolist()
        size = sum(c.file_size for c in chunks if c.filename.startswith(("policy/", "digest/c")))
        # What opening a run takes comes once; the window itself is two requests.
        assert sum(request.sent for request in server.log[3:]) <= 2 * size
        before = len(server.log)
        run.weights[200:220]  # in the same chunks
        assert len(server.log) == before


def test_chunks_side_by_side_are_fetched_together(tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((40_000,), "weight", ("input",))})
    with wt.RunWriter(tmp_path / "wide.zarr", wt.RunInfo(run_id="wide", layout=layout)) as writer:
        weights = np.random.default_rng(0).standard_normal((64, 40_000), np.float32)
        for t, row in enumerate(weights):
            writer.append(row, num_timesteps=t)
    wt.pack(tmp_path / "wide.zarr")
    with servers.FileServer(tmp_path) as server:
        run = wt.open_run(f"{server.url}/wide.zarr.zip")
        before = len(server.log)
        np.testing.assert_array_equal(run.weights[3:7], weights[3:7])
        assert len(server.log) - before <= 2  # three chunks of columns at once, and the digests


# Faults


@pytest.mark.parametrize("status", [429, 500, 503])
def test_a_busy_server_is_asked_again(server: servers.FileServer, status: int) -> None:
    server.fault("dataset.json", status, times=2)
    assert len(wt.open(f"{server.url}/small-v1")) == 4
    assert len(server.log) == 3


@pytest.mark.usefixtures("impatient")
def test_a_server_that_stays_busy_is_named(server: servers.FileServer) -> None:
    server.fault("dataset.json", 503, times=1000)
    with pytest.raises(RemoteError, match=r"(?s)cannot be reached.*503.*dataset\.json"):
        wt.open(f"{server.url}/small-v1")


@pytest.mark.parametrize("told", ["abc", "", "nan", "inf", "-5", "0", "1e300"])
def test_a_time_that_is_none_is_refused(
    told: str, server: servers.FileServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TIMEOUT, told)
    with pytest.raises(RemoteError, match=f"(?s)no time to wait.*{TIMEOUT}"):
        wt.open(f"{server.url}/small-v1")


def test_an_answer_that_breaks_off_is_asked_for_again(
    large_server: servers.FileServer, large: Path
) -> None:
    run = wt.open(f"{large_server.url}/large-v1").runs[0]
    large_server.fault(r"\.zip", "cut", times=3)
    np.testing.assert_array_equal(run.weights[:], wt.open(large).runs[0].weights[:])
    assert not large_server.faults


@pytest.mark.usefixtures("impatient")
def test_a_server_that_dies(large: Path) -> None:
    with servers.FileServer(large.parent) as dying:
        run = wt.open(f"{dying.url}/large-v1").runs[0]
        assert run.info.status == "complete"
    with pytest.raises(RemoteError, match=r"(?s)cannot be reached.*refused"):
        run.weights[:]


def test_wrong_bytes_are_damage(large_server: servers.FileServer) -> None:
    run = wt.open(f"{large_server.url}/large-v1").runs[0]
    assert run.info.status == "complete"

    def flip(content: bytes) -> bytes:
        middle = len(content) // 2
        return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]

    large_server.fault(r"\.zip", flip)
    with pytest.raises(DamageError):
        run.weights[:]


def test_a_truncated_run_is_damage(published: Path, tmp_path: Path) -> None:
    shutil.copytree(published, tmp_path / "small-v1")
    file = tmp_path / "small-v1/runs/seed0000.zarr.zip"
    file.write_bytes(file.read_bytes()[:-500])
    with servers.FileServer(tmp_path) as server:
        run = wt.open(f"{server.url}/small-v1").runs[0]
        with pytest.raises(DamageError, match="no whole zip file"):
            run.weights[:]


def test_a_run_that_is_replaced_while_it_is_read(large: Path, tmp_path: Path) -> None:
    shutil.copytree(large, tmp_path / "large-v1")
    with servers.FileServer(tmp_path) as server:
        run = wt.open(f"{server.url}/large-v1").runs[0]
        assert run.info.status == "complete"
        other = tmp_path / "large-v1/runs/seed0001.zarr.zip"
        other.replace(tmp_path / "large-v1/runs/seed0000.zarr.zip")
        with pytest.raises(FormatError, match="replaced after it was opened"):
            run.weights[:]


def test_a_run_in_the_place_of_another(published: Path, tmp_path: Path) -> None:
    shutil.copytree(published, tmp_path / "small-v1")
    runs = tmp_path / "small-v1/runs"
    shutil.copyfile(runs / "seed0001.zarr.zip", runs / "seed0000.zarr.zip")
    with servers.FileServer(tmp_path) as server:
        run = wt.open(f"{server.url}/small-v1").runs[0]
        with pytest.raises(FormatError, match="not the one that the data set lists"):
            run.weights[:]


def test_what_is_not_there(server: servers.FileServer, tmp_path: Path, moto_bucket: Bucket) -> None:
    for address in (server.url, f"file://{published_nothing(tmp_path)}", moto_bucket.address):
        with pytest.raises(FileNotFoundError, match="no data set at"):
            wt.open(f"{address}/")
    with pytest.raises(FileNotFoundError, match="no folder at"):
        wt.open(f"file://{tmp_path}/none")


def published_nothing(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def test_a_server_that_sends_no_parts_says_what_to_do(published: Path, tmp_path: Path) -> None:
    with servers.without_ranges(published.parent, tmp_path) as url:
        run = wt.open(f"{url}/small-v1").runs[0]
        with pytest.raises(RemoteError, match=r"(?s)cannot send parts.*weighttraj download"):
            run.weights[:]


def test_a_server_that_knows_no_suffixes(published: Path) -> None:
    with servers.FileServer(published.parent, suffixes=False) as server:
        same(wt.open(f"{server.url}/small-v1"), wt.open(published))
        refused = [request for request in server.log if (request.range or "").startswith("bytes=-")]
        assert len(refused) == 4  # once for each run: it will not change its mind


def test_azure_which_is_asked_for_no_suffixes(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(published, tmp_path / "container/small-v1")
    with servers.FileServer(tmp_path) as server:
        monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "me")
        monkeypatch.setenv("AZURE_STORAGE_ENDPOINT", server.url)
        monkeypatch.setenv("AZURE_SKIP_SIGNATURE", "true")
        same(wt.open("az://container/small-v1"), wt.open(published))


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(("status", "what"), [(403, "access denied"), (503, "cannot be reached")])
def test_a_run_that_cannot_be_had_is_not_asked_for_in_another_way(
    status: int, what: str, server: servers.FileServer
) -> None:
    run = wt.open(f"{server.url}/small-v1").runs[0]
    server.fault(r"\.zip", status, times=1000)
    with pytest.raises(RemoteError, match=what):
        run.weights[:]
    assert {request.method for request in server.log} == {"GET"}


def test_no_credentials(server: servers.FileServer) -> None:
    server.fault("dataset.json", 403)
    with pytest.raises(RemoteError, match="access denied"):
        wt.open(f"{server.url}/small-v1")


def test_a_data_set_that_is_being_collected(published: Path, tmp_path: Path) -> None:
    shutil.copytree(published, tmp_path / "small-v1")
    wt.repair(tmp_path / "small-v1")
    (tmp_path / "small-v1/runs/seed0000.zarr.zip").write_bytes(b"")
    wt.repair(tmp_path / "small-v1", cut=True)
    with pytest.raises(FormatError, match="not complete"):
        wt.open(f"file://{tmp_path}/small-v1")


# Processes


def _read(address: str, queue: multiprocessing.Queue[object]) -> None:
    try:
        queue.put(wt.open(address).runs[0].weights[3].sum())
    except RemoteError as error:
        queue.put(str(error))


def _sum(run: wt.Run) -> float:
    return float(run.weights[3].sum())


def test_a_forked_process_is_told_instead_of_waiting_for_ever(server: servers.FileServer) -> None:
    address = f"{server.url}/small-v1"
    wt.open(address)
    context = multiprocessing.get_context("fork")
    queue: multiprocessing.Queue[object] = context.Queue()
    process = context.Process(target=_read, args=(address, queue))
    process.start()
    assert "forked process" in str(queue.get(timeout=60))
    process.join()


def test_a_spawned_process_reads(server: servers.FileServer, published: Path) -> None:
    run = wt.open(f"{server.url}/small-v1").runs[0]
    expected = _sum(run)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(_sum, (run,)) == expected
