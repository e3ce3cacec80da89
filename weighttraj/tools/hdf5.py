"""Data sets and runs as one HDF5 file, there and back. Needs the extra ``files``.

The tree is the data set's: ``/dataset.json``, ``/runs/<id>/policy/weights`` and so on, beside
``/runs/<id>/run.json``, the run's metadata with the hashes of its arrays. Metadata are fixed-length
byte strings, because HDF5's attributes end at 64 KiB; both carry a checksum. An export is finished:
nothing is added to it, and it is no format to collect in.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from weighttraj.atomic import appearing
from weighttraj.errors import FormatError, needs

with needs("files"):
    import h5py

from weighttraj.dataset import Dataset
from weighttraj.format.schema import ArraySpec, DatasetInfo, arrays_of, to_json, with_progress
from weighttraj.opening import info_of_one, open_dataset, open_hdf5
from weighttraj.run import Run, StoredArray
from weighttraj.store.catalog import DATASET, dataset_document, write_dataset_info
from weighttraj.store.codecs import PACKED_CHUNK_BYTES, part_of_row, row_bytes
from weighttraj.store.hdf5_run import MAX_METADATA_BYTES, RUN, sha256
from weighttraj.store.live import LiveStore
from weighttraj.store.objects import check_name
from weighttraj.store.zarr_run import ATTRIBUTE, PACKED, checksum
from weighttraj.tools.pack import pack
from weighttraj.tools.repair import seal

LIBVER = ("v110", "v110")
"""The oldest version of HDF5 (2016) that checksums its own metadata; a later one reads it too."""


def export_hdf5(source: Dataset | Run | str | Path, out: str | Path) -> Path:
    """Write a data set, a selection of its runs, or one run into one HDF5 file.

    Everything is read back and compared before the file appears under its name. A single run
    becomes a data set of one run, with the run's id.

    Args:
        source: a data set or run, or the path of one.
        out: file to be written.

    Returns:
        The file.

    Raises:
        StoreExistsError: the file exists.
        FileNotFoundError: there is neither a data set nor a run at the path.
        DamageError: the source is damaged, or the file does not read back as it was written.
        FormatError: the metadata is too large.
    """
    out = Path(out)
    runs, info = _contents(source)
    with appearing(out) as draft:
        with h5py.File(draft, "x", libver=LIBVER) as root:
            _put_document(root, DATASET, dataset_document(info))
            for run in runs:
                _put_run(root.create_group(f"runs/{run.id}"), run)
        for run in open_hdf5(draft):
            for array in run.arrays.values():
                for _ in array.pieces():
                    pass  # reading is checking
    return out


def import_hdf5(file: str | Path, out: str | Path) -> Path:
    """Write a data set's folder from an HDF5 file; every snapshot is compared with its digest.

    The folder holds what was exported, to the last bit; of a complete data set, the tables and the
    manifest are written too.

    Args:
        file: what ``export_hdf5`` wrote.
        out: folder to be written.

    Returns:
        The folder.

    Raises:
        StoreExistsError: the folder exists.
        FileNotFoundError: there is no such file.
        FormatError: it is none of this format.
        DamageError: it is damaged.
    """
    out = Path(out)
    dataset = open_hdf5(file)
    places = {entry.id: entry.path for entry in dataset.info.runs}
    with appearing(out) as draft:
        draft.mkdir()
        for run in dataset:
            _import_run(run, draft / places[run.id])
        write_dataset_info(draft, dataset.info)
        if dataset.info.status == "complete":
            seal(draft)
    return out


def _contents(source: Dataset | Run | str | Path) -> tuple[list[Run], DatasetInfo]:
    """Return the runs to be exported, and the list of them."""
    if isinstance(source, str | Path):
        source = open_dataset(source)
    if isinstance(source, Run):
        return [source], info_of_one(source)
    listed = source.info
    if listed.status == "complete":  # else it lists runs that it does not have yet
        chosen = {run.id for run in source}
        listed = replace(listed, runs=tuple(run for run in listed.runs if run.id in chosen))
    return source.runs, listed


def _put_run(group: h5py.Group, run: Run) -> None:
    specs = arrays_of(run.info)
    blocks = {name: _put_array(group, specs[name], array) for name, array in run.arrays.items()}
    document: dict[str, Any] = {ATTRIBUTE: to_json(run.info), "arrays": blocks}
    document |= {"sha256": checksum(document)}
    _put_document(group, RUN, json.dumps(document).encode())


def _put_array(group: h5py.Group, spec: ArraySpec, array: StoredArray) -> dict[str, Any]:
    """Write an array; returns its ``Blocks`` as JSON."""
    rows, columns = _chunk(spec, len(array))
    stored = group.create_dataset(
        check_name(spec.name, group.name),
        shape=array.shape,
        maxshape=(None, *spec.inner),  # an array of no rows can have chunks only if it could grow
        dtype=array.dtype.newbyteorder("<"),
        chunks=(rows, *columns),
        fillvalue=spec.fill,
        shuffle=True,
        compression="gzip",
        compression_opts=1,
        fletcher32=True,
    )
    for axis, name in enumerate(spec.dims):
        stored.dims[axis].label = name
    hashes = []
    for start, values in array.pieces(rows):
        stored[start : start + len(values)] = values
        hashes += [sha256(values[i : i + rows]) for i in range(0, len(values), rows)]
    return {"rows": rows, "sha256": hashes}


def _chunk(spec: ArraySpec, n: int) -> tuple[int, tuple[int, ...]]:
    """Return rows and columns of a chunk: about 4 MiB of whole rows, or a part of one row.

    Rows are not cut as they are in Zarr: a block is checked as a whole, so it must be small.
    """
    rows = max(1, min(n, PACKED_CHUNK_BYTES // max(1, row_bytes(spec))))
    return rows, part_of_row(spec.inner, PACKED_CHUNK_BYTES // np.dtype(spec.dtype).itemsize)


def _put_document(group: h5py.Group, name: str, content: bytes) -> None:
    if len(content) > MAX_METADATA_BYTES:
        raise FormatError(
            "the metadata is too large for an HDF5 file",
            expected=f"at most {MAX_METADATA_BYTES} bytes",
            got=len(content),
            where=f"{group.name} {name}",
            do="export fewer runs at a time, or keep the data set's folder",
        )
    group.create_dataset(name, data=np.bytes_(content))


def _import_run(run: Run, path: Path) -> None:
    info = run.info
    folder = path.with_name(path.name.removesuffix(PACKED))
    start = with_progress(info, status=info.status, time=0, iteration=0)
    live = LiveStore.create(folder, start)
    info = replace(info, block=live.info.block)
    for name, array in run.arrays.items():
        for first, values in array.pieces(live.chunk_rows(name)):
            live.write(name, first, values)
    live.commit(info)
    if folder != path:
        pack(folder, profile=info.profile, out=path)
        shutil.rmtree(folder)
