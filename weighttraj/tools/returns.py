"""Stores the returns of snapshots in a finished run; everything else stays as it is."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from weighttraj.atomic import appearing
from weighttraj.errors import DamageError, FormatError
from weighttraj.format.schema import AXES, RETURNS, Evaluation, RunInfo
from weighttraj.remote.address import here
from weighttraj.store.live import LiveStore, empty_arrays, lock_run
from weighttraj.store.objects import FolderObjects, ZipObjects, packed_order, write_zip
from weighttraj.store.zarr_run import (
    PACKED,
    Documents,
    Metadata,
    RunStore,
    group_document,
    member_documents,
)


def store_returns(
    path: str | Path, evaluation: Evaluation, returns: np.ndarray, lengths: np.ndarray
) -> None:
    """Store what the snapshots of a finished run returned in episodes.

    A packed run is written again beside the old file, its other objects byte for byte, and takes
    its place in one atomic replace; returns that it has are replaced. Into a folder the arrays
    are added; what it has stays.

    A data set that is complete has a manifest, which a changed run makes wrong, and tables. So:
    ``unseal`` the data set, store the returns of each run, ``seal`` it. Killed in between, the
    data set opens, ``verify`` says what it lacks, and the same three steps finish it.

    Args:
        path: the run.
        evaluation: how the episodes were played.
        returns: float64 (time, episode); NaN where there is none.
        lengths: integers (time, episode), steps of each episode; -1: not evaluated. Where they
            are not -1 and the return is NaN, the simulation became unstable after so many steps.

    Raises:
        FileNotFoundError: there is no run at the path.
        FormatError: the run is still being collected, the values are not as above, or a folder
            has other returns.
        StoreLockedError: another process is writing this run.
        DamageError: the run is damaged, or what was written does not read back.
    """
    place = Path(RunStore.open(here(path)).path)
    lock = lock_run(locked_path(place))
    try:
        store = RunStore.open(place)
        values = _checked(store, evaluation, returns, lengths)
        info = replace(store.info, evaluation=evaluation)
        if isinstance(store.objects, ZipObjects):
            _write_file(store, info, values)
        elif not _has_already(store, info, values):
            _write_folder(store, info, values)
    finally:
        lock.release()


def drop_returns(store: RunStore) -> None:
    """Remove the returns from a run, also damaged ones; the caller holds the run's lock.

    Objects that no metadata names any more stay in a folder.

    Raises:
        DamageError: something else of a packed run is damaged; nothing was changed.
    """
    info = replace(store.info, evaluation=None)
    if isinstance(store.objects, ZipObjects):
        _write_file(store, info, {})
    else:
        LiveStore(FolderObjects(Path(store.path)), _metadata(store, info, {})).commit(info)


def locked_path(path: Path) -> Path:
    """Return the path whose lock is a run's: that of the folder, also when it is packed."""
    return path.with_name(path.name.removesuffix(PACKED))


def _checked(
    store: RunStore, evaluation: Evaluation, returns: np.ndarray, lengths: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the arrays as they are stored, by name."""
    if store.info.status == "collecting":
        raise FormatError(
            "returns are stored in a finished run only",
            expected="status complete or crashed",
            got=store.info.status,
            where=store.path,
            do="finish collecting it first",
        )
    shape = (store.info.n_committed, len(evaluation.seeds))
    for name, values, kinds, types in zip(
        RETURNS, (returns, lengths), ("f", "iu"), ("float64", "integers"), strict=True
    ):
        right = values.dtype.kind in kinds and (kinds != "f" or values.dtype.itemsize == 8)
        if values.shape != shape or not right:
            raise FormatError(
                f"what is to be stored as {name} has the wrong shape or type",
                expected=f"{types} {shape}: a row for each snapshot, a column for each episode",
                got=f"{values.dtype} {values.shape}",
                where=store.path,
                do="evaluate the run that is there; rows that were not evaluated are NaN and -1",
            )
    _check_values(returns, lengths, store.path)
    pair = (returns.astype("<f8"), lengths.astype("<i4"))
    return {n: np.ascontiguousarray(v) for n, v in zip(RETURNS, pair, strict=True)}


def _check_values(returns: np.ndarray, lengths: np.ndarray, where: object) -> None:
    reasons = {
        "infinite returns": np.isinf(returns),
        "lengths that are no number of steps": (lengths < -1) | (lengths > 2**31 - 1),
        "returns of episodes that were not played": (lengths == -1) & ~np.isnan(returns),
    }
    for what, bad in reasons.items():
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise FormatError(
                f"refused: {what}",
                expected="a finite return and 0 or more steps; NaN and steps: it became unstable; "
                "NaN and -1: not evaluated",
                got=f"{int(bad.sum())}; the first: return {returns[row, column]}, length "
                f"{lengths[row, column]}",
                where=f"{where}, snapshot {row}, episode {column}",
                do="evaluate these snapshots again",
            )


def _has_already(store: RunStore, info: RunInfo, values: Mapping[str, np.ndarray]) -> bool:
    """Return whether a folder has these very returns.

    Raises:
        FormatError: it has others. A chunk cannot be replaced together with its checksum, which
            stands in the run's metadata: killed in between, the run would be damaged.
    """
    if not store.documents.keys() & set(RETURNS):
        return False
    same = store.info == info and all(_bytes(store, n) == v.tobytes() for n, v in values.items())
    if not same:
        raise FormatError(
            "the run has other returns, and those of a folder are not replaced",
            expected="a run without returns, or a packed one",
            got=store.info.evaluation,
            where=store.path,
            do="pack the run (weighttraj.pack), remove its folder, and store them in the file",
        )
    return True


def _write_folder(store: RunStore, info: RunInfo, values: Mapping[str, np.ndarray]) -> None:
    """Write the chunks, then the metadata of single arrays; the group's are the commit."""
    with tempfile.TemporaryDirectory() as folder:
        documents = _documents(Path(folder) / "run.zarr", info, None)
    live = LiveStore(FolderObjects(Path(store.path)), _metadata(store, info, documents))
    _write_arrays(live, values)
    live.write_members(durable=True)
    live.commit(info)


def _write_file(store: RunStore, info: RunInfo, values: Mapping[str, np.ndarray]) -> None:
    """Write a packed run again: with these returns, or with none."""
    path = Path(store.path)
    with appearing(path, replace=True) as draft:
        live = _new_objects(draft.with_name(f"{draft.name}.folder"), store, info, values)
        source = ZipObjects(path)
        kept = _kept(source, store.documents, live.documents)
        _copy(source, kept, live.path, draft)
        _compare(source, kept, RunStore.open(draft), values)


def _new_objects(
    folder: Path, store: RunStore, info: RunInfo, values: Mapping[str, np.ndarray]
) -> LiveStore:
    """Make a folder of the new objects of a packed run: arrays and the metadata that name them."""
    rows: dict[str, int] = {axis: info.committed(axis) for axis in AXES}
    documents = _documents(folder, info, rows) if values else {}
    live = LiveStore(FolderObjects(folder), _metadata(store, info, documents))
    _write_arrays(live, values)
    folder.mkdir(parents=True, exist_ok=True)
    content = group_document(info, live.documents, live.tags, store.attributes)
    (folder / "zarr.json").write_bytes(content)
    for name, member in member_documents(documents).items():
        (folder / name).write_bytes(member)
    return live


def _documents(folder: Path, info: RunInfo, packed_rows: dict[str, int] | None) -> Documents:
    """Return Zarr metadata of the arrays, with the rows that they will have."""
    documents = empty_arrays(folder, info, RETURNS, packed_rows)
    for document in documents.values():
        document["shape"][document["dimension_names"].index("time")] = info.n_committed
    return documents


def _metadata(store: RunStore, info: RunInfo, documents: Documents) -> Metadata:
    """The metadata of a run without the returns it has, and with new arrays; all else stays."""
    others = {n: d for n, d in store.documents.items() if n not in RETURNS}
    tags = {n: t for n, t in store.tags.items() if n not in RETURNS}
    return Metadata(
        info=info,
        documents=others | documents,
        tags=tags | dict.fromkeys(documents, ""),
        attributes=store.attributes,
    )


def _write_arrays(live: LiveStore, values: Mapping[str, np.ndarray]) -> None:
    for name, array in values.items():
        if len(array):
            live.write(name, 0, array)


def _kept(source: ZipObjects, old: Documents, new: Documents) -> list[str]:
    """Return names of objects that stay: no returns, and no metadata that name them."""
    returns = tuple(f"{name}/" for name in RETURNS)
    gone = {"zarr.json", *(member_documents(old).keys() - member_documents(new).keys())}
    return [n for n in source.names if n not in gone and not n.startswith(returns)]


def _copy(source: ZipObjects, kept: list[str], folder: Path, draft: Path) -> None:
    """Write a zip file of members of another one and of the files in a folder."""
    files = {f.relative_to(folder).as_posix(): f for f in folder.rglob("*") if f.is_file()}
    members: dict[str, Path | ZipObjects] = {**dict.fromkeys(kept, source), **files}
    write_zip(draft, ((name, members[name]) for name in sorted(members, key=packed_order)))


def _compare(
    source: ZipObjects, kept: list[str], store: RunStore, values: Mapping[str, np.ndarray]
) -> None:
    """See that a new file holds the old objects and the new arrays.

    Raises:
        DamageError: it does not.
    """
    draft = ZipObjects(Path(store.path))
    bad = [
        name
        for name in kept
        if (draft.size(name), draft.crc32[name]) != (source.size(name), source.crc32[name])
    ]
    bad += [name for name, array in values.items() if _bytes(store, name) != array.tobytes()]
    if bad:
        raise DamageError(
            "objects of the packed run are not what was written; it is left as it was",
            got=f"{len(bad)} objects, such as {bad[:3]}",
            where=source.path,
            do="see what weighttraj verify says of the run; if it is whole, check the disk",
        )


def _bytes(store: RunStore, name: str) -> bytes:
    return store.read(name, slice(None)).tobytes()
