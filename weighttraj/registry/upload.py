"""Publishes a data set: all of it or nothing, as readers see it, and never over another one."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TransferSpeedColumn

from weighttraj.dataset import Dataset
from weighttraj.errors import RegistryError
from weighttraj.locate import is_run, locate
from weighttraj.opening import open_dataset
from weighttraj.progress import LoggedProgress
from weighttraj.remote.address import RemotePath
from weighttraj.remote.hub import client, hub_error, pinned
from weighttraj.remote.store import MAX_DOCUMENT, RemoteStore, store_at
from weighttraj.remote.wait import for_each
from weighttraj.store.catalog import DATASET, MANIFEST, ManifestLine, read_manifest
from weighttraj.store.objects import read_plain
from weighttraj.tools.lint import lint
from weighttraj.tools.verify import verify

CLAIM = "UPLOADING.sha256"
"""Object that holds the manifest of what is being uploaded, for as long as it is."""
CARD = "README.md"


def upload(
    path: str | Path,
    address: str,
    *,
    despite_lint: bool = False,
    private: bool = False,
    console: Console | None = None,
) -> RemotePath:
    """Publish a data set, so that it can be opened and downloaded by an address.

    First it is verified, and looked at for what is suspicious. Readers see nothing of it until it
    is whole: on the hub it is one commit, with the tag ``v<version>``; elsewhere ``dataset.json``,
    which every reader begins with, is written last, after the manifest. Stopped at any moment, the
    same call goes on. What was published stays as it is: other data are another version (on the
    hub) or another address.

    Args:
        path: a complete data set on this machine, path or id, with a licence and a card that says
            how to cite it.
        address: ``hf://org/name``, ``s3://bucket/prefix``, ``gs://``, ``az://``, ``file://``.
        despite_lint: publish what looks suspicious; say why in the card.
        private: of a new repository on the hub: only its organisation sees it.
        console: where progress is shown; None: nowhere.

    Returns:
        Where it is.

    Raises:
        FileNotFoundError: there is no such data set.
        RegistryError: it is not fit to be published, other data are there or are being uploaded
            there, or nothing can be written there.
        RemoteError: the address cannot be reached.
    """
    place = RemotePath.parse(address)
    if is_run(here := locate(path)) and here.suffix != ".h5":
        raise RegistryError(
            "a run is published as a data set of one run, with a card",
            expected="a data set",
            got="one run",
            where=here,
            do=f"weighttraj create OUT {here}, then weighttraj card OUT, then upload OUT",
        )
    dataset = open_dataset(here)
    folder = Path(dataset.path)
    _check(dataset, folder, despite_lint)
    if place.scheme == "hf":
        return _upload_to_hub(dataset, folder, place, private)
    if place.scheme in ("http", "https"):
        raise RegistryError(
            "web servers can only be read from",
            expected="hf://, s3://, gs://, az:// or file://",
            got=address,
            do="copy the data set's folder to where the server finds it",
        )
    upload_folder(folder, place, last=DATASET, console=console)
    return place


def _check(dataset: Dataset, folder: Path, despite_lint: bool) -> None:
    """Whether a data set is fit to be published."""
    if folder.is_file() or dataset.info.status != "complete" or not dataset.info.licence:
        raise RegistryError(
            "only a complete data set with a licence can be published",
            expected="a folder, status complete, a licence such as CC-BY-4.0",
            got=f"status {dataset.info.status}, licence {dataset.info.licence!r}",
            where=folder,
            do="finish collecting it; name the licence in the recipe",
        )
    if not (folder / CARD).is_file():
        raise RegistryError(
            "a data set is published with a card that says what it is",
            expected=f"{CARD} in its folder",
            got="none",
            where=folder,
            do=f"weighttraj card {folder}",
        )
    text = read_plain(folder / CARD, MAX_DOCUMENT).decode(errors="replace")
    if re.search(r"^## Citation\s*$", text, re.MULTILINE) is None:
        raise RegistryError(
            "the card does not say how the data set is to be cited",
            expected=f"a section '## Citation' in {CARD}",
            got="none",
            where=folder,
            do="write one, or let `weighttraj card` make the card",
        )
    _check_documents(folder)
    if problems := verify(folder):
        raise RegistryError(
            "the data set is damaged",
            got="\n    ".join(problems[:5]),
            where=folder,
            do="weighttraj verify, then weighttraj repair",
        )
    if not despite_lint and (findings := [str(finding) for finding in lint(folder)]):
        raise RegistryError(
            "the data set looks suspicious",
            got="\n    ".join(findings[:5]),
            where=folder,
            do="correct it; if it is meant so, say so in the card and give --despite-lint",
        )


def _check_documents(folder: Path) -> None:
    """Refuse what no reader would take: what is published can be read."""
    files = [folder / name for name in (DATASET, MANIFEST)]
    sizes = {file.name: file.stat().st_size for file in files if file.is_file()}
    if too_large := {name: size for name, size in sizes.items() if size > MAX_DOCUMENT}:
        raise RegistryError(
            "a list of the data set is larger than readers take from an address",
            expected=f"at most {MAX_DOCUMENT} bytes",
            got=", ".join(f"{name}: {size}" for name, size in too_large.items()),
            where=folder,
            do="pack its runs (weighttraj pack), or publish it as several data sets",
        )


def upload_folder(
    folder: Path, place: RemotePath, *, last: str = MANIFEST, console: Console | None = None
) -> None:
    """Write the files that a folder's manifest lists as objects, then the manifest.

    A claim says whose they are until the last one is written.

    Args:
        folder: it has a manifest, ``weighttraj.store.catalog.write_manifest``.
        place: address; ``file://`` folders are made.
        last: the file that readers begin with, written last.
        console: where progress is shown; None: nowhere.

    Raises:
        RegistryError: other files are there, or are being uploaded there.
        RemoteError: the address cannot be reached.
    """
    if place.scheme == "file":
        _make_folder(Path(place.root.path))
    store, manifest = store_at(place.root), (folder / MANIFEST).read_bytes()
    claimed = store.write(CLAIM, manifest, new=True)
    if not claimed and (there := store.read(CLAIM)) is not None and there.content != manifest:
        raise RegistryError(
            "something else is being uploaded to this address, or was, when it was stopped",
            expected="nothing, or the same files",
            got=CLAIM,
            where=place,
            do="wait for it; if nobody goes on with it, remove what lies there, "
            f"{CLAIM} last, and upload again",
        )
    # Looked at when nobody else writes any more: before, another upload could have ended since.
    if store.size(last) is not None:
        there = store.read(MANIFEST)
        store.delete(CLAIM)
        if there is None or there.content != manifest:
            raise _immutable(place)
        return
    lines = [line for line in read_manifest(folder) if line.path != last]
    claim = None if claimed else store.stat(CLAIM)
    _send_all(store, folder, lines, claim and claim[1], console)
    for name in dict.fromkeys((MANIFEST, last)):
        store.write(name, folder / name)
    store.delete(CLAIM)


def _send_all(
    store: RemoteStore,
    folder: Path,
    lines: list[ManifestLine],
    since: datetime | None,
    console: Console | None,
) -> None:
    """Write files that did not come since the claim; None: all, whatever lies there."""
    columns = (TextColumn("upload"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with LoggedProgress(*columns, console=console) as progress:
        task = progress.add_task("upload", total=sum(line.size for line in lines))

        def send(line: ManifestLine) -> None:
            # An object is there as a whole or not at all; some servers' clocks count seconds.
            there = since and store.stat(line.path)
            if not (since and there and there[0] == line.size and there[1] > since):
                store.write(line.path, folder / line.path)
            progress.advance(task, line.size)

        for_each(lines, send)


def _upload_to_hub(dataset: Dataset, folder: Path, place: RemotePath, private: bool) -> RemotePath:
    hub, repo = client(), repository_of(place)
    api, kind, tag = hub.HfApi(), "dataset", f"v{dataset.info.version}"

    def asked(do: Callable[[], Any]) -> Any:
        try:
            return do()
        except (OSError, ValueError, RuntimeError) as error:  # the client's errors are such
            raise hub_error(error, str(place)) from error

    asked(lambda: api.create_repo(repo, repo_type=kind, private=private, exist_ok=True))
    before = pinned(place)
    there = store_at(before.root).read(MANIFEST)
    tags = [t.name for t in asked(lambda: api.list_repo_refs(repo, repo_type=kind)).tags]
    if there is None or there.content != (folder / MANIFEST).read_bytes():
        if tag in tags:
            raise _immutable(place.at(tag))
        # One commit: the client's upload_folder makes several of many files, and readers see them.
        lines = [line.path for line in read_manifest(folder)]
        names = {*lines, MANIFEST}
        old = asked(lambda: api.list_repo_files(repo, repo_type=kind, revision=before.commit))
        adds = [hub.CommitOperationAdd(name, folder / name) for name in sorted(names)]
        gone = [n for n in old if n.startswith(("runs/", "tables/")) and n not in names]
        asked(
            lambda: api.create_commit(
                repo,
                [*adds, *(hub.CommitOperationDelete(name) for name in gone)],
                repo_type=kind,
                commit_message=f"{dataset.info.id}, version {dataset.info.version}",
                parent_commit=before.commit,  # refused if another publisher was quicker
            )
        )
    now = pinned(place)
    if tag not in tags:
        asked(lambda: api.create_tag(repo, tag=tag, revision=now.commit, repo_type=kind))
    return now


def repository_of(place: RemotePath) -> str:
    """Return the repository of the hub that something is published in, ``organisation/name``.

    Raises:
        RegistryError: the address names a revision, or a folder in the repository.
    """
    if place.part or place.root.revision != "main":
        raise RegistryError(
            "on the hub one repository holds one data set or model, and main its latest version",
            expected=f"hf://{place.root.host}",
            got=place,
            do="leave the rest of the address out; versions become tags",
        )
    return place.root.host


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RegistryError(
            "the folder of this address cannot be made",
            got=error,
            where=path,
            do="correct the address or the permissions",
        ) from error


def _immutable(place: RemotePath) -> RegistryError:
    return RegistryError(
        "something else is published there, and what is published stays",
        expected="an address where nothing is, or the same files",
        got="another manifest",
        where=place,
        do="publish it under another version, or address",
    )
