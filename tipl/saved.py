"""A forecaster on disk: config.json, and its arrays as safetensors. Nothing is pickled.

The files may come from strangers. So sizes are compared with the header of the arrays before
anything of these sizes is allocated, and numbers that are not finite are refused.
"""

from __future__ import annotations

import hashlib
import json
import stat
import tempfile
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from math import prod
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import msgspec
import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from safetensors.torch import load_file as load_tensors
from torch import Tensor, nn

from tipl.errors import ModelError
from tipl.forecaster import Forecaster
from weighttraj.atomic import replace_file

CONFIG = "config.json"
ARRAYS = "model.safetensors"
MOST_CONFIG = 2**20
"""Largest size of config.json, in bytes."""
LEAST_SIZE = 10_000
"""Sizes up to this are allowed in the config of any network, however few parameters it has."""

T = TypeVar("T")
N = TypeVar("N", bound=nn.Module)
C = TypeVar("C")
F = TypeVar("F", bound="SavedSettings")
S = TypeVar("S", bound="SavedNetwork[Any, Any]")


@dataclass(frozen=True, kw_only=True)
class ModelConfig(Generic[C]):
    """What a saved network says of itself."""

    network: C
    """Sizes of the network."""
    every: int | None
    """Gradient steps from one snapshot to the next in the training runs."""


@dataclass(frozen=True, eq=False)
class SavedNetwork(Forecaster, Generic[N, C]):
    """Base of the forecasters that are a network and its config."""

    network: N
    """The network."""
    config: C
    """Its sizes, and the cadence of the runs that it is for."""
    name: str = ""
    """Name in tables and figures: the name of its folder."""
    config_type: ClassVar[type]
    """The class of ``config``."""

    @classmethod
    @abstractmethod
    def build(cls, config: C) -> N:
        """Return an untrained network of these sizes."""

    def document(self) -> dict[str, Any]:
        """Return what config.json says."""
        return {"kind": self.kind, **asdict(self.config)}  # type: ignore[call-overload]

    def save(self, path: str | Path) -> None:
        """Write config.json and model.safetensors."""
        write(path, self.document(), arrays_of(self.network))

    @classmethod
    def load(cls: type[S], path: str | Path) -> S:
        """Read a saved forecaster; every parameter must be there."""
        config: Any = read_config(path, str(cls.kind), cls.config_type)
        network = load_network(lambda: cls.build(config), config, path)
        return cls(network, config, Path(path).resolve().name)


@dataclass(frozen=True)
class SavedSettings(Forecaster):
    """Base of the forecasters that are their settings, the fields: nothing is fitted."""

    def save(self, path: str | Path) -> None:
        """Write config.json."""
        write(path, {"kind": self.kind, **asdict(self)})

    @classmethod
    def load(cls: type[F], path: str | Path) -> F:
        """Read the settings."""
        return read_config(path, str(cls.kind), cls)


def write(
    path: str | Path, config: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write a forecaster into a folder: its arrays, if any, then its config, with its ``kind``.

    Each file is replaced at once: if the process is killed, the old one is still there, whole.
    """
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    if arrays is not None:
        replace_file(path / ARRAYS, save({k: np.ascontiguousarray(v) for k, v in arrays.items()}))
    replace_file(path / CONFIG, json.dumps(config, indent=1).encode())


def arrays_of(network: nn.Module) -> dict[str, np.ndarray]:
    """Return the parameters and buffers of a network by name."""
    return {name: tensor.numpy(force=True) for name, tensor in network.state_dict().items()}


def read_config(path: str | Path, kind: str, wanted: type[T]) -> T:
    """Return what ``write`` wrote into config.json, without the kind, as a dataclass.

    Raises:
        FileNotFoundError: there is no forecaster in the folder.
        ModelError: it is of another kind, or its settings are not those of its kind.
    """
    file = Path(path) / CONFIG
    check_plain(file)
    if file.stat().st_size > MOST_CONFIG:
        raise broken(path, f"{CONFIG} of {file.stat().st_size:,} bytes")
    try:
        settings = msgspec.json.decode(file.read_bytes(), type=dict[str, Any])
        if (got := settings.pop("kind", None)) != kind:
            raise broken(path, f"a forecaster of kind {got!r}, not {kind!r}")
        return msgspec.convert(settings, wanted)
    except (msgspec.DecodeError, RecursionError) as error:
        raise broken(path, error) from error


def read_arrays(path: str | Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Return the arrays of a forecaster: these and no others, of these shapes, finite.

    Raises:
        FileNotFoundError: there are none.
        ModelError: they are damaged, or belong to something else.
    """
    if (got := header_of(path)) != dict(shapes):
        raise broken(path, f"arrays {got}, not {dict(shapes)}")
    try:
        return {name: tensor.numpy() for name, tensor in _tensors(path).items()}
    except TypeError as error:  # types that NumPy lacks
        raise broken(path, error) from error


def load_network(build: Callable[[], N], config: Any, path: str | Path) -> N:
    """Return a network with the parameters in a folder: these and no others.

    Args:
        build: makes a network of the sizes in the config.
        config: what config.json says; a dataclass.
        path: the folder.

    Raises:
        FileNotFoundError: there are none.
        ModelError: they are damaged, belong to something else, or are not finite.
    """
    header = header_of(path)
    _check_sizes(config, header, path)
    try:
        with torch.device("meta"):  # shapes only: nothing is allocated
            shapes = {name: tuple(t.shape) for name, t in build().state_dict().items()}
    except Exception as error:  # torch raises anything at impossible sizes
        raise broken(path, error) from error
    if shapes != header:
        raise broken(path, _difference(shapes, header))
    tensors = _tensors(path)
    try:
        with torch.random.fork_rng(devices=[]):  # leaves the caller's random numbers alone
            network = build()
        network.load_state_dict(tensors, strict=True)
        network.eval()
    except RuntimeError as error:
        raise broken(path, error) from error
    return network


def _tensors(path: str | Path) -> dict[str, Tensor]:
    """Return the arrays in a folder, all of them finite."""
    try:
        tensors = load_tensors(Path(path) / ARRAYS)
    except (SafetensorError, OSError, TypeError, AttributeError) as error:  # types NumPy lacks
        raise broken(path, error) from error
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise broken(path, "numbers that are not finite")
    return tensors


def header_of(path: str | Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays in a folder; no array is read."""
    file = Path(path) / ARRAYS
    check_plain(file)
    try:
        with safe_open(file, "np") as arrays:
            return {name: tuple(arrays.get_slice(name).get_shape()) for name in arrays.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise broken(path, error) from error


def check_plain(file: Path) -> None:
    """Check that a file of a model is a file, or a link to one, as caches of the hub have them.

    Raises:
        FileNotFoundError: it is not there.
        ModelError: it is a folder, a pipe, which would be waited for, or a device.
    """
    if not stat.S_ISREG(file.stat().st_mode):
        raise broken(file.parent, f"{file.name} that is no plain file")


def broken(path: str | Path, why: object) -> ModelError:
    """Return the error of a folder that holds no such forecaster."""
    return ModelError(
        "the model cannot be loaded",
        expected="config.json and model.safetensors as `tipl train` and save() write them",
        got=why,
        where=path,
        do="train it again, or restore the folder from a copy",
    )


def fingerprint(forecaster: Forecaster) -> str:
    """Return the SHA-256 (hex) of all that a forecaster saves."""
    digest = hashlib.sha256()
    with tempfile.TemporaryDirectory() as folder:
        forecaster.save(folder)
        for file in sorted(Path(folder).rglob("*")):
            if file.is_file():
                digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _check_sizes(config: Any, header: Mapping[str, tuple[int, ...]], path: str | Path) -> None:
    """Refuse sizes that the arrays cannot have, such as more layers than arrays."""
    numbers = sum(prod(shape) for shape in header.values())
    sizes = dict(_integers(asdict(config)))
    heads = sizes.get("n_head", 1)
    if heads < 1 or sizes.get("n_embd", heads) % heads:
        raise broken(path, f"n_head {heads}, which does not divide n_embd {sizes.get('n_embd')}")
    for name, value in _integers(asdict(config)):
        most = len(header) if name == "n_layer" else max(LEAST_SIZE, numbers)
        if not 0 <= value <= most:
            raise broken(path, f"{name} {value:.3g}, beside arrays of {numbers:,} numbers")


def _integers(value: Any, name: str = "") -> Iterator[tuple[str, int]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _integers(inner, key)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _integers(inner, name)
    elif isinstance(value, int):
        yield name, value


def _difference(expected: Mapping[str, tuple[int, ...]], got: Mapping[str, tuple[int, ...]]) -> str:
    """Return the first thing that differs between two sets of arrays, in words."""
    if missing := sorted(expected.keys() - got.keys()):
        return f"Missing key {missing[0]}"
    if more := sorted(got.keys() - expected.keys()):
        return f"Unexpected key {more[0]}"
    name = next(name for name in expected if expected[name] != got[name])
    return f"{name} of shape {got[name]}, not {expected[name]}"
