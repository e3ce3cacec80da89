"""The past of a run, a snapshot at a time, so that it takes little memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from tipl.runs import weights_of
from weighttraj import Run

SQUARES_BETA = 0.95
"""Decay of the average of squared steps, the local scale."""


class History:
    """Steps of all parameters up to a snapshot, and averages of them.

    Averages are bias-corrected as Adam's: on a straight line each one is the step of the line.

    Args:
        first: phi_0.
        lags: number of steps that are kept.
        betas: decays of the averages.
    """

    def __init__(
        self, first: Float32[np.ndarray, " param"], lags: int, betas: Sequence[float]
    ) -> None:
        self.t = 0
        """Snapshots that followed the first."""
        self._first = self._last = torch.from_numpy(np.array(first))
        self._lags = self._newest = lags
        self._steps = torch.zeros(2 * lags, len(first))  # newest first from its place on
        self._betas = torch.tensor(betas)[:, None]
        self._averages = torch.zeros(len(betas), len(first))
        self._squares = torch.zeros(len(first))
        self._basis = torch.zeros(lags + len(betas) + 1, len(first))
        self._basis_of = 0

    def push(self, weights: Float32[np.ndarray, " param"]) -> None:
        """Take in the weights of the next snapshot."""
        now = torch.from_numpy(np.array(weights))
        step = now - self._last
        self.t, self._last = self.t + 1, now
        if self._newest == 0:
            self._steps[self._lags :] = self._steps[: self._lags]
            self._newest = self._lags
        self._newest -= 1
        self._steps[self._newest] = step
        self._averages.mul_(self._betas).add_((1 - self._betas) * step)
        self._squares.mul_(SQUARES_BETA).addcmul_(step, step, value=1 - SQUARES_BETA)

    @property
    def weights(self) -> Float[Tensor, " param"]:
        """phi_t."""
        return self._last

    @property
    def basis(self) -> Float[Tensor, "basis param"]:
        """The past of each parameter: steps, averages, and the mean step since phi_0.

        The last steps come newest first, and are 0 before the run; averages are exponential moving
        ones, one for each beta. The memory is overwritten as the history goes on: to allocate it
        for a large policy takes longer than to fill it.
        """
        if self._basis_of != self.t:
            lags, drift, t = self._lags, len(self._basis) - 1, self.t
            self._basis[:lags] = self._steps[self._newest : self._newest + lags]
            torch.div(self._averages, 1 - self._betas**t, out=self._basis[lags:drift])
            torch.sub(self._last, self._first, out=self._basis[drift]).div_(t)
            self._basis_of = t
        return self._basis

    @property
    def squares(self) -> Float[Tensor, " param"]:
        """Exponential moving average of squared steps."""
        return self._squares / (1 - SQUARES_BETA ** max(self.t, 1))


def histories(
    run: Run, starts: Sequence[int], lags: int, betas: Sequence[float]
) -> Iterator[tuple[int, History]]:
    """Yield the place of each start, in the order of time, and the history there.

    The history is valid until the next one. It always begins at phi_0, so a forecast does not
    depend on earlier calls; a call with later starts than the last one of this run goes on there.
    """
    walks, key, weights = _WALKS.setdefault(run, {}), (lags, tuple(betas)), weights_of(run)
    history = walks.pop(key, None)
    if history is None or history.t > min(starts):
        history = History(weights[0], lags, betas)
    for place in np.argsort(np.asarray(starts), kind="stable").tolist():
        while history.t < starts[place]:
            history.push(weights[history.t + 1])
        yield place, history
    walks[key] = history


_WALKS: WeakKeyDictionary[Run, dict[tuple[int, tuple[float, ...]], History]] = WeakKeyDictionary()
"""Histories where walks along a run ended. A run that grows is followed from there."""
