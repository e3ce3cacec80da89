"""Steps from one snapshot to the next, and means of them. d_t = phi_t - phi_{t-1}."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tipl.models.baselines.data import Trajectory
from tipl.models.baselines.features import Features, Inputs


@dataclass(frozen=True)
class Steps(Features):
    """The last steps, newest first: d_t, d_{t-1}, ...; 0 before the beginning of the run."""

    lags: int = 20
    """How many."""
    kind = "steps"

    @property
    def name(self) -> str:
        """``last-step``, or ``ar-20``: a regression on steps is autoregressive."""
        return "last-step" if self.lags == 1 else f"ar-{self.lags}"

    @property
    def size(self) -> int:
        """How many there are."""
        return self.lags

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """The features of each start."""
        for place, window in trajectory.windows(starts, self.lags):
            yield place, window[-1], last_steps(window, self.lags)


def last_steps(
    window: Float64[np.ndarray, "row param"], lags: int
) -> Float64[np.ndarray, "lag param"]:
    """Steps between the last snapshots of a window, newest first, and zeros for those before it."""
    steps = np.zeros((lags, window.shape[1]))
    known = np.diff(window[-(lags + 1) :], axis=0)[::-1]
    steps[: len(known)] = known
    return steps


@dataclass(frozen=True)
class Slope(Features):
    """Slope of the straight line that fits the last snapshots best, by least squares."""

    window: int = 20
    """How many snapshots; fewer at the beginning of the run."""
    kind = "slope"
    size = 1

    @property
    def name(self) -> str:
        """A linear trend."""
        return f"trend-{self.window}"

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """The features of each start; 0 for phi_0."""
        for place, window in trajectory.windows(starts, self.window - 1):
            time = np.arange(len(window)) - (len(window) - 1) / 2
            slope = time @ window / (float(time @ time) or 1.0)  # phi_0 alone has no slope
            yield place, window[-1], slope[None]


@dataclass(frozen=True)
class Ema(Features):
    """Exponential moving average of the steps: m_t = beta m_{t-1} + (1 - beta) d_t.

    It is divided by 1 - beta^n, as Adam does, n being the number of steps so far. So it is the
    step itself on a straight line, and the first, large steps of a run are not damped. That is
    worth 0.06 of skill at h = 1 and 0.09 at h = 5 (beta 0.95, fitted factor, InvertedPendulum).

    Steps that weigh less than 1e-6 are left out, so that a late start needs no more than part of
    the past: the recursion starts again at certain snapshots.
    """

    beta: float = 0.95
    """Share of the mean that is kept from one step to the next."""
    kind = "ema"
    size = 1

    def __post_init__(self) -> None:
        if not 0 < self.beta < 1:
            raise ValueError(f"beta {self.beta}, not between 0 and 1")

    @property
    def name(self) -> str:
        """The mean and its beta."""
        return f"ema-{self.beta:g}"

    @property
    def period(self) -> int:
        """Number of snapshots from one restart of the recursion to the next."""
        return math.ceil(math.log(1e-6) / math.log(self.beta))

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """The features of each start; 0 for phi_0."""
        now, origin = -1, -1
        for place in np.argsort(np.asarray(starts), kind="stable").tolist():
            t = starts[place]
            first = max(0, (t // self.period - 1) * self.period)
            if first != origin:
                origin = now = first
                last = trajectory.weights[first].astype(np.float64)
                mean = np.zeros_like(last)
            while now < t:
                now += 1
                row = trajectory.weights[now].astype(np.float64)
                mean = self.beta * mean + (1 - self.beta) * (row - last)
                last = row
            yield place, last, (mean / max(1 - self.beta ** (t - origin), 1e-300))[None]
