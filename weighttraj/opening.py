"""Opens data sets and runs, wherever they are."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path

from weighttraj.dataset import Dataset
from weighttraj.errors import DamageError, FormatError, RegistryError
from weighttraj.format.schema import DatasetInfo, RunEntry
from weighttraj.locate import is_run, locate
from weighttraj.remote.address import Place, RemotePath, is_remote
from weighttraj.run import Run
from weighttraj.store.catalog import DATASET, parse_dataset, read_dataset_info
from weighttraj.store.objects import FolderObjects
from weighttraj.store.zarr_run import PACKED, RunStore


def open_dataset(
    path: str | Place, *, runs: Collection[str] | None = None, revision: str | None = None
) -> Dataset:
    """Open a data set: a folder, one HDF5 file (``.h5``), one run, an id, or an address.

    The path of a run, a folder ``<id>.zarr`` or a packed run ``<id>.zarr.zip``, opens as a data set
    of this one run. A folder that holds a data set in ``data``, as ``datasets/<id>`` does, opens as
    that one.

    Ids are looked for in the folders of ``WEIGHTTRAJ_DATASETS_PATH`` (where it names none, in
    ``~/.weighttraj/datasets``), in those of a clone, and in ``data`` of the working directory. A
    data set that is still being collected opens too, with the runs that exist so far.

    At an address (``hf://org/name``, ``s3://``, ``gs://``, ``az://``, ``https://``, ``file://``)
    nothing is downloaded but what is read: the list of runs now, then parts of runs. HDF5 files
    need the extra ``files``, addresses ``remote`` and the hub's ``hub``.

    Args:
        path: where it is.
        runs: ids of the runs that are wanted; None: all.
        revision: branch, tag or commit, of a data set on the hub; it is pinned to its commit.

    Raises:
        FileNotFoundError: there is no data set and no run at the path.
        FormatError: it is none of this format, or a run is a link.
        DamageError: it is complete but lacks a run that it lists.
        RegistryError: it has no run of such an id, or the address is none.
        RemoteError: it is somewhere else, and cannot be reached.
    """
    if is_remote(path):
        place = path if isinstance(path, RemotePath) else RemotePath.parse(str(path), revision)
        if place.name.removesuffix(PACKED).endswith(".zarr"):
            return _chosen(_alone(open_run(place)), runs)
        return _chosen(_open_remote(place), runs)
    if revision is not None:
        RemotePath.parse(Path(path).absolute().as_uri(), revision)  # raises: no revisions here
    path = locate(path)
    if path.suffix == ".h5":
        return _chosen(open_hdf5(path), runs)
    if not (path / DATASET).is_file() and is_run(path):
        packed = path.with_name(path.name + PACKED)
        return _chosen(_alone(open_run(path if path.exists() else packed)), runs)
    return _chosen(_open_folder(path), runs)


def open_run(path: str | Place) -> Run:
    """Open one run: a folder ``<id>.zarr``, or a packed run ``<id>.zarr.zip``; also at an address.

    Raises:
        FileNotFoundError: there is no run at the path.
        FormatError: it is none of this format.
        RemoteError: it is somewhere else, and cannot be reached.
    """
    place: Place
    if is_remote(path):
        place = path if isinstance(path, RemotePath) else RemotePath.parse(str(path)).as_object()
    else:
        place = Path(path)
    run = Run(place, partial(RunStore.open, place))
    run._store  # noqa: B018  now, so that errors come from here
    return run


def info_of_one(run: Run) -> DatasetInfo:
    """Return the metadata of a data set that has this run only, under the run's id."""
    info, packed = run.info, run.path.name.endswith(PACKED)
    path = f"runs/{info.run_id}.zarr{PACKED if packed else ''}"
    return DatasetInfo(
        id=info.run_id,
        runs=(RunEntry(id=info.run_id, path=path, seed=info.seed),),
        status="complete" if info.status == "complete" else "collecting",
    )


def _alone(run: Run) -> Dataset:
    """Return a data set of one run, which lies anywhere."""
    return Dataset(run.path, info_of_one(run), [run])


def _open_folder(path: Path) -> Dataset:
    info = read_dataset_info(path)
    runs, objects = [], FolderObjects(path)
    for entry in info.runs:
        objects.file(entry.path)  # refuses links: they could lead anywhere
        place = path / entry.path
        if not place.exists() and (packed := place.with_name(place.name + PACKED)).is_file():
            place = packed  # the folder became this file
        if place.is_file() or (place / "zarr.json").is_file():
            runs.append(Run(place, partial(RunStore.open, place), entry))
        elif info.status == "complete":
            raise DamageError(
                "the data set lacks a run that it lists",
                expected=entry.path,
                got="no such run",
                where=path,
                do="restore the run's folder from a copy, or collect it again",
            )
    return Dataset(path, info, runs)


def _open_remote(place: RemotePath) -> Dataset:
    """Return the data set at an address; its runs are opened when they are first used."""
    from weighttraj.remote.hub import pinned
    from weighttraj.remote.store import store_at

    if place.scheme == "hf":
        place = pinned(place)
    where = place / DATASET
    content = store_at(place.root).read(where.part)
    if content is None:
        raise FileNotFoundError(f"no data set at {place}: it has no {DATASET}")
    info = parse_dataset(content.content, where)
    if info.status != "complete":
        raise FormatError(
            "the data set at this address is not complete",
            expected="status complete, as `weighttraj upload` leaves it",
            got=info.status,
            where=place,
            do="open it where it is being collected",
        )
    places = [place / entry.path for entry in info.runs]
    pairs = zip(places, info.runs, strict=True)
    return Dataset(place, info, [Run(p, partial(RunStore.open, p), entry) for p, entry in pairs])


def _chosen(dataset: Dataset, runs: Collection[str] | None) -> Dataset:
    if runs is None:
        return dataset
    known = [run.id for run in dataset]
    if unknown := sorted(set(runs) - set(known)):
        raise RegistryError(
            "the data set has no such run",
            expected=f"some of {', '.join(known)}",
            got=", ".join(unknown),
            where=dataset.path,
            do="correct the ids of the runs",
        )
    return Dataset(dataset.path, dataset.info, [dataset[run] for run in runs])


def open_hdf5(path: str | Path) -> Dataset:
    """Open the data set in an HDF5 file; runs are read when they are first used.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: it is none of this format.
        DamageError: it is damaged, or lacks a run that it lists.
    """
    from weighttraj.store.hdf5_run import RUN, H5RunStore, exists, opened, read_document

    path = Path(path)
    with opened(path) as root:
        if not exists(root, DATASET):
            raise FormatError(
                "this HDF5 file is no data set of weighttraj",
                expected=f"/{DATASET}",
                got=f"no such data; there are {list(root)[:8]}",
                where=path,
                do="open a file that weighttraj.export_hdf5 wrote",
            )
        where = f"{path}, /{DATASET}"
        info = parse_dataset(read_document(root, DATASET, where), where)
        missing = [r.id for r in info.runs if not exists(root, f"runs/{r.id}/{RUN}")]
    if missing and info.status == "complete":
        raise DamageError(
            "the data set lacks runs that it lists",
            expected=[run.id for run in info.runs],
            got=f"no {missing}",
            where=path,
            do="restore the file from a copy, or export it again",
        )
    entries = [entry for entry in info.runs if entry.id not in missing]
    runs = [Run(path / "runs" / e.id, partial(H5RunStore.open, path, e.id), e) for e in entries]
    return Dataset(path, info, runs)
