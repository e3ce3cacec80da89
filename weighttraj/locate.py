"""Where a data set lies that is named by its id."""

from __future__ import annotations

import os
import re
from pathlib import Path

from weighttraj.remote.address import Place, here

VARIABLE = "WEIGHTTRAJ_DATASETS_PATH"
"""Environment variable: folders that hold data sets, as in PATH."""
HOME = "~/.weighttraj/datasets"
"""Where data sets are kept if the variable names no folder."""
COLLECTED = "data"
"""Where data sets are collected, below the working directory."""

_ID = re.compile(r"([^/\0.][^/\0]{0,199}/)?[^/\0.][^/\0]{0,199}")
"""What can be an id here: the name of a folder, or of one in another, that is not hidden."""


def locate(path: str | Place) -> Path:
    """Return the path of a data set: the path itself, or where the data set of an id lies.

    A folder that is no data set but holds one in ``data``, as ``datasets/<id>`` of a clone does,
    stands for that one.

    An id, with a namespace or without, is looked for in the folders of
    ``WEIGHTTRAJ_DATASETS_PATH``, or else in ``~/.weighttraj/datasets``, then in ``datasets`` of the
    clone that this package was installed from, then in ``data`` of the working directory, where
    data sets are collected. There, ``<id>`` or ``<id>/data`` is the data set.

    Raises:
        FileNotFoundError: the id is in none of them.
        RegistryError: it is an address, and what is asked for needs files on this machine.
    """
    name = str(path)
    path = here(path)
    if path.exists() or _ID.fullmatch(name) is None or name.endswith(".h5"):
        inner = path / "data"
        outer = (path / "dataset.json").is_file() or (path / "zarr.json").is_file()
        return inner if not outer and (inner / "dataset.json").is_file() else path
    places = [folder / name / part for folder in folders() for part in ("", "data")]
    for place in places:
        if (place / "dataset.json").is_file():
            return place
    looked = ", ".join(str(folder) for folder in folders())
    raise FileNotFoundError(
        f"no data set or run at {name}, and none of that id in {looked}; "
        f"set {VARIABLE} to the folders that hold your data sets"
    )


def is_run(path: Path) -> bool:
    """Return whether a run lies at a path: a folder, a packed file, or a folder that was packed."""
    packed = path.with_name(f"{path.name}.zip") if path.name else path
    named = path.name.endswith(".zarr") and packed.is_file() and not path.exists()
    return path.is_file() or (path / "zarr.json").is_file() or named


def folders() -> list[Path]:
    """Return folders in which data sets are looked for, the first one first."""
    named = [name for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]
    own = clone()
    return [*map(_expanded, named or _home()), *([own] if own else []), Path(COLLECTED)]


def _home() -> list[str]:
    """The folder that is used where the variable names none; nothing: the user has no home."""
    return [HOME] if os.path.expanduser("~") != "~" else []


def _expanded(name: str) -> Path:
    return Path(os.path.expanduser(name))


def clone() -> Path | None:
    """``datasets`` of the clone that this package was installed from; None: from no clone."""
    place = Path(__file__).parents[1] / "datasets"
    return place if place.is_dir() else None
