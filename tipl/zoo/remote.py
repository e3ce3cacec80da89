"""Publishes models at an address, on the Hugging Face hub or in an object store.

One address holds one model: ``config.json``, ``safetensors`` and a card. Nothing there is code, and
nothing is unpickled.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from tipl import registry
from tipl.errors import ForecastError
from tipl.forecaster import Forecaster
from tipl.zoo.card import write_card
from weighttraj.registry.upload import repository_of, upload_folder
from weighttraj.remote import RemotePath, hub
from weighttraj.store.catalog import write_manifest


def push(
    model: Forecaster | str | Path,
    address: str,
    *,
    private: bool = False,
    card: Path | None = None,
) -> str:
    """Publish a model, whole or not at all.

    Args:
        model: a forecaster, the folder of a saved one, or the name of a released one.
        address: ``hf://org/name``, or an empty place in an object store: ``s3://bucket/name``.
        private: whether only the organisation sees a new repository on the hub.
        card: a Markdown file; None: the card of a released model, else README.md in the folder.

    Returns:
        The address; on the hub with the commit that it is now.

    Raises:
        ForecastError: there is no such forecaster, or it has no card.
        RegistryError: it is no address, or another model is published there.
        RemoteError: it cannot be reached, or refuses.
    """
    place = RemotePath.parse(address, kind="models")
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "model"
        _write(model, written, card)
        if place.scheme == "hf":
            return _push_to_hub(written, place, private)
        write_manifest(written)
        upload_folder(written, place)
        return str(place)


def _push_to_hub(folder: Path, place: RemotePath, private: bool) -> str:
    client, repo = hub.client(), repository_of(place)
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    try:
        api = client.HfApi()
        api.create_repo(repo, private=private, exist_ok=True)
        adds = [
            client.CommitOperationAdd(file.relative_to(folder).as_posix(), file) for file in files
        ]
        info = api.create_commit(repo, adds, commit_message=place.name)
    except (OSError, ValueError, RuntimeError) as error:
        raise hub.hub_error(error, str(place)) from error
    return str(place.at(info.oid))


def _write(model: Forecaster | str | Path, out: Path, card: Path | None) -> None:
    """Write the files of a model and its card, as they are published."""
    folder = registry.folder_of(model) if isinstance(model, str | Path) else None
    released = folder is not None and folder.parent == registry.MODELS
    if folder is not None and released:
        shutil.copytree(folder, out)
    else:  # only the model: state, log and settings of a training stay on this machine
        forecaster = registry.load(model) if isinstance(model, str | Path) else model
        forecaster.save(out)
    if card is None and folder is not None and released:
        card = Path(__file__).parents[2] / "cards/models" / f"{folder.name}.md"
        if not card.is_file():  # only a clone has those with prose by hand
            card = write_card(folder.name, out.with_name("cards"))
    if card is None and folder is not None and (folder / "README.md").is_file():
        card = folder / "README.md"
    if card is not None:
        shutil.copyfile(card, out / "README.md")
    if not (out / "README.md").is_file():
        raise ForecastError(
            "a model is published with a card that says what it is",
            expected="--card FILE, or README.md beside the model",
            got="none",
            where=model if isinstance(model, str | Path) else type(model).__name__,
            do="write one: what it forecasts, what it was trained on, its figures, its limits",
        )
