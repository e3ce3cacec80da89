"""A small data set that is fit to be published, and servers that have it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import boto3
import huggingface_hub.constants
import numpy as np
import pytest

import weighttraj as wt
from tests.remote import hub as stand_in
from tests.remote import servers
from weighttraj.format import DatasetInfo, ParamLayout, RunEntry, RunInfo
from weighttraj.registry import create
from weighttraj.remote.store import store_at
from weighttraj.store.catalog import write_dataset_info

CARD = "# A small data set\n\n## Citation\n\nNone.\n"
CREDENTIALS = {"aws_access_key_id": "key", "aws_secret_access_key": "secret"}


@pytest.fixture(autouse=True)
def a_store_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Downloads go to a test's store."""
    monkeypatch.setenv("WEIGHTTRAJ_REMOTE_TIMEOUT", "30")
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(tmp_path / "store"))


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that is gone is waited for a minute; not here."""
    monkeypatch.setenv("WEIGHTTRAJ_REMOTE_TIMEOUT", "2")


@pytest.fixture(scope="session")
def published(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small data set with a card. Do not write to it."""
    path = tmp_path_factory.mktemp("published") / "small-v1"
    shutil.copytree(small_dataset, path)
    (path / "README.md").write_text(CARD)
    wt.seal(path)
    return path


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A packed run and one that is a folder, of no training. Do not write to it."""
    path = tmp_path_factory.mktemp("tiny") / "tiny"
    entries = (RunEntry(id="a", path="runs/a.zarr.zip"), RunEntry(id="b", path="runs/b.zarr"))
    layout, rng = ParamLayout.of({"w": ((3,), "other", ("fixed",))}), np.random.default_rng(0)
    for entry in entries:
        folder = path / f"runs/{entry.id}.zarr"
        with wt.RunWriter(folder, RunInfo(run_id=entry.id, layout=layout, block=2)) as writer:
            for t in range(5):
                writer.append(rng.normal(size=3).astype(np.float32), num_timesteps=t)
    wt.pack(path / "runs/a.zarr")
    shutil.rmtree(path / "runs/a.zarr")
    for lock in path.rglob("*.lock"):
        lock.unlink()
    (path / "README.md").write_text(CARD)
    write_dataset_info(path, DatasetInfo(id="tiny", runs=entries, status="complete"))
    wt.seal(path)
    return path


@pytest.fixture(scope="session")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of the released data, which are read in parts. Do not write to it."""
    path = tmp_path_factory.mktemp("large") / "large-v1"
    released = wt.open("inverted-pendulum-v4-ppo-v1")
    create([str(released.runs[i].path) for i in (0, 1)], path, splits={"seed0001": "test"})
    (path / "README.md").write_text(CARD)
    wt.seal(path)
    return path


@pytest.fixture
def large_server(large: Path) -> Iterator[servers.FileServer]:
    with servers.FileServer(large.parent) as server:
        yield server


@pytest.fixture
def server(published: Path) -> Iterator[servers.FileServer]:
    with servers.FileServer(published.parent) as server:
        yield server


@dataclass
class Bucket:
    """A bucket of an S3 server."""

    url: str
    name: str

    @property
    def address(self) -> str:
        return f"s3://{self.name}"


@pytest.fixture(scope="session")
def moto_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with servers.moto(tmp_path_factory.mktemp("moto")) as url:
        yield url


@pytest.fixture(scope="session")
def seaweedfs_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with servers.seaweedfs(tmp_path_factory.mktemp("weed")) as url:
        yield url


@pytest.fixture(params=["moto", "seaweedfs"])
def bucket(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Bucket:
    """A new bucket, on each of two servers."""
    url = request.getfixturevalue(f"{request.param}_url")
    return make_bucket(url, f"{request.param}-{tmp_path.name}".replace("_", "-"), monkeypatch)


@pytest.fixture
def moto_bucket(moto_url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Bucket:
    return make_bucket(moto_url, tmp_path.name.replace("_", "-"), monkeypatch)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[stand_in.Hub]:
    """The client reads these when it is imported; here it has been."""
    with stand_in.running() as hub:
        monkeypatch.setattr(huggingface_hub.constants, "ENDPOINT", hub.url)
        template = hub.url + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(huggingface_hub.constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setenv("HF_TOKEN", stand_in.TOKEN)
        monkeypatch.setenv("HF_HUB_DISABLE_PROGRESS_BARS", "1")
        store_at.cache_clear()
        yield hub
    store_at.cache_clear()


def make_bucket(url: str, name: str, monkeypatch: pytest.MonkeyPatch) -> Bucket:
    name = name.lower()[-50:].strip("-")
    for variable, value in {
        "AWS_ACCESS_KEY_ID": CREDENTIALS["aws_access_key_id"],
        "AWS_SECRET_ACCESS_KEY": CREDENTIALS["aws_secret_access_key"],
        "AWS_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": url,
        "AWS_ALLOW_HTTP": "true",
    }.items():
        monkeypatch.setenv(variable, value)
    client = boto3.client("s3", endpoint_url=url, region_name="us-east-1", **CREDENTIALS)
    client.create_bucket(Bucket=name)
    return Bucket(url, name)


def objects_of(bucket: Bucket) -> dict[str, bytes]:
    """All that lies in a bucket, by another client than ours."""
    client = boto3.client("s3", endpoint_url=bucket.url, region_name="us-east-1", **CREDENTIALS)
    listed = client.list_objects_v2(Bucket=bucket.name).get("Contents", [])
    return {
        o["Key"]: client.get_object(Bucket=bucket.name, Key=o["Key"])["Body"].read() for o in listed
    }


def files_of(folder: Path) -> dict[str, bytes]:
    """All that lies in a folder, but for hidden files."""
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file() and not file.name.startswith(".")
    }
