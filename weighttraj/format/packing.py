"""A finished run as one file: fewer objects, larger chunks, and the ``archive`` profile."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from weighttraj.errors import FormatError
from weighttraj.format.live import LiveStore
from weighttraj.format.objects import ZipObjects, sync, write_zip
from weighttraj.format.schema import AXES, Profile
from weighttraj.format.storage import PACKED, RunStore, group_document


def pack(path: str | Path, *, profile: Profile = "default", out: str | Path | None = None) -> Path:
    """Pack a finished run into one zip file, chunk by chunk; the run itself stays.

    Every chunk is read back and compared before the file appears under its name.

    Args:
        path: run to be packed; a packed one is packed again.
        profile: ``default``: core codecs, readable by any Zarr v3 library; ``archive``: smallest,
            lossless too, needs PCodec (which comes with this package).
        out: file to be written; default: the run's path and ``.zip``. It is replaced.

    Returns:
        The file.

    Raises:
        FileNotFoundError: there is no run at the path.
        FormatError: the run is still being collected.
    """
    source = RunStore.open(Path(path))
    if source.info.status == "collecting":
        raise FormatError(
            "only a finished run can be packed",
            expected="status complete or crashed",
            got=source.info.status,
            where=path,
            do="finish collecting it first",
        )
    if unknown := sorted(source.documents.keys() - source.specs.keys()):
        raise FormatError(
            "the run has arrays that this version of weighttraj does not know",
            got=unknown,
            where=path,
            do="pip install --upgrade weighttraj, so that nothing is lost",
        )
    target = Path(out or str(path).removesuffix(PACKED) + PACKED)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        live = LiveStore.create(
            Path(folder) / "run.zarr",
            replace(source.info, n_committed=0, n_committed_iterations=0, profile=profile),
            {axis: source.info.committed(axis) for axis in AXES},
        )
        for name, spec in source.specs.items():
            rows, step = source.info.committed(spec.axis), live.chunk_rows(name)
            for start in range(0, rows, step):
                live.write(name, start, source.read(name, slice(start, min(start + step, rows))))
        live.commit(replace(source.info, profile=profile))
        draft = Path(folder) / "run.zip"
        write_zip(draft, _members(live.path))
        sync(draft)
        draft.replace(target)
    sync(target.parent)
    return target


def copy_packed(path: Path, out: Path, run_id: str) -> None:
    """Copy a packed run under another id: all but its metadata byte for byte.

    Args:
        path: the packed run.
        out: file to be written; may be the same. It is replaced.
        run_id: of the copy.
    """
    store, source = RunStore.open(path), ZipObjects(path)
    info = replace(store.info, run_id=run_id)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as folder:
        metadata = Path(folder) / "zarr.json"
        metadata.write_bytes(group_document(info, store.documents, store.tags, store.attributes))
        draft = Path(folder) / "run.zip"
        write_zip(
            draft,
            ((name, metadata if name == "zarr.json" else source) for name in source.names),
        )
        sync(draft)
        draft.replace(out)
    sync(out.parent)


def same_as_packed(path: Path) -> bool:
    """Whether a packed run is, to the last byte, what packing its own members gives.

    So every byte counts, also those of the zip file's directory that no reader looks at.
    """
    with unpacked(path) as folder:
        again = folder.with_name("again.zip")
        write_zip(again, ((name, folder / name) for name in ZipObjects(path).names))
        return _equal(path, again)


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """A packed run as a folder, for as long as the context lasts; nothing is written beside it."""
    with tempfile.TemporaryDirectory() as folder:
        objects = ZipObjects(path)
        for name in objects.names:
            file = Path(folder) / "run.zarr" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(objects.read(name) or b"")
        yield Path(folder) / "run.zarr"


def _members(folder: Path) -> Iterator[tuple[str, Path]]:
    """Files of a run in a fixed order, its metadata first."""
    files = {f.relative_to(folder).as_posix(): f for f in folder.rglob("*") if f.is_file()}
    for name in sorted(files, key=packed_order):
        yield name, files[name]


def packed_order(name: str) -> tuple[bool, bool, str]:
    """Sorts the objects of a packed run: the metadata first, then the chunks by name."""
    return name != "zarr.json", not name.endswith("zarr.json"), name


def _equal(one: Path, other: Path) -> bool:
    if os.path.getsize(one) != os.path.getsize(other):
        return False
    with one.open("rb") as a, other.open("rb") as b:
        while piece := a.read(1 << 22):
            if piece != b.read(len(piece)):
                return False
    return True


__all__ = ["copy_packed", "pack", "packed_order", "same_as_packed", "unpacked"]
