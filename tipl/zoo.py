"""Forecasters by name or by folder."""

from __future__ import annotations

import json
from pathlib import Path

from tipl.baselines import Persistence, Reconstruction
from tipl.errors import ModelError
from tipl.forecast import TIPL, Forecaster

_KINDS: dict[str, type[Forecaster]] = {
    "tipl": TIPL,
    "persistence": Persistence,
    "reconstruction": Reconstruction,
}


def load(name: str | Path) -> Forecaster:
    """A forecaster: from the folder that it was saved in, or by the name of one without a fit.

    Raises:
        FileNotFoundError: there is no such folder, and no forecaster of this name.
        ModelError: the folder holds something else.
    """
    path = Path(name)
    if not (path / "config.json").is_file():
        if str(name) == Persistence.name:
            return Persistence()
        raise FileNotFoundError(f"no model at {name}: its folder has config.json")
    try:
        kind = json.loads((path / "config.json").read_text())["kind"]
        found = _KINDS[kind]
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(
            "the folder holds no forecaster",
            expected=f'config.json with a "kind" of {sorted(_KINDS)}',
            got=error,
            where=path,
            do="name a folder that `tipl train` or save() wrote",
        ) from error
    return found.load(path)


__all__ = ["load"]
