"""Where a forecaster of a name lies, and which class reads it."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from tipl import baselines
from tipl.causal import Causal
from tipl.drift import Drift, Further
from tipl.errors import ForecastError, ModelError
from tipl.forecast import TIPL, Forecaster
from tipl.gate import Gate

MODELS = Path(__file__).with_name("models")
"""A folder for each released model; they come with the package."""
KINDS: dict[str, type[Forecaster]] = {
    "tipl": TIPL,
    Gate.kind: Gate,
    Causal.kind: Causal,
    Drift.kind: Drift,
    Further.kind: Further,
    **baselines.KINDS,
}
"""The class of each ``kind`` that config.json of a saved forecaster may name."""


def names() -> list[str]:
    """The released models."""
    return sorted(file.parent.name for file in MODELS.glob("*/config.json"))


def load(name: str | Path, *, revision: str | None = None) -> Forecaster:
    """A forecaster: from the folder that it was saved in, or a released one by its name.

    Looked for in this order: a folder, a model of the zoo, a baseline that needs no fit. A released
    model is part of the package: nothing is downloaded. One at an address, ``hf://org/name`` or
    ``s3://bucket/name``, is downloaded the first time.

    Args:
        name: folder, name or address.
        revision: branch, tag or commit, of a model on the hub.

    Raises:
        ForecastError: there is no such folder, and no forecaster of this name.
        ModelError: the folder holds something else.
        FileNotFoundError: there is no model at the address.
        RemoteError: it cannot be had from its address.
    """
    if "://" in str(name):
        from tipl.zoo.remote import fetch

        folder, called = fetch(str(name), revision)
        forecaster: Any = KINDS[kind_of(folder)].load(folder)
        named: Forecaster = (
            replace(forecaster, name=called) if _has_a_name(forecaster) else forecaster
        )
        return named
    if (path := folder_of(name)) is not None:
        return KINDS[kind_of(path)].load(path)
    if str(name) in baselines.names():
        return baselines.by_name(str(name))
    raise ForecastError(
        "there is no such forecaster",
        expected="a folder with config.json, or one of "
        + ", ".join([*names(), *baselines.names()]),
        got=str(name),
        do="name the folder that `tipl train` or `tipl fit` made, or see `tipl zoo`",
    )


def folder_of(name: str | Path) -> Path | None:
    """Where a forecaster lies: a folder, or else a model of the zoo; None: neither."""
    path = Path(name)
    if (path / "config.json").is_file():
        return path
    return MODELS / path if str(name) in names() else None


def _has_a_name(forecaster: Any) -> bool:
    """Whether it is named after its folder, as all are but for those that there is one of."""
    return any(field.name == "name" for field in fields(forecaster))


def kind_of(folder: Path) -> str:
    """The kind of the forecaster that a folder holds.

    Raises:
        ModelError: it holds none.
    """
    try:
        kind = str(json.loads((folder / "config.json").read_text(encoding="utf-8"))["kind"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _nothing(folder, error) from error
    if kind not in KINDS:
        raise _nothing(folder, kind)
    return kind


def _nothing(folder: Path, got: object) -> ModelError:
    return ModelError(
        "the folder holds no forecaster",
        expected=f'config.json with a "kind" of {sorted(KINDS)}',
        got=got,
        where=folder,
        do="name a folder that `tipl train`, `tipl fit` or save() wrote",
    )


__all__ = ["KINDS", "MODELS", "folder_of", "kind_of", "load", "names"]
