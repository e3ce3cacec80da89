"""Checks that a policy's weights change at the counted steps only."""

from __future__ import annotations

import torch

from weighttraj.collect.agents import SUPPORTED, Agent
from weighttraj.errors import CollectError


class Watch:
    """Remembers the recorded parameters as the last counted step left them.

    A copy is taken after every counted step. It is compared before every step of the first update
    and later at the borders of rollouts; ``tests/benchmarks/bench_callback.py`` measures the cost.

    Args:
        agent: whose parameters.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._last = [p.detach().clone() for p in agent.actor.values()]

    @torch.no_grad()
    def note(self) -> None:
        """Remember the parameters as they are."""
        torch._foreach_copy_(self._last, [p.detach() for p in self._agent.actor.values()])

    def has_moved(self) -> bool:
        """Say whether parameters differ from those last remembered."""
        now = [p.detach() for p in self._agent.actor.values()]
        return not all(map(_equal, now, self._last))

    def check(self, when: str) -> None:
        """Raise CollectError if parameters changed since they were last remembered.

        Args:
            when: the moment, for the error.
        """
        replaced = self._agent.has_other_parameters()
        if replaced or self.has_moved():
            name = type(self._agent.model).__name__
            raise CollectError(
                f"{name} changes the policy's weights outside the counted steps",
                expected=f"weights that change only by the counted steps, as in {SUPPORTED}",
                got="other parameter objects" if replaced else f"other weights {when}",
                where=name,
                do="record a snapshot of each update with unit='update', or change the weights in "
                "the optimizer's step only"
                if self._agent.unit == "gradient_step"
                else "change the weights between rollouts only",
            )


def _equal(now: torch.Tensor, last: torch.Tensor) -> bool:
    """Equal, where NaN equals NaN."""
    same = now.shape == last.shape and torch.equal(now, last)
    return same or (
        now.shape == last.shape and torch.allclose(now, last, rtol=0, atol=0, equal_nan=True)
    )
