"""The data sets that are on this machine."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from weighttraj.errors import RegistryError
from weighttraj.format import DatasetInfo
from weighttraj.locate import clone, folders, locate
from weighttraj.opening import open_dataset
from weighttraj.store.catalog import DATASET, read_dataset_info
from weighttraj.store.objects import bytes_in


@dataclass(frozen=True)
class LocalDataset:
    """A data set in one of the folders that hold data sets."""

    id: str
    """What ``weighttraj.open`` takes: the name of its folder, ``namespace/id`` if it has one."""
    path: Path
    """Where it lies."""

    @cached_property
    def info(self) -> DatasetInfo:
        """Its list of runs.

        Raises:
            FormatError: it is damaged, or no data set of this format.
        """
        return read_dataset_info(self.path)

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return bytes_in(self.path)


def local_datasets() -> list[LocalDataset]:
    """Every data set that can be named by an id here; of two with one id the one that is found.

    See ``weighttraj.locate``: the folders of ``WEIGHTTRAJ_DATASETS_PATH``, the one for
    downloads, ``datasets`` of a clone, and ``data`` of the working directory.
    """
    found: dict[str, LocalDataset] = {}
    for folder in folders():
        for name in _names(folder):
            if name not in found and (path := _data(folder / name)) is not None:
                found[name] = LocalDataset(name, path)
    return sorted(found.values(), key=lambda dataset: dataset.id)


def find(name: str) -> LocalDataset:
    """Return a data set by its id here.

    Raises:
        FileNotFoundError: there is no such data set.
        RegistryError: the name is a path.
    """
    known = {dataset.id: dataset for dataset in local_datasets()}
    if name not in known:
        locate(name)  # says where was looked
        raise RegistryError(
            "only what has an id here can be deleted",
            expected=f"one of {sorted(known)}",
            got=name,
            do="remove a folder of your own yourself",
        )
    return known[name]


def delete(name: str) -> Path:
    """Remove a data set that is named by its id; of a clone's own nothing is removed.

    It gets a hidden name first, so that nobody opens a half of it. There is no way back. Of a data
    set in ``ID/data`` only ``data`` is removed: what lies beside it may be anything.

    Returns:
        Where it lay.

    Raises:
        FileNotFoundError: there is no such data set.
        RegistryError: the name is a path, the data set belongs to the clone or is a link.
    """
    path = find(name).path
    real = path.resolve()
    if (own := clone()) is not None and real.is_relative_to(own.resolve()):
        raise RegistryError(
            "the data sets of a clone are not deleted",
            where=path,
            do="they belong to the repository; delete the clone, if you must",
        )
    if path.is_symlink():
        raise RegistryError(
            "the data set is a link, and what a link leads to is not deleted",
            expected="a folder",
            got=f"a link to {real}",
            where=path,
            do="remove the link, or the folder, yourself",
        )
    if any(folder.resolve().is_relative_to(real) for folder in folders()):
        raise RegistryError(
            "other data sets have their ids in this folder, so it is not deleted as one",
            where=path,
            do="remove what you mean yourself",
        )
    open_dataset(path)  # a folder that only looks like a data set is left alone
    hidden = path.with_name(f".{path.name}.{secrets.token_hex(8)}.deleted")
    path.rename(hidden)
    shutil.rmtree(hidden)
    return path


def _names(folder: Path) -> Iterator[str]:
    """Yield folders in a folder, and those in them that are no data sets themselves."""
    for place in sorted(folder.iterdir()) if folder.is_dir() else ():
        if place.name.startswith(".") or not place.is_dir():
            continue
        if _data(place) is not None:
            yield place.name
            continue
        yield from (
            f"{place.name}/{inner.name}"
            for inner in sorted(place.iterdir())
            if inner.is_dir() and not inner.name.startswith(".")
        )


def _data(place: Path) -> Path | None:
    """Return where in a folder the data set lies, as ``locate`` finds it."""
    for path in (place, place / "data"):
        if (path / DATASET).is_file():
            return path
    return None
