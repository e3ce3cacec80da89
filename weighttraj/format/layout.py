"""How the parameters of a policy lie in one flat vector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32
from numpy.typing import ArrayLike

from weighttraj.errors import FormatError, SnapshotError
from weighttraj.format.values import as_array

Role = Literal["weight", "bias", "log_std", "other"]


@dataclass(frozen=True, kw_only=True)
class ParamSpec:
    """One parameter tensor and its place in the flat vector."""

    name: str
    """Name in the policy's ``named_parameters()``, unique in the layout."""
    shape: tuple[int, ...]
    """Shape of the tensor, C order."""
    offset: int
    """Index of its first element in the flat vector."""
    role: Role
    """What the tensor does in the network."""
    axes: tuple[str, ...]
    """A label an axis. Axes with the same ``hidden_*`` label permute together without changing
    the function; with an odd activation (tanh) their signs flip together too."""

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def slice(self) -> slice:
        """The tensor's part of the flat vector."""
        return slice(self.offset, self.offset + self.size)


@dataclass(frozen=True, kw_only=True)
class ParamLayout:
    """The parameters of a policy in the order in which they are stored, without gaps.

    >>> layout = ParamLayout.of({"w": ((2, 3), "weight", ("hidden_0", "observation"))})
    >>> layout.size
    6
    >>> layout.unflatten(np.arange(6, dtype=np.float32))["w"].shape
    (2, 3)
    """

    params: tuple[ParamSpec, ...]

    def __post_init__(self) -> None:
        offset = 0
        names = set()
        for spec in self.params:
            if spec.offset != offset or min(spec.shape, default=1) < 1:
                raise FormatError(
                    "the parameter layout has gaps, overlaps or empty tensors",
                    expected=f"offset {offset} and positive sizes",
                    got=f"offset {spec.offset}, shape {spec.shape}",
                    where=f"parameter {spec.name!r}",
                    do="write the layout with ParamLayout.of, which computes the offsets",
                )
            if len(spec.axes) != len(spec.shape):
                raise FormatError(
                    "a parameter needs one axis label for each axis",
                    expected=f"{len(spec.shape)} labels for shape {spec.shape}",
                    got=spec.axes,
                    where=f"parameter {spec.name!r}",
                    do='label axes without symmetry "fixed"',
                )
            offset += spec.size
            names.add(spec.name)
        if len(names) != len(self.params):
            raise FormatError(
                "parameter names in a layout must be unique",
                got=[spec.name for spec in self.params],
                do="rename the parameters",
            )

    @classmethod
    def of(
        cls, tensors: Mapping[str, tuple[tuple[int, ...], Role, tuple[str, ...]]]
    ) -> ParamLayout:
        """A layout from ``{name: (shape, role, axes)}``; offsets follow the mapping's order."""
        params, offset = [], 0
        for name, (shape, role, axes) in tensors.items():
            spec = ParamSpec(name=name, shape=tuple(shape), offset=offset, role=role, axes=axes)
            params.append(spec)
            offset += spec.size
        return cls(params=tuple(params))

    @property
    def size(self) -> int:
        """Number of parameters P of the policy."""
        return sum(spec.size for spec in self.params)

    def __getitem__(self, name: str) -> ParamSpec:
        for spec in self.params:
            if spec.name == name:
                return spec
        raise KeyError(f"no parameter {name!r}; there are {[s.name for s in self.params]}")

    def flatten(self, tensors: Mapping[str, ArrayLike | Any]) -> Float32[np.ndarray, " param"]:
        """Join named tensors into one float32 vector.

        Args:
            tensors: arrays or tensors of any real type, which may require a gradient, by name;
                ``module.state_dict()``, for example. Names that the layout lacks are left out.

        Raises:
            SnapshotError: a tensor is missing, has another shape than the layout's, or does not
                consist of real numbers that float32 can hold.
        """
        flat = np.empty(self.size, np.float32)
        for spec in self.params:
            where = f"parameter {spec.name!r}"
            there = spec.name in tensors
            part = as_array(tensors[spec.name], "float32", where) if there else None
            if part is None or part.shape != spec.shape:
                raise SnapshotError(
                    "the tensors do not follow the layout",
                    expected=spec.shape,
                    got="no such tensor" if part is None else part.shape,
                    where=where,
                    do="use the layout of the policy that these tensors come from",
                )
            flat[spec.slice] = part.reshape(-1)
        return flat

    def unflatten(
        self, weights: Float32[np.ndarray, "*batch param"]
    ) -> dict[str, Float32[np.ndarray, "..."]]:
        """Return views of each parameter, ``{name: (*batch, *shape)}``.

        Raises:
            SnapshotError: the last axis is not the layout's size.
        """
        if weights.shape[-1:] != (self.size,):
            raise SnapshotError(
                "the weights do not follow the layout",
                expected=f"(..., {self.size})",
                got=weights.shape,
                do="pass whole snapshots, as run.weights[...] returns them",
            )
        batch = weights.shape[:-1]
        return {s.name: weights[..., s.slice].reshape((*batch, *s.shape)) for s in self.params}
