"""A data set by its name, wherever it is."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection

from rich.console import Console

from weighttraj.dataset import Dataset
from weighttraj.errors import RegistryError
from weighttraj.locate import locate
from weighttraj.opening import open_dataset
from weighttraj.registry.download import download as fetch
from weighttraj.registry.download import home, name_of, source_of
from weighttraj.remote.address import RemotePath, below, is_remote

REMOTE = "WEIGHTTRAJ_REMOTE"
"""Environment variable: address below which data sets are looked for that are named by an id."""


def load_dataset(
    name: str,
    *,
    download: bool = False,
    runs: Collection[str] | None = None,
    revision: str | None = None,
    console: Console | None = None,
) -> Dataset:
    """A data set by its id or address: the one that is here, else downloaded if that is wanted.

    What was downloaded once is found without a network from then on.

    >>> load_dataset("hf://org/walker-ppo-v1", download=True)  # doctest: +SKIP

    Args:
        name: an id, a path or an address; an id that is not here is looked for below the address
            in ``WEIGHTTRAJ_REMOTE``.
        download: bring it here if it is not; otherwise an address is read from where it is.
        runs: ids of the runs that are wanted; None: all.
        revision: branch, tag or commit, of a data set on the hub.
        console: where progress is shown; None: nowhere.

    Raises:
        FileNotFoundError: it is neither here nor there.
        RegistryError: it has no such run, the address is none, or another revision is here.
        RemoteError: it is somewhere else, and cannot be reached.
    """
    if not is_remote(name):
        try:
            locate(name)
        except FileNotFoundError:
            base = os.environ.get(REMOTE)
            if base is None:
                raise FileNotFoundError(
                    f"no data set {name!r} here; set {REMOTE} to the address that has it, or name "
                    "its address: hf://organisation/name"
                ) from None
            name = below(base, name)
        else:
            return open_dataset(name, runs=runs, revision=revision)
    place = RemotePath.parse(name, revision)
    with contextlib.suppress(FileNotFoundError):
        return _downloaded(place, revision, runs)
    if download:
        return fetch(name, runs=runs, revision=revision, console=console)
    return open_dataset(place, runs=runs)


def _downloaded(place: RemotePath, revision: str | None, runs: Collection[str] | None) -> Dataset:
    """Return what was brought here from an address.

    Raises:
        FileNotFoundError: nothing was, or not these runs.
        RegistryError: it was another revision.
    """
    path = home() / name_of(place)
    source = source_of(path)
    if source is None or source.repository != place.repository:
        raise FileNotFoundError(path)
    if revision is not None and revision not in (source.revision, source.commit):
        raise RegistryError(
            "another revision of this data set is here",
            expected=revision,
            got=f"{source.revision or 'main'}, commit {source.commit}",
            where=path,
            do="weighttraj delete it, or download this one to a folder of its own (--out)",
        )
    dataset = open_dataset(path)
    if runs is None or {run.id for run in dataset} >= set(runs):
        return open_dataset(path, runs=runs)
    raise FileNotFoundError(path)
