"""Downloads models that are published at an address."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from weighttraj.registry.download import download_folder
from weighttraj.remote import RemotePath, hub

FILES = ("*.json", "*.safetensors", "README.md")
"""Files of a repository on the hub that are downloaded; others are ignored."""
VARIABLE = "WEIGHTTRAJ_MODELS_PATH"
"""Environment variable: folder for models from object stores. Default: ~/.weighttraj/models."""


def fetch(address: str, revision: str | None = None) -> tuple[Path, str]:
    """Return the folder of a model at an address, and its name; it is downloaded once.

    Raises:
        FileNotFoundError: there is no model at the address.
        RegistryError: it is no address.
        RemoteError: the address cannot be reached.
    """
    place = RemotePath.parse(address, revision, kind="models")
    if place.scheme != "hf":
        home = Path(os.environ.get(VARIABLE, "~/.weighttraj/models")).expanduser()
        folder = home / hashlib.sha256(place.repository.encode()).hexdigest()[:16] / place.name
        if not folder.is_dir():  # one that exists is complete, and published models never change
            folder.parent.mkdir(parents=True, exist_ok=True)
            download_folder(place, folder, needed=["config.json"])
        return folder, place.name
    root = place.root
    try:
        found = hub.client().snapshot_download(
            root.host, revision=root.revision, allow_patterns=[*FILES]
        )
    except (OSError, ValueError, RuntimeError) as error:  # the client's errors are such
        raise hub.hub_error(error, address) from error
    return Path(found), place.name
