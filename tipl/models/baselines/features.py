"""What the linear baselines look at: numbers for each parameter, from its past."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from jaxtyping import Float64
from numpy import ndarray

from tipl.models.baselines.data import Trajectory

Inputs = tuple[int, Float64[ndarray, " param"], Float64[ndarray, "feature param"]]
"""Of one start: its place among the starts, phi_t, and its features."""


@dataclass(frozen=True)
class Features(ABC):
    """Features of each parameter at a start, from the snapshots up to it.

    They don't depend on the number of parameters. The fields of a subclass are its settings.
    """

    kind: ClassVar[str]
    """Which features these are, in a saved forecaster."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What a forecaster that uses them is called."""

    @property
    @abstractmethod
    def size(self) -> int:
        """How many there are."""

    @abstractmethod
    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """The features of each start; starts come in the order of time."""

    def settings(self) -> dict[str, Any]:
        """JSON of what these features are."""
        return {"kind": self.kind, **vars(self)}
