"""One reading of an address, by every way that data are opened, tiny and brought here."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

import tipl
import weighttraj as wt
from tests.remote import hub as stand_in
from tests.remote import servers
from tests.remote.conftest import Bucket, files_of, objects_of
from tests.shell import shell
from weighttraj.errors import RegistryError
from weighttraj.locate import locate
from weighttraj.registry.download import source_of
from weighttraj.remote import RemotePath, is_remote
from weighttraj.remote.address import below, new_path

ODD = (
    "p q",
    "p%20q",
    "p%2520q",
    "p#q",
    "p?q=1",
    "p+q",
    "caf\u00e9",
    "cafe\u0301",
    "100%",
    "a&b;c=d",
)
"""Names that URLs write in another way, or that look as if they were written so."""


def published_as(folder: Path, tiny: Path, name: str) -> Path:
    """A data set that can be told by its card."""
    path = folder / name
    shutil.copytree(tiny, path)
    (path / "README.md").write_text(f"# {name}\n\n## Citation\n\nNone.\n")
    wt.seal(path)
    return path


@pytest.mark.parametrize("name", ODD)
def test_a_file_address_names_the_folder_that_path_as_uri_means(name: str, tmp_path: Path) -> None:
    place = RemotePath.parse((tmp_path / name).as_uri())
    assert place.root.path == str(tmp_path / name)
    assert str(place) == (tmp_path / name).as_uri()
    assert place.name == name
    assert RemotePath.parse(str(place)) == place
    assert pickle.loads(pickle.dumps(place)) == place  # noqa: S301


def test_names_that_are_no_text_go_there_and_back() -> None:
    path = Path(os.fsdecode(b"/data/\xff\xfe"))
    place = RemotePath.parse(path.as_uri())
    assert place.root.path == str(path)
    assert str(place) == path.as_uri() == "file:///data/%FF%FE"


def test_folders_whose_names_differ_by_an_escape_are_two(tiny: Path, tmp_path: Path) -> None:
    for name in ("p q", "p%20q"):
        published_as(tmp_path, tiny, name)
    addresses = {f"file://{tmp_path}/p%20q": "p q", f"file://{tmp_path}/p%2520q": "p%20q"}
    for number, (address, name) in enumerate(addresses.items()):
        assert address == (tmp_path / name).as_uri()
        opened = wt.open(address)
        np.testing.assert_array_equal(
            opened.runs[0].weights[2:4], wt.open(tmp_path / name).runs[0].weights[2:4]
        )
        run = wt.open_run(f"{address}/runs/a.zarr.zip")
        assert run.id == "a"
        copy = Path(wt.download(address, tmp_path / f"copy{number}").path)
        assert (copy / "README.md").read_text().startswith(f"# {name}\n")
        wt.upload(tmp_path / name, f"{address}-there")
        assert files_of(tmp_path / f"{name}-there") == files_of(tmp_path / name)
        by_name = wt.load_dataset(address, download=True)
        assert by_name.path == tmp_path / "store" / name
        assert wt.load_dataset(address).path == by_name.path
        assert wt.open(name).path == by_name.path
    # A plain path is never decoded.
    assert wt.open(str(tmp_path / "p%20q")).path == tmp_path / "p%20q"


@pytest.mark.parametrize("name", ["p q", "p%20q", "p#q", "p?q", "p+q", "caf\u00e9", "cafe\u0301"])
def test_a_key_is_taken_character_by_character(
    name: str, moto_bucket: Bucket, tiny: Path, tmp_path: Path
) -> None:
    address = f"{moto_bucket.address}/team/{name}"
    assert str(wt.upload(tiny, address)) == address
    names = {key.removeprefix(f"team/{name}/") for key in objects_of(moto_bucket)}
    assert names == set(files_of(tiny))  # by another client
    assert len(wt.open(address)) == 2
    assert wt.open_run(f"{address}/runs/a.zarr.zip").weights[1:3].shape[0] == 2
    assert files_of(Path(wt.download(address, tmp_path / "copy").path)) == files_of(tiny)


@pytest.mark.parametrize("name", ["p q", "p%20q", "p#q", "p?q", "p+q", "caf\u00e9"])
def test_a_web_address_is_sent_as_it_is_written(name: str, tiny: Path, tmp_path: Path) -> None:
    published_as(tmp_path, tiny, name)
    quoted = (tmp_path / name).as_uri().rpartition("/")[2]
    with servers.FileServer(tmp_path) as server:
        dataset = wt.open(f"{server.url}/{quoted}")
        assert dataset.runs[0].weights[1:3].shape[0] == 2
        assert dataset.path.name == name
        assert wt.open_run(f"{server.url}/{quoted}/runs/a.zarr.zip").id == "a"
        assert wt.load_dataset(f"{server.url}/{quoted}", download=True).path.name == name


def test_a_signature_is_sent_with_every_request_and_kept_nowhere(
    tiny: Path, tmp_path: Path
) -> None:
    secret = "X-Amz-Credential=a/b%2Fc&X-Amz-Signature=123"  # noqa: S105
    with servers.FileServer(tiny.parent) as server:
        server.needs = secret
        address = f"{server.url}/tiny?{secret}"
        dataset = wt.open(address)
        assert dataset.runs[0].weights[1:3].shape[0] == 2
        assert str(dataset.path) == address
        assert str(dataset.runs[0].path).endswith(f"/runs/a.zarr.zip?{secret}")
        assert wt.open_run(str(dataset.runs[0].path)).id == "a"
        copy = Path(wt.load_dataset(address, download=True).path)
        assert copy == tmp_path / "store/tiny"
        assert "Signature" not in (copy / ".source.json").read_text()
        # Signed anew, it is still the one that is here.
        assert wt.load_dataset(f"{server.url}/tiny?X-Amz-Signature=456").path == copy
        with pytest.raises(FileNotFoundError, match="no data set at"):
            wt.open(f"{server.url}/tiny")


@pytest.mark.parametrize(
    ("address", "revision", "part"),
    [
        ("hf://org/name@refs/pr/1", "refs/pr/1", ""),
        ("hf://org/name@refs/pr/1/runs/x.zarr", "refs/pr/1", "runs/x.zarr"),
        ("hf://org/name@refs%2Fpr%2F1/runs/x.zarr", "refs/pr/1", "runs/x.zarr"),
        ("hf://org/name@refs/convert/parquet/a", "refs/convert/parquet", "a"),
        ("hf://org/name@refs/other/1", "refs", "other/1"),
        ("hf://org/name@feature/x", "feature", "x"),
        ("hf://org/name@feature%2Fx/y", "feature/x", "y"),
        ("hf://org/name@refs/pr/12x/y", "refs", "pr/12x/y"),
        ("hf://org/name/runs/a@b", "main", "runs/a@b"),
        ("hf://datasets/org/name@v1.0/", "v1.0", ""),
        ("hf://org/name/a%20b", "main", "a%20b"),
    ],
)
def test_a_revision_ends_at_the_first_slash_unless_it_is_special(
    address: str, revision: str, part: str
) -> None:
    """As in the hub's own client."""
    place = RemotePath.parse(address)
    assert (place.root.host, place.root.revision, place.part) == ("org/name", revision, part)
    assert RemotePath.parse(str(place)) == place


def test_a_revision_by_keyword_is_not_quoted() -> None:
    place = RemotePath.parse("hf://org/name", "feature/x")
    assert place == RemotePath.parse("hf://org/name@feature%2Fx")
    assert str(place) == "hf://org/name@feature%2Fx"


def test_revisions_with_slashes_on_the_hub(hub: stand_in.Hub, tiny: Path, tmp_path: Path) -> None:
    wt.upload(tiny, "hf://us/data")
    tree = dict(hub.files("datasets/us/data"))
    hub.repositories["datasets/us/data"].commit(tree | {"new": b""}, "refs/pr/1")
    hub.repositories["datasets/us/data"].commit(tree | {"new": b"2"}, "feature/x")
    commits = hub.repositories["datasets/us/data"].refs
    for address in ("hf://us/data@refs/pr/1", "hf://us/data@feature%2Fx"):
        dataset = wt.open(address)
        revision = RemotePath.parse(address).root.revision
        assert dataset.path.commit == commits[revision]
        assert dataset.runs[0].weights[1:3].shape[0] == 2
    copy = wt.download("hf://us/data@refs/pr/1", tmp_path / "copy")
    source = source_of(Path(copy.path))
    assert source is not None
    assert source.commit == commits["refs/pr/1"]
    with pytest.raises(RegistryError, match="leave the rest of the address out"):
        wt.upload(tiny, "hf://us/data@refs/pr/1")
    with pytest.raises(RegistryError, match="leave the rest of the address out"):
        wt.upload(tiny, "hf://us/data/folder")


def test_two_folders_of_one_repository_are_two_data_sets(
    hub: stand_in.Hub, tiny: Path, tmp_path: Path
) -> None:
    wt.upload(tiny, "hf://us/data")
    other = wt.registry.create([tiny / "runs/a.zarr.zip"], tmp_path / "other")
    folders = {"a": tiny, "b": Path(other.path)}
    files = {f"{n}/{p}": c for n, f in folders.items() for p, c in files_of(f).items()}
    hub.repositories["datasets/us/data"].commit(files)
    assert len(wt.load_dataset("hf://us/data/a", download=True)) == 2
    assert len(wt.load_dataset("hf://us/data/b", download=True)) == 1
    assert len(wt.load_dataset("hf://us/data/a")) == 2


def test_a_model_is_no_data_set(hub: stand_in.Hub) -> None:
    with pytest.raises(RegistryError, match="one of the hub's models"):
        wt.open("hf://models/us/gate")
    with pytest.raises(RegistryError, match="one of the hub's datasets"):
        tipl.load("hf://datasets/us/gate")
    tipl.push("tipl-gate-inverted-pendulum-v4", "hf://models/us/gate")
    assert tipl.load("hf://us/gate").name == "gate"


@pytest.mark.parametrize(
    "address",
    [
        "file://folder/x",
        "file:///a%2Fb",
        "file:///a%00b",
        "file:///a%zzb",
        "file:///100%",
        "file:///a#b",
        "file:///a?b",
        "s3://bucket/a//b",
        "s3://bucket//a",
        "s3://bucket/a/../b",
        "s3:///a",
        "s3://buc%20ket/a",
        "s3://bucket/a\nb",
        "s3://bucket/\udcff",
        "https://host/a#b",
        "https://host/a/../b",
        "https://host/%2e%2e/b",
        "https:///a",
        "hf://../name",
        "hf://org/name@",
        "hf://org/name@../x",
        "hf://org/name@a%2F..%2Fb",
        "hf://org/na me",
        "hf://org/name//x",
        "hf://org/name/../x",
        "ftp://host/a",
    ],
)
def test_what_can_be_read_in_two_ways_is_refused(address: str) -> None:
    with pytest.raises(RegistryError, match=r"(?s)no address of a data set.*what to do"):
        wt.open(address)


def test_other_spellings_of_one_place(tmp_path: Path) -> None:
    place = RemotePath.parse(tmp_path.as_uri())
    for address in (
        f"file:{tmp_path}",
        f"file://localhost{tmp_path}",
        f"FILE://{tmp_path}/",
        f"file://{tmp_path}//",
    ):
        assert is_remote(address)
        assert RemotePath.parse(address) == place
    assert RemotePath.parse("S3://b/a/") == RemotePath.parse("s3://b/a")
    assert not is_remote("folder/a://b")


def test_what_a_missing_folder_is_called_says_how_it_was_read(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no folder at .*/p q; .*%20 is a space"):
        wt.open(f"file://{tmp_path}/p%20q")


@pytest.mark.parametrize("address", ["s3://b/x", "hf://o/n", "https://h/x", "gs://b/x", "az://b/x"])
def test_a_path_that_was_an_address_is_not_taken_for_a_folder(address: str) -> None:
    for needs in (wt.open, wt.open_run, wt.verify, wt.lint, wt.repair, wt.pack, locate):
        with pytest.raises(RegistryError, match=f"(?s)one of the slashes.*'{address}'"):
            needs(Path(address))  # type: ignore[operator]


@pytest.mark.parametrize("address", ["s3://b/x", "hf://o/n", "file:///x", Path("s3://b/x")])
def test_nothing_is_written_into_a_folder_named_like_an_address(
    address: str | Path,
    tiny: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    run = wt.open_run(tiny / "runs/a.zarr.zip")
    runs = [str(run.path)]
    for write in (
        new_path,
        lambda out: wt.registry.create(runs, out),
        lambda out: wt.download(tiny.as_uri(), out),
        lambda out: wt.export_npy(run, out),
        lambda out: wt.export_hdf5(tiny, out),
        lambda out: wt.pack(run.path, out=out),
        lambda out: wt.RunWriter(out, run.info),
    ):
        with pytest.raises(RegistryError, match="not to an address"):
            write(address)
    assert list(tmp_path.iterdir()) == []


def test_commands_say_the_same_of_an_address(tmp_path: Path) -> None:
    told = set()
    for command in (
        ("verify",),
        ("lint",),
        ("repair",),
        ("returns",),
        ("report",),
        ("pack",),
        ("card",),
        ("split", "--out", "x"),
        ("export", "--to", "hdf5", "--out", "x"),
    ):
        done = shell("weighttraj", command[0], "s3://bucket/a b", *command[1:])
        assert done.returncode == 1, command
        told.add(" ".join(done.stderr.split()))
    assert told == {
        "error: this needs the files on this machine expected: a path, or the id of a data set "
        "that is here got: s3://bucket/a b what to do: weighttraj download 's3://bucket/a b', "
        "then name the folder that it makes"
    }
    done = shell("tipl", "train", "tipl", "--data", "x", "--out", "s3://bucket/x")
    assert done.returncode == 1
    assert "not to an address" in done.stderr


def test_below_an_address() -> None:
    assert below("https://h/a/?sig=1", "x y") == "https://h/a/x%20y?sig=1"
    assert below("file:///a", "x%y") == "file:///a/x%25y"
    assert below("s3://b/a?b/", "x y") == "s3://b/a?b/x y"
    assert below("hf://org", "name") == "hf://org/name"
