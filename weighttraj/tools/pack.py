"""A finished run as one file: fewer objects, larger chunks, and the ``archive`` profile."""

from __future__ import annotations

import contextlib
import filecmp
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from weighttraj.atomic import appearing
from weighttraj.errors import FormatError
from weighttraj.format.schema import AXES, Profile, RunInfo, arrays_of
from weighttraj.remote.address import Place, RemotePath, here, new_path
from weighttraj.store.live import LiveStore
from weighttraj.store.objects import ZipObjects, packed_order, write_zip
from weighttraj.store.zarr_run import PACKED, RunStore, group_document

GROUPS = frozenset({"critic", "optimizer", "probe", "train", "ret_norm", "eval"})
"""Arrays of a run that it can be without."""


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
    source = RunStore.open(here(path))
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
    target = new_path(out or str(Path(path)).removesuffix(PACKED) + PACKED)
    _write(source, replace(source.info, profile=profile), slice(0, source.info.n_committed), target)
    return target


def cut(
    path: str | Place,
    out: Path,
    *,
    steps: tuple[int, int] | None = None,
    arrays: Collection[str] | None = None,
) -> Path:
    """Pack a part of a finished run: some environment steps, some arrays.

    Weights, digests, counters and the statistics of observations always come along: without these
    a snapshot is none. What belongs to iterations, as probes do, comes from the first one on.

    Args:
        path: the run, here or at an address: what is not wanted is not read.
        out: file to be written; it is replaced.
        steps: first and last environment step of the snapshots; None: all.
        arrays: groups that come along: ``critic``, ``optimizer``, ``probe``, ``train``,
            ``ret_norm``, ``eval``; None: all that the run has.

    Returns:
        The file.

    Raises:
        FormatError: the run is still being collected, has no snapshot in these steps, or there is
            no such group.
    """
    place = path if isinstance(path, RemotePath) else Path(path)
    source = RunStore.open(place)
    steps_of = source.read("index/num_timesteps", slice(None))
    low, high = steps or (0, int(steps_of[-1]) if len(steps_of) else 0)
    start, stop = int(np.searchsorted(steps_of, low)), int(np.searchsorted(steps_of, high, "right"))
    unknown = sorted(set(arrays or ()) - GROUPS)
    if source.info.status == "collecting" or start >= stop or unknown:
        raise FormatError(
            "this part of the run cannot be taken",
            expected=f"a finished run, steps among {steps_of[:1]} to {steps_of[-1:]}, groups of "
            f"arrays among {', '.join(sorted(GROUPS))}",
            got=f"status {source.info.status}, steps {low} to {high}, unknown groups {unknown}",
            where=place,
            do="ask for another part",
        )
    info = _without(source.info, GROUPS - set(arrays)) if arrays is not None else source.info
    last = int(source.read("index/iteration", stop - 1))
    iterations = info.n_committed_iterations
    if last >= 0:  # else the run does not say to which iteration a snapshot belongs
        iterations = min(iterations, last)
    info = replace(info, n_committed=stop - start, n_committed_iterations=iterations)
    _write(source, info, slice(start, stop), out)
    return out


def _without(info: RunInfo, groups: Collection[str]) -> RunInfo:
    """Return the metadata of a run that lacks some groups of arrays."""
    return replace(
        info,
        critic_layout=None if "critic" in groups else info.critic_layout,
        optimizer_moments=info.optimizer_moments and "optimizer" not in groups,
        probe_observations=0 if "probe" in groups else info.probe_observations,
        diagnostics=() if "train" in groups else info.diagnostics,
        ret_norm=info.ret_norm and "ret_norm" not in groups,
        evaluation=None if "eval" in groups else info.evaluation,
    )


def _write(source: RunStore, info: RunInfo, snapshots: slice, target: Path) -> None:
    """Write rows of a run into a new packed one, chunk by chunk, each read back and compared.

    Args:
        source: the run.
        info: of the new one; it has some of the source's arrays.
        snapshots: which of the source's.
        target: the file.
    """
    with appearing(target, replace=True) as draft:
        live = LiveStore.create(
            draft.with_name(f"{draft.name}.folder"),
            replace(info, n_committed=0, n_committed_iterations=0),
            {axis: info.committed(axis) for axis in AXES},
        )
        for name, spec in arrays_of(info).items():
            first = snapshots.start if spec.axis == "time" else 0
            rows, step = info.committed(spec.axis), live.chunk_rows(name)
            for start in range(0, rows, step):
                some = slice(first + start, first + min(start + step, rows))
                live.write(name, start, source.read(name, some))
        live.commit(info)
        write_zip(draft, _members(live.path))


def copy_packed(path: Path, out: Path, run_id: str) -> None:
    """Copy a packed run under another id: all but its metadata byte for byte.

    Args:
        path: the packed run.
        out: file to be written; may be the same. It is replaced.
        run_id: of the copy.
    """
    store, source = RunStore.open(path), ZipObjects(path)
    info = replace(store.info, run_id=run_id)
    with appearing(out, replace=True) as draft:
        metadata = draft.with_name(f"{draft.name}.json")
        metadata.write_bytes(group_document(info, store.documents, store.tags, store.attributes))
        members = ((n, metadata if n == "zarr.json" else source) for n in source.names)
        write_zip(draft, members)


def same_as_packed(path: Path) -> bool:
    """Return whether a packed run is, to the last byte, what packing its own members gives.

    So every byte counts, also those of the zip file's directory that no reader looks at.
    """
    with unpacked(path) as folder:
        again = folder.with_name("again.zip")
        write_zip(again, ((name, folder / name) for name in ZipObjects(path).names))
        return filecmp.cmp(path, again, shallow=False)


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
    """Yield files of a run in a fixed order, its metadata first."""
    files = {f.relative_to(folder).as_posix(): f for f in folder.rglob("*") if f.is_file()}
    for name in sorted(files, key=packed_order):
        yield name, files[name]
