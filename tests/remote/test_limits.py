"""What a server may send, how long it may take, and what is said when it cannot be reached."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import tipl
import weighttraj as wt
from tests.remote import hub as stand_in
from tests.remote import servers
from tests.remote.conftest import Bucket, make_bucket
from tests.shell import shell
from weighttraj.errors import DamageError, RemoteError
from weighttraj.remote import RemotePath
from weighttraj.remote.store import RemoteStore
from weighttraj.remote.wait import TIMEOUT

GIB = 1 << 30


@pytest.fixture
def server(tiny: Path) -> Iterator[servers.FileServer]:
    with servers.FileServer(tiny.parent) as server:
        yield server


@pytest.mark.parametrize("where", ["dataset.json", r"b\.zarr/zarr\.json", "MANIFEST", "c/0"])
def test_an_answer_of_five_gigabytes_is_not_taken(
    where: str, server: servers.FileServer, tmp_path: Path
) -> None:
    server.fault(where, servers.Long(5 * GIB), times=9)
    address = f"{server.url}/tiny"
    with pytest.raises(RemoteError, match=r"(?s)larger than it may be.*got: 5368709120 bytes"):
        wt.open(address)["b"].weights[:]
        wt.download(address, tmp_path / "here")
    assert not (tmp_path / "here").exists()


def test_a_model_of_five_gigabytes_is_not_taken(
    server: servers.FileServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_MODELS_PATH", str(tmp_path))
    server.fault("MANIFEST", servers.Long(5 * GIB), times=9)
    with pytest.raises(RemoteError, match="larger than it may be"):
        tipl.load(f"{server.url}/tiny")


def test_a_packed_run_whose_directory_is_huge_is_damaged(tiny: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny, tmp_path / "tiny")
    file = tmp_path / "tiny/runs/a.zarr.zip"
    content = bytearray(file.read_bytes())
    end = content.rfind(b"PK\5\6")
    content[end + 12 : end + 16] = (GIB).to_bytes(4, "little")  # size of the directory
    content[end + 16 : end + 20] = bytes(4)  # where it begins
    with file.open("wb") as out:
        out.truncate(GIB)  # no byte of it is stored
        out.seek(GIB)
        out.write(content[end:])
    with pytest.raises(DamageError, match="directory has more than"):
        wt.open_run(file)
    with (
        servers.FileServer(tmp_path) as server,
        pytest.raises(DamageError, match="directory has more than"),
    ):
        wt.open_run(f"{server.url}/tiny/runs/a.zarr.zip")


@pytest.mark.parametrize("where", ["dataset.json", r"\.zip", "MANIFEST"])
def test_a_dripping_server_is_given_up_at_the_promised_time(
    where: str, server: servers.FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TIMEOUT, "0.8")
    server.fault(where, servers.Drip(0.1), times=99)
    with pytest.raises(RemoteError, match=r"(?s)in time.*within 0\.8 seconds.*" + TIMEOUT):
        wt.open(f"{server.url}/tiny")["a"].weights[:]
        wt.download(f"{server.url}/tiny", tmp_path / "here")


def test_a_dripping_hub_is_given_up_at_the_promised_time(
    hub: stand_in.Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TIMEOUT, "0.5")
    hub.slow = 3.0
    with pytest.raises(RemoteError, match=r"(?s)in time.*within 0\.5 seconds"):
        wt.open("hf://us/data")


def test_a_large_file_may_take_longer_as_long_as_it_comes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TIMEOUT, "3")
    content = bytes(range(256)) * 2048  # 8 steps of half a second
    (tmp_path / "large").write_bytes(content)
    with servers.FileServer(tmp_path) as server:
        server.fault("large", servers.Drip(0.5, bytes_at_once=1 << 16))
        store = RemoteStore(RemotePath.parse(server.url).root)
        assert b"".join(store.pieces("large")) == content


def started(*arguments: str) -> subprocess.Popen[bytes]:
    """A command that Ctrl-C reaches, also where whoever started the tests ignores it."""
    return subprocess.Popen(
        [sys.executable, "-m", "weighttraj.cli", *arguments],
        env=os.environ | {TIMEOUT: "600"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def test_ctrl_c_ends_a_command_that_waits_for_a_server(server: servers.FileServer) -> None:
    server.fault("dataset.json", servers.Drip(0.1), times=99)
    with started("show", f"{server.url}/tiny") as process:
        while not server.log and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130  # it would wait for ten minutes


def test_ctrl_c_ends_a_download_of_several_files(
    server: servers.FileServer, tmp_path: Path
) -> None:
    server.fault("runs/", servers.Drip(0.1), times=99)
    address, out = f"{server.url}/tiny", tmp_path / "here"
    with started("download", address, "--out", str(out)) as process:
        while not any("runs/" in request.path for request in server.log):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 130
    assert not (tmp_path / "here").exists()


def test_requests_of_other_threads_end_with_the_first_error(
    server: servers.FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TIMEOUT, "600")  # they would wait for so long
    server.fault("runs/", servers.Drip(0.1), times=99)
    server.fault("README", 403, times=9)
    with pytest.raises(RemoteError, match="access denied"):
        wt.download(f"{server.url}/tiny", tmp_path / "here")


# What is said


def one_line(message: str) -> str:
    assert "Debug source" not in message
    assert len(message.splitlines()) <= 6
    assert max(map(len, message.splitlines())) < 600
    return message


def test_a_bucket_that_is_not_there(
    moto_url: str, tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_bucket(moto_url, "another", monkeypatch)
    for do in (
        lambda: wt.upload(tiny, "s3://no-such-bucket/data"),
        lambda: wt.open("s3://no-such-bucket/data"),
        lambda: wt.download("s3://no-such-bucket/data"),
        lambda: tipl.push("tipl-gate-inverted-pendulum-v4", "s3://no-such-bucket/gate"),
        lambda: tipl.load("s3://no-such-bucket/gate"),
    ):
        with pytest.raises(RemoteError, match="there is no such bucket") as caught:
            do()
        one_line(str(caught.value))
    done = shell("weighttraj", "upload", tiny, "s3://no-such-bucket/data")
    assert done.returncode == 1
    assert "there is no such bucket" in one_line(done.stderr)


def test_what_is_not_in_a_bucket_is_said_in_a_line(moto_bucket: Bucket) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        wt.open_run(f"{moto_bucket.address}/runs/none.zarr.zip")
    one_line(str(caught.value))


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("address", "environment", "what"),
    [
        ("https://no-such-host.invalid/x", {}, "the server's name is not known"),
        ("az://container/x", {}, "no credentials for this address"),
        ("https://127.0.0.1:9/x", {}, "cannot be reached.*refused"),
        ("https://host:port/x", {}, "this address cannot be used"),
        (
            "https://example.org/x",
            {"HTTPS_PROXY": "http://127.0.0.1:9", "NO_PROXY": ""},
            "cannot be reached.*proxy",
        ),
    ],
)
def test_why_a_server_cannot_be_reached(
    address: str, environment: dict[str, str], what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(RemoteError, match=f"(?s){what}") as caught:
        wt.open(address)
    one_line(str(caught.value))


def test_a_bucket_in_another_region(
    tiny: Path, monkeypatch: pytest.MonkeyPatch, server: servers.FileServer
) -> None:
    make_env = {"AWS_ACCESS_KEY_ID": "k", "AWS_SECRET_ACCESS_KEY": "s", "AWS_REGION": "us-east-1"}
    for name, value in (make_env | {"AWS_ENDPOINT_URL": server.url}).items():
        monkeypatch.setenv(name, value)
    server.fault("dataset.json", 301, times=9)
    with pytest.raises(RemoteError, match=r"(?s)in another region.*AWS_REGION") as caught:
        wt.open("s3://bucket/data")
    one_line(str(caught.value))
    server.faults.clear()
    server.fault("dataset.json", 403, times=9)
    with pytest.raises(RemoteError, match=r"(?s)access denied.*AWS_ACCESS_KEY_ID"):
        wt.open("s3://bucket/data")
