"""A forecaster on disk: config.json, and its arrays as safetensors. Nothing is pickled."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from safetensors.torch import load_file as load_tensors
from torch import nn

from tipl.errors import ModelError

CONFIG = "config.json"
ARRAYS = "model.safetensors"

T = TypeVar("T")
N = TypeVar("N", bound=nn.Module)


def write(
    path: str | Path, config: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write a forecaster into a folder.

    Args:
        path: the folder; made if it is not there.
        config: JSON, with the ``kind`` of the forecaster.
        arrays: what was fitted; None: nothing.
    """
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    if arrays is not None:
        save_file({k: np.ascontiguousarray(v) for k, v in arrays.items()}, path / ARRAYS)
    (path / CONFIG).write_text(json.dumps(config, indent=1), encoding="utf-8")


def read_settings(path: str | Path, kind: str) -> dict[str, Any]:
    """What ``write`` wrote into config.json, without the kind.

    Raises:
        FileNotFoundError: there is no forecaster in the folder.
        ModelError: it is of another kind.
    """
    text = (Path(path) / CONFIG).read_bytes()
    try:
        settings = msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.DecodeError as error:
        raise broken(path, error) from error
    if (got := settings.pop("kind", None)) != kind:
        raise broken(path, f"a forecaster of kind {got!r}, not {kind!r}")
    return settings


def read_config(path: str | Path, kind: str, wanted: type[T]) -> T:
    """What ``write`` wrote into config.json, as a dataclass.

    Args:
        path: the folder.
        kind: of the forecaster that is asked for.
        wanted: the dataclass; its fields are those of the config, ``kind`` left out.

    Raises:
        FileNotFoundError: there is no forecaster in the folder.
        ModelError: it is of another kind, or its settings are not those of its kind.
    """
    try:
        return msgspec.convert(read_settings(path, kind), wanted)
    except msgspec.ValidationError as error:
        raise broken(path, error) from error


def read_arrays(path: str | Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """The arrays of a forecaster: these and no others, of these shapes, finite.

    Raises:
        FileNotFoundError: there are none.
        ModelError: they are damaged, or belong to something else.
    """
    try:
        arrays = load_file(Path(path) / ARRAYS)
    except SafetensorError as error:
        raise broken(path, error) from error
    got = {name: array.shape for name, array in arrays.items()}
    if got != dict(shapes):
        raise broken(path, f"arrays {got}, not {dict(shapes)}")
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise broken(path, "numbers that are not finite")
    return arrays


def load_network(network: N, path: str | Path) -> N:
    """A network with the parameters that lie in a folder: each must be there, and no other.

    Raises:
        FileNotFoundError: there are none.
        ModelError: they are damaged, or belong to something else.
    """
    try:
        network.load_state_dict(load_tensors(Path(path) / ARRAYS), strict=True)
    except (SafetensorError, RuntimeError) as error:
        raise broken(path, error) from error
    return network


def broken(path: str | Path, why: object) -> ModelError:
    """The error of a folder that holds no such forecaster."""
    return ModelError(
        "the forecaster cannot be loaded",
        expected="the files that its save() wrote",
        got=why,
        where=path,
        do="fit it again, or restore the folder from a copy",
    )


__all__ = [
    "ARRAYS",
    "CONFIG",
    "broken",
    "load_network",
    "read_arrays",
    "read_config",
    "read_settings",
    "write",
]
