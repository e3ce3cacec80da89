"""Data sets made to do harm: refused by one clear error, before memory is taken or files written.

Whoever makes such data can compute our checksums too, so here they are right.
"""

from __future__ import annotations

import faulthandler
import gzip
import json
import os
import shutil
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import weighttraj as wt
from tests.benchmarks.stress_format import bounded, contents, forge, live_copy, make_samples
from weighttraj.errors import DamageError, FormatError
from weighttraj.store.zarr_run import checksum
from weighttraj.tools.pack import unpacked

LITTLE = 64 << 20
"""Bytes that refusing may take at most."""

Document = dict[str, Any]


@pytest.fixture(scope="module")
def samples(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Do not write to them."""
    folder = tmp_path_factory.mktemp("untrusted") / "samples"
    make_samples(small_dataset, folder)
    run = wt.open(small_dataset).runs[0]
    live_copy(run, folder / "columns.zarr", 25, 6, "complete")
    packed = wt.pack(folder / "columns.zarr", profile="archive")
    shutil.rmtree(folder / "columns.zarr")
    with unpacked(packed) as members:
        shutil.copytree(members, folder / "columns.zarr")
    packed.unlink()
    return folder


@pytest.fixture
def run(samples: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(samples / "complete.zarr", tmp_path / "data/run.zarr"))


@pytest.fixture
def dataset(samples: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(samples / "default", tmp_path / "data/set"))


@contextmanager
def little(folder: Path) -> Iterator[None]:
    """What happens here takes little memory and writes nothing."""
    before = listing(folder)
    tracemalloc.start()
    try:
        with bounded(seconds=0):
            yield
        assert tracemalloc.get_traced_memory()[1] < LITTLE
    finally:
        tracemalloc.stop()
    assert listing(folder) == before


def listing(folder: Path) -> dict[Path, int]:
    files = (p for p in folder.rglob("*") if p.suffix != ".lock" and not p.is_dir())
    return {p: p.lstat().st_mtime_ns for p in files}


def refused(path: Path, match: str = ".") -> None:
    """Reading says no, and so does verifying; both by errors of ours."""
    with little(path.parent.parent):
        with pytest.raises(FormatError, match=match):
            contents(path)
        assert wt.verify(path)


def change(path: Path, what: Callable[[Document], None]) -> None:
    """Change a document, and make its checksum right again."""
    file = path / ("zarr.json" if path.suffix == ".zarr" else "dataset.json")
    document = json.loads(file.read_bytes())
    what(document)
    forge(document)
    file.write_text(json.dumps(document, indent=1))


def retag(path: Path, name: str) -> None:
    """Say of each chunk of an array what it now is, as whoever forges it can."""
    files = sorted(p for p in (path / name / "c").rglob("*") if p.is_file())

    def tags(content: bytes) -> list[str]:
        if path.name != "wide.zarr" or name != "policy/weights":
            return [content[-4:].hex()]
        table = np.frombuffer(content[:32], "<u8").reshape(2, 2).tolist()
        return [content[offset : offset + length][-4:].hex() for offset, length in table]

    def what(document: Document) -> None:
        new = "".join(tag for file in files for tag in tags(file.read_bytes()))
        old = document["attributes"]["weighttraj_crc32c"][name]
        document["attributes"]["weighttraj_crc32c"][name] = new.ljust(len(old), "0")[: len(old)]

    change(path, what)


def info(document: Document) -> Document:
    return document["attributes"]["weighttraj"]  # type: ignore[no-any-return]


def arrays(document: Document) -> Document:
    return document["consolidated_metadata"]["metadata"]  # type: ignore[no-any-return]


def weights(document: Document) -> Document:
    return arrays(document)["policy/weights"]  # type: ignore[no-any-return]


# Metadata that ask for too much


def n_committed(n: int) -> Callable[[Document], None]:
    """So many snapshots, said everywhere."""

    def what(document: Document) -> None:
        old = info(document)["n_committed"]
        info(document)["n_committed"] = n
        for node in arrays(document).values():
            if node.get("dimension_names", [""])[0] == "time" and node["shape"][0] == old:
                node["shape"][0] = n

    return what


def row_shape(where: str, value: int, *names: str) -> Callable[[Document], None]:
    """Rows of another size, said everywhere; ``where`` is the path in the run's metadata."""

    def what(document: Document) -> None:
        holder: Any = info(document)
        *folders, last = where.split(".")
        for part in folders:
            holder = holder[int(part)] if part.isdigit() else holder[part]
        holder[int(last) if last.isdigit() else last] = value
        for name in names:
            arrays(document)[name]["shape"][1] = value

    return what


def chunk(*shape: Any) -> Callable[[Document], None]:
    def what(document: Document) -> None:
        weights(document)["chunk_grid"]["configuration"]["chunk_shape"] = list(shape)

    return what


def shards(*inner: Any, **other: Any) -> Callable[[Document], None]:
    """The weights lie in shards whose chunks have this shape."""

    def what(document: Document) -> None:
        node = weights(document)
        index = [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}]
        shard = {
            "chunk_shape": list(inner),
            "codecs": node["codecs"],
            "index_codecs": index,
            "index_location": "start",
        }
        node["codecs"] = [{"name": "sharding_indexed", "configuration": shard | other}]

    return what


TOO_MUCH = {
    "terabytes of snapshots": n_committed(2**40),
    "more snapshots than a machine counts": n_committed(2**63),
    "snapshots beyond any integer": n_committed(10**30),
    "negative snapshots": n_committed(-8),
    "terabytes of an observation": row_shape(
        "obs_norm.shape.0", 2**40, "obs_norm/mean", "obs_norm/var"
    ),
    "a negative observation": row_shape("obs_norm.shape.0", -4, "obs_norm/mean", "obs_norm/var"),
    "an empty observation": row_shape("obs_norm.shape.0", 0, "obs_norm/mean", "obs_norm/var"),
    "terabytes of probes": row_shape("probe_observations", 2**40, "probe/observations"),
    "terabytes of parameters": row_shape("layout.params.0.shape.0", 2**40, "policy/weights"),
    "terabytes of a chunk": chunk(2**40, 122),
    "a chunk of no rows": chunk(0, 122),
    "a negative chunk": chunk(-8, -122),
    "a chunk of half rows": chunk(8.5, 122),
    "a chunk of truth values": chunk(True, 122),
    "a chunk of words": chunk("8", "122"),
    "a chunk of one axis": chunk(8),
    "chunks of terabytes in shards": shards(2**40, 2**40),
    "chunks of no rows in shards": shards(0, 122),
    "chunks that do not fit shards": shards(3, 122),
    "shards without an index": shards(8, 122, index_codecs=[]),
    "shards whose index is a number": shards(8, 122, index_codecs=7),
    "shards whose chain is a number": shards(8, 122, codecs=7),
}


@pytest.mark.parametrize("case", TOO_MUCH)
def test_metadata_that_ask_for_too_much_are_refused(run: Path, case: str) -> None:
    change(run, TOO_MUCH[case])
    refused(run)


# Metadata that ask for something else


def codecs(*names: str) -> Callable[[Document], None]:
    def what(document: Document) -> None:
        weights(document)["codecs"][:0] = [{"name": name} for name in names]

    return what


def deep_codecs(document: Document) -> None:
    node = weights(document)
    for _ in range(40):
        node["codecs"] = [{"name": "sharding_indexed", "configuration": {"codecs": node["codecs"]}}]


def put(key: str, value: Any) -> Callable[[Document], None]:
    return lambda document: weights(document).update({key: value})


def rename(key: str, value: Any) -> Callable[[Document], None]:
    return lambda document: info(document).update({key: value})


SOMETHING_ELSE = {
    "a pickle": codecs("numcodecs.pickle"),
    "a made-up codec": codecs("../../codec"),
    "text": codecs("vlen-utf8"),
    "a pickle in a shard": shards(8, 122, codecs=[{"name": "numcodecs.pickle"}]),
    "a pickle in a shard's index": shards(8, 122, index_codecs=[{"name": "numcodecs.pickle"}]),
    "shards in shards": deep_codecs,
    "objects": put("data_type", "object"),
    "objects by their numpy name": put("data_type", "|O"),
    "another type": put("data_type", "float64"),
    "a type of its own": put("data_type", {"name": "numpy.void", "configuration": {}}),
    "a transformer": put("storage_transformers", [{"name": "x"}]),
    "another grid": put("chunk_grid", {"name": "rectilinear", "configuration": {}}),
    "other keys": put("chunk_key_encoding", {"name": "v2", "configuration": {"separator": "/"}}),
    "a group": put("node_type", "group"),
    "a run id that leads out": rename("run_id", "../../run"),
    "a diagnostic that leads out": rename("diagnostics", ["../../../out"]),
    "a diagnostic without end": rename("diagnostics", ["a" * 300]),
}


@pytest.mark.parametrize("case", SOMETHING_ELSE)
def test_metadata_that_ask_for_something_else_are_refused(run: Path, case: str) -> None:
    change(run, SOMETHING_ELSE[case])
    refused(run)


def test_a_made_up_fill_value_changes_no_number(samples: Path, run: Path) -> None:
    change(run, put("fill_value", "0x7fc0beef"))
    before = contents(samples / "complete.zarr")
    assert np.array_equal(
        wt.open_run(run).weights[:].reshape(-1),
        np.frombuffer(before["policy/weights"], np.float32),
    )


@pytest.mark.parametrize("path", ["../out", "train/../../out", "/etc/out", "a//b", "a\\b", ""])
def test_repair_writes_nothing_outside_of_a_run(run: Path, path: str) -> None:
    def what(document: Document) -> None:
        name = f"train/{path}"
        info(document)["diagnostics"] = [path]
        arrays(document)[name] = arrays(document)["index/learning_rate"]

    change(run, what)
    with little(run.parent.parent), pytest.raises(FormatError, match="lead out of its folder"):
        wt.repair(run)


# JSON that is none, or not for everyone

ODD_JSON = {
    "a key twice": ("{", '{"x": 1, "x": 2, '),
    "no number": ("{", '{"x": NaN, '),
    "an infinite number": ("{", '{"x": -Infinity, '),
    "a number beyond all": ("{", '{"x": 1e999, '),
    "half a character": ("{", '{"x": "\\ud800", '),
    "half a character as key": ("{", '{"\\udfff": 1, '),
    "deep lists": ("{", '{"x": ' + "[" * 100_000 + "]" * 100_000 + ", "),
    "deep objects": ("{", '{"x": ' + '{"a":' * 900 + "1" + "}" * 900 + ", "),
    "a huge integer": ("{", '{"x": ' + "9" * 5000 + ", "),
}


@pytest.mark.parametrize("case", ODD_JSON)
@pytest.mark.parametrize("kind", ["run", "dataset"])
def test_json_that_python_alone_reads_is_refused(
    kind: str, case: str, request: pytest.FixtureRequest
) -> None:
    path: Path = request.getfixturevalue(kind)
    file = path / ("zarr.json" if kind == "run" else "dataset.json")
    old, new = ODD_JSON[case]
    text = file.read_text().replace(old, new, 1)
    try:
        document = json.loads(text)
        at = document["attributes"] if kind == "run" else document
        key = "weighttraj_sha256" if kind == "run" else "sha256"
        stored = at.pop(key)
        text = text.replace(stored, checksum(document))
    except (ValueError, RecursionError):
        pass  # no checksum can be made of it
    file.write_text(text)
    refused(path)


@pytest.mark.parametrize("text", [b"", b"null", b"7", b"[]", b'"x"', b"\xff\xfe{\0}\0", b"{}\0"])
@pytest.mark.parametrize("name", ["run/zarr.json", "dataset/dataset.json"])
def test_other_documents_are_refused(
    text: bytes, name: str, request: pytest.FixtureRequest
) -> None:
    kind, file = name.split("/")
    path: Path = request.getfixturevalue(kind)
    (path / file).write_bytes(text)
    refused(path)


# Chunks that lie about themselves


def with_crc(content: bytes) -> bytes:
    return content + struct.pack("<I", google_crc32c.value(content))


def header(at: int, value: int) -> Callable[[bytes], bytes]:
    """A Blosc chunk with another number in its header."""
    return lambda data: data[:at] + struct.pack("<I", value) + data[at + 4 :]


LIES = {
    "decodes to gigabytes": header(4, 2**31 - 17),
    "decodes to more than a chunk can": header(4, 2**32 - 1),
    "decodes to less": header(4, 4),
    "has more bytes than it has": header(12, 2**31 - 1),
    "leads far out of its bytes": lambda data: header(12, 2**31 - 1)(header(16, 2**30)(data)),
    "has fewer bytes": header(12, 20),
    "is a header": lambda data: data[:16],
    "is half a header": lambda data: data[:7],
    "is nothing": lambda _: b"",
    "is something else": lambda _: b"import os; os.system('true')" * 9,
}


@pytest.mark.parametrize("case", LIES)
@pytest.mark.parametrize("sample", ["complete.zarr", "wide.zarr", "columns.zarr"])
def test_a_chunk_that_lies_is_damage(samples: Path, tmp_path: Path, sample: str, case: str) -> None:
    path = Path(shutil.copytree(samples / sample, tmp_path / "data" / sample))
    file = next(p for p in sorted((path / "policy/weights/c").rglob("*")) if p.is_file())
    content = file.read_bytes()
    start = 0 if sample != "wide.zarr" else lie_in_shard(content)
    lie = with_crc(LIES[case](content[start:-4]))
    if sample == "wide.zarr":  # the last chunk of the shard; the index says where it ends
        index = bytearray(content[:36])
        index[24:32] = struct.pack("<Q", len(lie))
        content = with_crc(bytes(index[:32])) + content[36:start]
    else:
        content = b""
    file.write_bytes(content + lie)
    retag(path, "policy/weights")
    with little(path.parent), pytest.raises(DamageError):
        wt.open_run(path).weights[:]
    assert wt.verify(path)


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_columns_of_a_chunk_that_lies_are_damage(run: Path) -> None:
    file = run / "policy/weights/c/0/0"
    file.write_bytes(with_crc(LIES["leads far out of its bytes"](file.read_bytes()[:-4])))
    retag(run, "policy/weights")
    pid = os.fork()  # it may take the process with it
    if not pid:
        faulthandler.disable()
        try:
            wt.open_run(run).weights[:, 1:3]
        except DamageError:
            os._exit(7)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7


def test_a_chunk_that_explodes_is_refused(run: Path) -> None:
    def what(document: Document) -> None:
        weights(document)["codecs"] = [
            {"name": "bytes", "configuration": {"endian": "little"}},
            {"name": "gzip", "configuration": {"level": 5}},
            {"name": "crc32c"},
        ]

    change(run, what)
    (run / "policy/weights/c/0/0").write_bytes(with_crc(gzip.compress(bytes(2 * LITTLE))))
    refused(run)


def lie_in_shard(content: bytes) -> int:
    """Where the second of two chunks begins in a shard whose index comes first."""
    (offset,) = struct.unpack("<Q", content[16:24])
    return int(offset)


def test_a_stream_of_another_count_is_damage(samples: Path, tmp_path: Path) -> None:
    from pcodec import ChunkConfig, standalone

    path = Path(shutil.copytree(samples / "columns.zarr", tmp_path / "data/columns.zarr"))
    file = path / "index/learning_rate/c/0"
    for values in (np.zeros(7), np.zeros(9), np.zeros(10**7), np.zeros(8, np.float32)):
        stream = standalone.simple_compress(values, ChunkConfig())
        file.write_bytes(with_crc(stream))
        retag(path, "index/learning_rate")
        with little(path.parent), pytest.raises(DamageError):
            wt.open_run(path)["index/learning_rate"][:]


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_bytes_with_a_right_checksum_are_read_or_refused(samples: Path, data: Any) -> None:
    sample = data.draw(st.sampled_from(["complete.zarr", "columns.zarr"]))
    file = samples / sample / "index/learning_rate/c/0"
    metadata = samples / sample / "zarr.json"
    whole, before = file.read_bytes(), metadata.read_bytes()
    content = bytearray(whole[:-4])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    try:
        file.write_bytes(with_crc(bytes(content)))
        retag(samples / sample, "index/learning_rate")
        with bounded(seconds=0):
            assert len(wt.open_run(samples / sample)["index/learning_rate"][:]) == 25
    except DamageError:
        pass
    finally:
        file.write_bytes(whole)
        metadata.write_bytes(before)


# Zip files


def rezipped(path: Path, how: Callable[[zipfile.ZipFile, list[tuple[str, bytes]]], None]) -> None:
    """Write a packed run anew, as the function likes."""
    with zipfile.ZipFile(path) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(path, "w") as archive:
        how(archive, members)


def named(name: str) -> Callable[[zipfile.ZipFile, list[tuple[str, bytes]]], None]:
    """All members, and one of this name."""

    def how(archive: zipfile.ZipFile, members: list[tuple[str, bytes]]) -> None:
        for member, content in members:
            archive.writestr(member, content)
        archive.writestr(name, b"evil")

    return how


def deflated(archive: zipfile.ZipFile, members: list[tuple[str, bytes]]) -> None:
    for name, content in members:
        archive.writestr(name, content, zipfile.ZIP_DEFLATED)


def bomb(archive: zipfile.ZipFile, members: list[tuple[str, bytes]]) -> None:
    for name, content in members:
        archive.writestr(name, content)
    archive.writestr("zeros", bytes(32 << 20), zipfile.ZIP_DEFLATED)


ZIPS = {
    "compressed": deflated,
    "a bomb": bomb,
    **{f"a member {n!r}": named(n) for n in ("../out", "/etc/out", "a/../../out", "a\\out", "a:b")},
    "a member without end": named("a" * 300),
}


@pytest.mark.parametrize("case", ZIPS)
def test_odd_zip_files_are_refused(dataset: Path, case: str) -> None:
    rezipped(dataset / "runs/seed0000.zarr.zip", ZIPS[case])
    refused(dataset)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_member_twice_is_refused(dataset: Path) -> None:
    rezipped(dataset / "runs/seed0000.zarr.zip", named("zarr.json"))
    refused(dataset, "each name once")


DIRECTORY = {
    "encrypted": (8, "<H", 1),
    "beyond the file": (42, "<I", 2**31),
    "in another member": (42, "<I", 0),
    "gigabytes": (20, "<II", (2**31, 2**31)),
    "a later version of zip": (6, "<H", 99),
}


@pytest.mark.parametrize("case", DIRECTORY)
def test_a_zip_directory_that_lies_is_refused(dataset: Path, case: str) -> None:
    file = dataset / "runs/seed0000.zarr.zip"
    at, form, values = DIRECTORY[case]
    content = bytearray(file.read_bytes())
    last = content.rfind(b"PK\x01\x02")  # the last member of the central directory
    struct.pack_into(form, content, last + at, *(values if isinstance(values, tuple) else [values]))
    file.write_bytes(content)
    refused(dataset)


def test_members_that_share_bytes_are_refused(dataset: Path) -> None:
    file = dataset / "runs/seed0000.zarr.zip"
    content = bytearray(file.read_bytes())
    one = content.find(b"PK\x01\x02", content.find(b"PK\x01\x02") + 1)
    other = content.find(b"PK\x01\x02", one + 1)
    content[other + 42 : other + 46] = content[one + 42 : one + 46]
    file.write_bytes(content)
    refused(dataset, "not where the directory says")


def test_unpacking_stays_in_its_folder(dataset: Path) -> None:
    file = dataset / "runs/seed0000.zarr.zip"
    rezipped(file, named("../../out"))
    with (
        little(dataset.parent.parent),
        pytest.raises(FormatError, match="lead out of its folder"),
        unpacked(file),
    ):
        pass


# Paths and links


@pytest.mark.parametrize(
    "path", ["../run.zarr", "runs/../../run.zarr", "/etc/run.zarr", "runs", "", "runs/x.zarr\n"]
)
def test_a_run_elsewhere_is_refused(dataset: Path, path: str) -> None:
    change(dataset, lambda document: document["runs"][0].update({"path": path}))
    refused(dataset, "must lie in its data set")


@pytest.mark.parametrize("name", ["..", ".", "", "a/b", "a\0", "a" * 129, "seed0000\n", "\u202e"])
def test_an_id_that_is_no_name_is_refused(dataset: Path, name: str) -> None:
    entry = {"id": name, "path": f"runs/{name}.zarr"}
    change(dataset, lambda document: document["runs"][0].update(entry))
    refused(dataset, "invalid run id")


@pytest.mark.parametrize("path", ["../run", "/etc/passwd", "runs/../../x", "runs//x", "."])
def test_a_manifest_that_leads_out_is_refused(dataset: Path, path: str) -> None:
    with (dataset / "MANIFEST.sha256").open("a") as file:
        file.write(f"{'0' * 64}  12  {path}\n")
    with little(dataset.parent):
        assert "lead out of its folder" in wt.verify(dataset)[0]


@pytest.mark.parametrize(
    "name",
    ["dataset.json", "MANIFEST.sha256", "tables/runs.parquet", "runs/seed0000.zarr.zip", "runs"],
)
def test_links_in_a_data_set_are_refused(dataset: Path, tmp_path: Path, name: str) -> None:
    moved = tmp_path / "elsewhere"
    (dataset / name).rename(moved)
    (dataset / name).symlink_to(moved)
    with little(dataset.parent):
        assert any("link" in problem for problem in wt.verify(dataset))
        if name not in ("MANIFEST.sha256", "tables/runs.parquet"):  # reading needs neither
            with pytest.raises(FormatError, match="link"):
                contents(dataset)


@pytest.mark.parametrize(
    "name", ["zarr.json", "policy", "policy/weights", "policy/weights/c", "policy/weights/c/0/0"]
)
def test_links_in_a_run_are_refused(run: Path, tmp_path: Path, name: str) -> None:
    moved = tmp_path / "elsewhere"
    (run / name).rename(moved)
    (run / name).symlink_to(moved)
    with little(run.parent):
        assert any("link" in problem for problem in wt.verify(run))
        with pytest.raises(FormatError, match="link"):
            contents(run)


def test_repair_follows_no_link(run: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    (run / "train").rename(outside)
    for file in outside.rglob("zarr.json"):
        file.write_text("mine")
    (run / "train").symlink_to(outside)
    with pytest.raises(FormatError, match="link"):
        wt.repair(run)
    assert {file.read_text() for file in outside.rglob("zarr.json")} == {"mine"}


def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(run: Path) -> None:
    for name in ("index/epoch/zarr.json", "policy/weights/c/0/0"):
        (run / name).unlink()
        os.mkfifo(run / name)
    assert len(wt.verify(run)) >= 2
    with pytest.raises(DamageError, match="missing"):
        wt.open_run(run).weights[:]
