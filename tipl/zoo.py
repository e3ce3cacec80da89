"""Forecasters by name or by folder."""

from __future__ import annotations

import json
from pathlib import Path

from tipl import baselines
from tipl.errors import ModelError
from tipl.forecast import TIPL, Forecaster

_KINDS: dict[str, type[Forecaster]] = {"tipl": TIPL, **baselines.KINDS}


def load(name: str | Path) -> Forecaster:
    """A forecaster: from the folder that it was saved in, or by the name of one without a fit.

    Raises:
        ForecastError: there is no such folder, and no forecaster of this name.
        ModelError: the folder holds something else.
    """
    path = Path(name)
    if not (path / "config.json").is_file():
        return baselines.by_name(str(name))
    try:
        kind = json.loads((path / "config.json").read_text())["kind"]
        found = _KINDS[kind]
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(
            "the folder holds no forecaster",
            expected=f'config.json with a "kind" of {sorted(_KINDS)}',
            got=error,
            where=path,
            do="name a folder that `tipl train`, `tipl fit` or save() wrote",
        ) from error
    return found.load(path)


__all__ = ["load"]
