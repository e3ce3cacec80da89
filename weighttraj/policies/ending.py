"""Where an episode ends that the environment does not end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym

from weighttraj.environments import time_limit
from weighttraj.errors import PolicyError

ENDLESS = 100_000
"""Steps after which an episode without any limit is an error."""


@dataclass(frozen=True, kw_only=True)
class End:
    """The step after which episodes are cut off."""

    limit: int | None
    """Steps; None: no limit is known."""
    where: str
    """The environment, for errors."""

    def cuts(self, step: int) -> bool:
        """Return whether an episode that has had so many steps is cut off.

        Raises:
            PolicyError: it has no limit, and does not end.
        """
        if self.limit is not None:
            return step >= self.limit
        if step < ENDLESS:
            return False
        raise PolicyError(
            "an episode does not end, and the environment has no time limit",
            expected=f"an end within {ENDLESS:,} steps, or a limit",
            got=f"{step:,} steps",
            where=self.where,
            do="pass max_steps to evaluate(), or register the environment with max_episode_steps",
        )


def end_of(env: gym.Env[Any, Any], max_steps: int | None) -> End:
    """Return where episodes end: at the environment's time limit or ``max_steps``, if earlier."""
    limits = [limit for limit in (time_limit(env), max_steps) if limit is not None]
    return End(limit=min(limits, default=None), where=str(env))


def check_numbers(*, max_steps: int | None = None, **counts: int) -> None:
    """Refuse numbers that leave nothing to play.

    Raises:
        PolicyError: a number is below 1.
    """
    given = counts | ({} if max_steps is None else {"max_steps": max_steps})
    if min(given.values()) < 1:
        raise PolicyError(
            "no episodes to play, or nothing to play them with",
            expected=f"{', '.join(given)}: at least 1",
            got=", ".join(f"{name} {number}" for name, number in given.items()),
            do="give larger numbers",
        )
