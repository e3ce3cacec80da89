"""What an evaluation measures, and how much of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tipl.errors import EvaluateError
from tipl.horizons import HORIZONS
from tipl.settings import check_settings


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """One evaluation."""

    data: str | Path
    """Data set: a path or an id."""
    out: Path
    """Folder of the results. What was measured before an interruption is kept there."""
    split: Literal["train", "validation", "test"] = "test"
    """Split of the runs that forecasters are evaluated on."""
    horizons: tuple[int, ...] = HORIZONS
    """Numbers of snapshots ahead; those beyond half of the shortest run are left out."""
    starts: int = 2_000
    """Number of starts in each run for errors of weights: the first ones, then evenly spaced."""
    function_starts: int = 400
    """Number of these starts for divergences of policies on stored observations; 0: none."""
    return_horizons: tuple[int, ...] = (*range(1, 11), 20, 50, 100)
    """Numbers of snapshots ahead for which returns are measured."""
    learning_starts: int = 6
    """Number of starts in each run's learning phase for returns; 0: no returns."""
    plateau_starts: int = 3
    """Number of starts after the learning phase for returns."""
    episodes: int = 20
    """Number of episodes for the return of one policy, the same seeds for all."""
    bootstrap: int = 2_000
    """Number of resamples of the runs for intervals."""
    seed: int = 0
    """Seed of episodes and resamples."""
    quick: bool = False
    """Fewer starts, episodes and horizons: minutes instead of hours."""

    def bounded(self) -> EvaluateConfig:
        """Return these settings, smaller if ``quick``.

        Raises:
            EvaluateError: a number is too small, or no horizon is named.
        """
        least = dict.fromkeys(("horizons", "starts", "episodes", "bootstrap"), 1)
        least |= dict.fromkeys(("function_starts", "learning_starts", "plateau_starts", "seed"), 0)
        if self.learning_starts:
            least["return_horizons"] = 1
        check_settings(vars(self), least, EvaluateError)
        if not self.quick:
            return self
        quick = tuple(h for h in self.return_horizons if h in (1, 10, 50))
        return replace(
            self,
            starts=min(self.starts, 300),
            function_starts=min(self.function_starts, 50),
            return_horizons=quick or self.return_horizons[:1],
            learning_starts=min(self.learning_starts, 2),
            plateau_starts=min(self.plateau_starts, 1),
            episodes=min(self.episodes, 5),
        )
