"""New data sets, of runs or of other data sets. These stay; the weights' bytes are copied."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

from weighttraj.atomic import appearing
from weighttraj.dataset import Dataset
from weighttraj.errors import FormatError, RegistryError, WeightTrajError
from weighttraj.format import DatasetInfo, RunEntry
from weighttraj.locate import locate
from weighttraj.opening import open_dataset, open_run
from weighttraj.progress import LoggedProgress
from weighttraj.run import Run
from weighttraj.store.catalog import write_dataset_info
from weighttraj.store.zarr_run import PACKED
from weighttraj.tools.pack import copy_packed, pack
from weighttraj.tools.repair import seal

SPLITS = ("train", "validation", "test")
"""Parts of a data set."""


def create(
    runs: Sequence[str | Path],
    out: str | Path,
    *,
    splits: Mapping[str, str] | None = None,
    name: str | None = None,
    version: str = "1",
    licence: str = "CC-BY-4.0",
    console: Console | None = None,
) -> Dataset:
    """Make a data set of finished runs, wherever they come from.

    Args:
        runs: paths of runs, folders or packed ones, each of its own id.
        out: folder of the new data set.
        splits: ``train``, ``validation`` or ``test`` for ids of runs; others are in no part.
        name: its id; None: the folder's name.
        version: version of the data.
        licence: of the data, as an SPDX identifier.
        console: where progress is shown; None: nowhere.

    Raises:
        FileNotFoundError: there is no run at a path.
        RegistryError: a run is not complete, two have one id, or a split is of no run or none.
        StoreExistsError: the folder exists.
    """
    if isinstance(runs, str | Path) or not isinstance(out, str | Path):
        raise RegistryError(
            "the arguments are in the wrong order, or the runs are not in a list",
            expected='create(["a.zarr", "b.zarr"], "out"): a list of paths of runs, then a folder',
            got=f"create({runs!r}, {out!r})",
            do="give the runs first, in a list",
        )
    opened, wanted = [open_run(path) for path in runs], dict(splits or {})
    ids = Counter(run.id for run in opened)
    unfinished = [run.id for run in opened if run.info.status != "complete"]
    if not opened or max(ids.values()) > 1 or unfinished:
        raise RegistryError(
            "these runs make no data set",
            expected="complete runs, each of its own id",
            got=f"{', '.join(run.id for run in opened) or 'none'}; not complete: {unfinished}",
            do="finish them, and give each a run_id of its own",
        )
    if wanted.keys() - ids.keys() or set(wanted.values()) - {*SPLITS}:
        raise RegistryError(
            "the parts are not those of these runs",
            expected=f"{', '.join(SPLITS)} for some of {', '.join(ids)}",
            got=wanted,
            do="correct splits",
        )
    chosen = {run.id: (run, wanted.get(run.id, "")) for run in opened}
    info = DatasetInfo(id=name or Path(out).name, version=version, licence=licence)
    return _write(Path(out), info, chosen, console)


def combine(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    name: str | None = None,
    console: Console | None = None,
) -> Dataset:
    """Make one data set of the runs of several, each in the split that it is in.

    Where two runs have one id, every run gets the id of its data set before its own:
    ``walker-ppo-v1.seed0000``.

    Args:
        paths: data sets: paths or ids; complete ones.
        out: folder of the new one.
        name: its id; None: the folder's name.
        console: where progress is shown; None: nowhere.

    Raises:
        RegistryError: there are less than two, one is not complete, or two have the same id or
            different licences.
        StoreExistsError: the folder exists.
    """
    datasets = [_complete(path) for path in paths]
    ids = Counter(dataset.info.id for dataset in datasets)
    licences = {dataset.info.licence for dataset in datasets}
    if len(datasets) < 2 or max(ids.values()) > 1 or len(licences) > 1:
        raise RegistryError(
            "these data sets cannot be one",
            expected="two or more, of different ids and the same licence",
            got=", ".join(f"{d.info.id} ({d.info.licence})" for d in datasets),
            do="leave one out; what may not be published together stays apart",
        )
    counts = Counter(run.id for dataset in datasets for run in dataset)
    clash = max(counts.values(), default=0) > 1
    chosen = {
        (f"{dataset.info.id}.{run.id}" if clash else run.id): (run, run.split)
        for dataset in datasets
        for run in dataset
    }
    source = {"combined": [{"id": d.info.id, "version": d.info.version} for d in datasets]}
    info = DatasetInfo(id=name or Path(out).name, licence=licences.pop(), recipe=source)
    return _write(Path(out), info, chosen, console)


def select(
    path: str | Path,
    out: str | Path,
    *,
    seeds: Sequence[int],
    console: Console | None = None,
) -> Dataset:
    """Make a data set of some finished runs of another one: a part that can be published alone.

    The part keeps id, version, splits and recipe, and its recipe says that it is a part. The other
    runs may still be in collection.

    Args:
        path: data set: path or id.
        out: folder of the new one.
        seeds: of the runs that are wanted.
        console: where progress is shown; None: nowhere.

    Raises:
        RegistryError: if a seed has no run, or its run is not complete.
        StoreExistsError: if the folder exists.
    """
    dataset = open_dataset(locate(path))
    known = {run.info.seed: run for run in dataset if run.info.status == "complete"}
    missing = [seed for seed in seeds if seed not in known]
    if missing or not seeds:
        raise RegistryError(
            "the data set has no complete runs of these seeds",
            expected=f"seeds among {sorted(seed for seed in known if seed is not None)}",
            got=missing or "no seeds",
            where=dataset.path,
            do="collect them first, or choose others",
        )
    chosen = {known[seed].id: (known[seed], known[seed].split) for seed in dict.fromkeys(seeds)}
    part = {
        "id": dataset.info.id,
        "version": dataset.info.version,
        "runs": f"{len(chosen)} of {len(dataset.info.runs)}",
    }
    info = replace(dataset.info, recipe={**dataset.info.recipe, "part": part})
    return _write(Path(out), info, chosen, console)


def split(
    path: str | Path,
    out: str | Path,
    *,
    fractions: tuple[float, float, float] = (0.6, 0.2, 0.2),
    seed: int = 0,
    name: str | None = None,
    console: Console | None = None,
) -> Dataset:
    """Divide the runs of a data set again into training, validation and test, by run.

    Args:
        path: data set: path or id; a complete one.
        out: folder of the new one.
        fractions: of the runs, in this order; of a part above 0 there is one run at least.
        seed: of the draw.
        name: its id; None: the folder's name.
        console: where progress is shown; None: nowhere.

    Raises:
        RegistryError: the data set is not complete, the fractions do not sum to 1, or there are
            fewer runs than parts.
        StoreExistsError: the folder exists.
    """
    dataset = _complete(path)
    parts = _parts(len(dataset), fractions)
    order = np.random.default_rng(seed).permutation(len(dataset))
    of_run = {int(run): part for run, part in zip(order, parts, strict=True)}
    chosen = {run.id: (run, of_run[number]) for number, run in enumerate(dataset)}
    source = {
        "split": {
            "id": dataset.info.id,
            "version": dataset.info.version,
            "fractions": list(fractions),
            "seed": seed,
        }
    }
    info = DatasetInfo(id=name or Path(out).name, licence=dataset.info.licence, recipe=source)
    return _write(Path(out), info, chosen, console)


def _complete(path: str | Path) -> Dataset:
    dataset = open_dataset(locate(path))
    hdf5 = Path(dataset.path).suffix == ".h5"
    if dataset.info.status != "complete" or hdf5:
        raise RegistryError(
            "only a complete data set in a folder can be made into another one",
            expected="status complete",
            got="an HDF5 file" if hdf5 else dataset.info.status,
            where=dataset.path,
            do="finish collecting it, or import the file first",
        )
    return dataset


def _parts(count: int, fractions: Sequence[float]) -> list[str]:
    """Return a part for each run, as close to the fractions as whole runs allow."""
    wanted = np.asarray(fractions, float)
    if (wanted < 0).any() or abs(wanted.sum() - 1) > 1e-6 or count < (wanted > 0).sum():
        raise RegistryError(
            "the runs cannot be divided so",
            expected=f"fractions that sum to 1, and a run for each part; there are {count} runs",
            got=tuple(fractions),
            do="give other --fractions",
        )
    sizes = (wanted > 0).astype(int)
    while sizes.sum() < count:
        sizes[int((wanted * count - sizes).argmax())] += 1  # what lacks most
    return [part for part, size in zip(SPLITS, sizes, strict=True) for _ in range(size)]


def _write(
    out: Path,
    info: DatasetInfo,
    chosen: Mapping[str, tuple[Run, Any]],
    console: Console | None,
) -> Dataset:
    """Copy the runs beside the place, then rename: half a data set has a hidden name."""
    columns = (TextColumn("runs"), BarColumn(), MofNCompleteColumn())
    try:
        with appearing(out) as draft:
            (draft / "runs").mkdir(parents=True)
            entries = []
            with LoggedProgress(*columns, console=console) as progress:
                for new, (run, part) in progress.track(chosen.items()):
                    entry = RunEntry(
                        id=new, path=f"runs/{new}.zarr{PACKED}", seed=run.info.seed, split=part
                    )
                    _copy(run, draft / entry.path, new)
                    entries.append(entry)
            write_dataset_info(draft, replace(info, runs=tuple(entries), status="complete"))
            seal(draft)
    except OSError as error:
        if isinstance(error, WeightTrajError):
            raise
        raise FormatError(
            "the data set could not be written; nothing was left behind",
            got=error,
            where=out,
            do="make room, or choose another place, and give the command again",
        ) from error
    return open_dataset(out)


def _copy(run: Run, target: Path, run_id: str) -> None:
    """Byte for byte where the id stays; with other metadata where it does not."""
    path = Path(run.path)
    packed = path if path.is_file() else pack(path, out=target)
    if run_id != run.id:
        copy_packed(packed, target, run_id)
    elif packed != target:
        shutil.copyfile(packed, target)
