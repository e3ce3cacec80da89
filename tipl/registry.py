"""Every kind of forecaster: its class, how it is trained, how it is refitted, its command.

Loading, `tipl train`, the checks, cards and reports read this registry. A kind from outside joins
with ``register``, or by an entry point in the group ``tipl.kinds`` that names a ``Kind``::

    [project.entry-points."tipl.kinds"]
    mine = "my_package:KIND"

Classes and functions are named as ``module:name`` and imported when they are needed, so that a
list of models costs no import of torch.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tipl.errors import ForecastError, ModelError

if TYPE_CHECKING:
    from tipl.forecaster import Forecaster
else:  # importing it would import zarr, which a list of models does not need
    Forecaster = Any

GROUP = "tipl.kinds"
"""Group of entry points."""
MODELS = Path(__file__).parent / "zoo/models"
"""Folder of the released models, which come with the package."""
UNFITTED = "tipl.models.baselines.naive:UNFITTED"
"""The baselines that need no fit."""
MOST_CONFIG = 2**20
"""Largest size of config.json, in bytes."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """One kind of forecaster."""

    name: str
    """The ``kind`` in config.json of a saved one."""
    forecaster: str
    """Its class: ``module:Class``."""
    help: str = ""
    """What it is trained to do, in one line, for the help of ``tipl train``."""
    command: str | None = None
    """Word after ``tipl train``; unset: it is not trained, or together with another kind."""
    train: str | None = None
    """``module:function`` of (config, console) that trains it. The fields of ``config``, a
    dataclass, are the options of the command."""
    refit: str | None = None
    """``module:function`` of (forecaster, runs, RefitConfig) that fits a similar one to other runs,
    for the null check; unset: there is nothing to fit."""
    is_model: bool = False
    """Whether it is a model to be compared with baselines, and not a baseline."""


def register(kind: Kind) -> None:
    """Add a kind; one of the same name is replaced."""
    _KINDS[kind.name] = kind


def kinds() -> dict[str, Kind]:
    """Return all kinds by name, with those of installed packages."""
    for entry in entry_points(group=GROUP):
        if entry.name not in _SEEN:
            _SEEN.add(entry.name)
            register(entry.load())
    return dict(_KINDS)


def commands() -> dict[str, Kind]:
    """Return the kind that each ``tipl train`` command trains."""
    return {kind.command: kind for kind in kinds().values() if kind.command and kind.train}


def is_model(kind: str | None) -> bool:
    """Return whether forecasters of a kind are models and not baselines."""
    known = kinds().get(str(kind))
    return known is not None and known.is_model


def names() -> list[str]:
    """Return the names of the released models."""
    return sorted(file.parent.name for file in MODELS.glob("*/config.json"))


def unfitted() -> dict[str, Forecaster]:
    """Return the baselines that need no fit, by name."""
    return {forecaster.name: forecaster for forecaster in imported(UNFITTED)}


def load(name: str | Path, *, revision: str | None = None) -> Forecaster:
    """Load a forecaster by its folder, name, address or class.

    The name is looked up in this order: a folder, a model of the zoo, which comes with the package,
    a baseline that needs no fit, a class ``module:Class``, which is called without arguments. A
    model at an address, ``hf://org/name`` or ``s3://bucket/name``, is downloaded the first time.

    Args:
        name: folder, name, address or class.
        revision: branch, tag or commit of a model on the hub.

    Raises:
        ForecastError: there is no such folder, and no forecaster of this name.
        ModelError: the folder holds something else.
        FileNotFoundError: there is no model at the address.
        RemoteError: it cannot be downloaded.
    """
    text = str(name)
    if "://" in text:
        return _load_remote(text, revision)
    if (path := folder_of(name)) is not None:
        return load_folder(path)
    if text in (baselines := unfitted()):
        return baselines[text]
    if ":" in text:
        return _load_class(text)
    raise ForecastError(
        "there is no such forecaster",
        expected="a folder with config.json, module:Class, or one of "
        + ", ".join([*names(), *baselines]),
        got=text,
        do="name the folder that `tipl train` made, or see `tipl zoo`",
    )


def load_folder(folder: Path) -> Forecaster:
    """Load the forecaster that was saved in a folder."""
    forecaster: Forecaster = imported(kinds()[kind_in(folder)].forecaster).load(folder)
    return forecaster


def folder_of(name: str | Path) -> Path | None:
    """Return the folder of a forecaster, or of a model of the zoo; None: it is neither."""
    path = Path(name)
    if (path / "config.json").is_file():
        return path
    return MODELS / path if str(name) in names() else None


def kind_in(folder: Path) -> str:
    """Return the kind of the forecaster that a folder holds.

    Raises:
        ModelError: it holds none.
    """
    file = folder / "config.json"
    try:
        if not file.is_file():
            raise ValueError("config.json is no plain file")
        if (size := file.stat().st_size) > MOST_CONFIG:
            raise ValueError(f"config.json of {size:,} bytes")
        kind = str(json.loads(file.read_text(encoding="utf-8"))["kind"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise _no_forecaster(folder, error) from error
    if kind not in kinds():
        raise _no_forecaster(folder, kind)
    return kind


def imported(path: str) -> Any:
    """Return what ``module:name`` names."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def _load_remote(address: str, revision: str | None) -> Forecaster:
    from tipl.fetch import fetch

    folder, called = fetch(address, revision)
    found: Any = load_folder(folder)
    # A model is named after its folder; in a cache that is a hash.
    has_name = is_dataclass(found) and any(field.name == "name" for field in fields(found))
    return replace(found, name=called) if has_name else found  # type: ignore[no-any-return]


def _load_class(text: str) -> Forecaster:
    from tipl.forecaster import check_forecaster

    if (here := os.getcwd()) not in sys.path:  # as `python -m` does
        sys.path.insert(0, here)
    try:
        found = imported(text)
        forecaster = found() if isinstance(found, type) else found
    except Exception as error:  # a stranger's module may raise anything
        raise ForecastError(
            "the class cannot be loaded as a forecaster",
            expected="module:Class, a class that can be called without arguments",
            got=f"{text}: {type(error).__name__}: {error}",
            do="check the name, and that the module can be imported from this folder",
        ) from error
    check_forecaster(forecaster)
    return forecaster  # type: ignore[no-any-return]


def _no_forecaster(folder: Path, got: object) -> ModelError:
    return ModelError(
        "the folder holds no forecaster",
        expected=f'config.json with a "kind" of {sorted(kinds())}',
        got=got,
        where=folder,
        do="name a folder that `tipl train` or save() wrote",
    )


def _baseline(name: str, forecaster: str, refit: str | None = None) -> Kind:
    room = "tipl.models.baselines"
    refit = f"{room}.train:{refit}" if refit else None
    return Kind(name=name, forecaster=f"{room}.{forecaster}", refit=refit)


_SEEN: set[str] = set()
_KINDS: dict[str, Kind] = {}
for _kind in (
    Kind(
        name="tipl",
        forecaster="tipl.models.tipl.forecaster:TIPL",
        help="Train TIPL, the Transformer of the paper; hours.",
        command="tipl",
        train="tipl.models.tipl.train:train",
        refit="tipl.models.tipl.train:refit",
        is_model=True,
    ),
    Kind(
        name="gate",
        forecaster="tipl.models.gate.forecaster:Gate",
        help="Train tipl-gate, one network for all parameters; minutes.",
        command="gate",
        train="tipl.models.gate.train:train_gate",
        refit="tipl.models.gate.train:refit",
        is_model=True,
    ),
    Kind(
        name="causal",
        forecaster="tipl.models.causal.forecaster:Causal",
        help="Train tipl-causal, which uses only the past; minutes.",
        command="causal",
        train="tipl.models.causal.train:train_causal",
        refit="tipl.models.causal.train:refit",
        is_model=True,
    ),
    Kind(
        name="drift",  # the kind in saved files: the first was tipl-drift
        forecaster="tipl.models.stretched.forecaster:StretchedGate",
        help="Stretch a model's forecasts as returns say; minutes.",
        command="stretched",
        train="tipl.models.stretched.train:train_stretched",
        refit="tipl.models.stretched.train:refit",
        is_model=True,
    ),
    # The kind in saved files of stretched forecasters other than a gate.
    Kind(name="further", forecaster="tipl.models.stretched.forecaster:Stretched"),
    Kind(
        name="regression",
        forecaster="tipl.models.baselines.regression:Regression",
        help="Fit the baselines; minutes.",
        command="baselines",
        train="tipl.models.baselines.train:train_baselines",
        refit="tipl.models.baselines.train:refit_regression",
    ),
    _baseline("persistence", "naive:Persistence"),
    _baseline("path-oracle", "reconstruction:PathOracle"),
    _baseline("extrapolation", "naive:Extrapolation"),
    _baseline("dmd", "subspace:DMD"),
    _baseline("wnn", "nowcasters:WNN", "refit_nowcaster"),
    _baseline("nino-mlp", "nowcasters:NinoMLP", "refit_nowcaster"),
    _baseline("reconstruction", "reconstruction:Reconstruction"),
):
    register(_kind)
