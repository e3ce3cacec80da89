"""Runs as files for other programs: ``.npy`` and ``.csv``, safetensors."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from weighttraj.atomic import appearing
from weighttraj.errors import needs
from weighttraj.format.schema import to_json
from weighttraj.run import Run, StoredArray


def export_npy(run: Run, folder: str | Path) -> Path:
    """Write a run for programs that know numpy only.

    ``weights.npy`` is float32 (time, param); ``layout.csv`` says which columns are which parameter,
    in C order; ``snapshots.csv`` has one line a snapshot: counters, learning rate, diagnostics and
    the counts of the normalisers, in digits that read back as the same numbers. Every other array
    is a file of its own, such as ``obs_norm.mean.npy``; ``run.json`` is the run's metadata.

    Returns:
        The folder.

    Raises:
        StoreExistsError: the folder exists.
        DamageError: the run is damaged.
    """
    folder = Path(folder)
    with appearing(folder) as draft:
        draft.mkdir()
        for name, array in run.arrays.items():
            if array.dims != ("time",):
                file = "weights" if name == "policy/weights" else name.replace("/", ".")
                _write_npy(draft / f"{file}.npy", array)
        params = [
            (p.name, "x".join(map(str, p.shape)), p.offset, p.size, p.role)
            for p in run.layout.params
        ]
        _write_csv(draft / "layout.csv", ("name", "shape", "offset", "size", "role"), params)
        columns = {"t": list(range(len(run))), **_scalars(run)}
        _write_csv(draft / "snapshots.csv", columns, zip(*columns.values(), strict=True))
        (draft / "run.json").write_text(json.dumps(to_json(run.info), indent=1), encoding="utf-8")
    return folder


def export_safetensors(run: Run, t: int, path: str | Path) -> Path:
    """Write one snapshot as a safetensors file.

    Each parameter is a float32 tensor under its own name; the normalisers' statistics are float64
    tensors under the names they have in the run, ``obs_norm/mean`` and so on. The metadata are
    strings: ``run_id``, ``t``, ``num_timesteps``, ``env_id`` (empty: not recorded), and as JSON
    ``policy`` and ``obs_norm``, what is fixed about them.

    Args:
        run: the run.
        t: the snapshot; negative ones count from the end.
        path: file to be written.

    Returns:
        The file.

    Raises:
        StoreExistsError: the path exists.
        IndexError: there is no such snapshot.
        MissingExtraError: safetensors is not installed.
    """
    with needs("files"):
        from safetensors.numpy import save
    path, info = Path(path), run.info
    tensors = dict(run.layout.unflatten(run.weights[t]))
    for group, stats in (("obs_norm", run.obs_norm(t)), ("ret_norm", run.ret_norm(t))):
        if stats is not None:
            moments = {"mean": stats.mean, "var": stats.var, "count": stats.count}
            tensors |= {f"{group}/{k}": np.asarray(v, np.float64) for k, v in moments.items()}
    metadata = {
        "run_id": run.id,
        "t": str(range(len(run))[t]),
        "num_timesteps": str(run["index/num_timesteps"][t]),
        "env_id": info.env.id if info.env else "",
        "policy": json.dumps(asdict(info.policy)),
        "obs_norm": json.dumps(asdict(info.obs_norm) if info.obs_norm else None),
    }
    with appearing(path) as draft:
        draft.write_bytes(save(tensors, metadata=metadata))
    return path


def _write_npy(file: Path, array: StoredArray) -> None:
    dtype = array.dtype.newbyteorder("<")
    if 0 in array.shape:  # there is nothing to map
        np.save(file, np.empty(array.shape, dtype))
        return
    target = np.lib.format.open_memmap(file, "w+", dtype, array.shape)
    for start, rows in array.pieces():
        target[start : start + len(rows)] = rows
    target.flush()


def _scalars(run: Run) -> dict[str, list[Any]]:
    """Every array with one number a snapshot; names that numpy's ``genfromtxt`` leaves alone."""
    return {
        name.removeprefix("index/").replace("/", "_"): array[:].tolist()
        for name, array in run.arrays.items()
        if array.dims == ("time",)
    }


def _write_csv(file: Path, header: Iterable[str], lines: Iterable[Iterable[Any]]) -> None:
    with file.open("w", newline="", encoding="utf-8") as text:
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(lines)
