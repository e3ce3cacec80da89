"""What a recipe says of how runs are trained and stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from weighttraj.format.schema import Profile


@dataclass(frozen=True, kw_only=True)
class Collect:
    """Who trains."""

    collector: Literal["sb3", "population"] = "sb3"
    """``sb3``: Stable-Baselines3, any environment, a run at a time. ``population``: the same
    training of many seeds at once, several times as fast, for Gymnasium's MuJoCo environments."""
    population: int = 16
    """Runs that a population trains at once; more or fewer give the same bytes."""

    @property
    def block(self) -> int:
        """Runs that one process makes at once."""
        return self.population if self.collector == "population" else 1


@dataclass(frozen=True, kw_only=True)
class Store:
    """What is stored, and how often."""

    every: int = 64
    """Gradient steps from one snapshot to the next."""
    critic: bool = False
    """Store the critic's parameters."""
    optimizer_moments: bool = False
    """Store Adam's moments of the policy's parameters."""
    probe_observations: int = 64
    """Network inputs kept of each rollout."""
    block: int = 64
    """Snapshots in a chunk and in a commit."""
    profile: Profile = "default"
    """How a finished run is packed: ``default``, or ``archive``, the smallest."""


__all__ = ["Collect", "Store"]
