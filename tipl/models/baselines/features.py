"""What the linear baselines look at: numbers for each parameter, from its past.

Steps are d_t = phi_t - phi_{t-1}.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float64

from tipl.models.baselines.data import Trajectory

Inputs = tuple[int, Float64[np.ndarray, " param"], Float64[np.ndarray, "feature param"]]
"""Of one start: its place among the starts, phi_t, and its features."""


@dataclass(frozen=True)
class Features(ABC):
    """Features of each parameter at a start, from the snapshots up to it.

    They do not depend on the number of parameters. The fields of a subclass are its settings.
    """

    kind: ClassVar[str]
    """Name of these features in a saved forecaster."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of a forecaster that uses them."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of features."""

    @abstractmethod
    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the features of each start, in the order of time; those of phi_0 are 0."""

    def settings(self) -> dict[str, Any]:
        """Return what these features are, for JSON."""
        return {"kind": self.kind, **vars(self)}


@dataclass(frozen=True)
class Steps(Features):
    """The last steps, newest first: d_t, d_{t-1}, ...; 0 before the beginning of the run."""

    lags: int = 20
    """Number of steps."""
    kind = "steps"

    @property
    def name(self) -> str:
        """``last-step``, or ``ar-20``: a regression on steps is autoregressive."""
        return "last-step" if self.lags == 1 else f"ar-{self.lags}"

    @property
    def size(self) -> int:
        """Number of features."""
        return self.lags

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the features of each start."""
        for place, window in trajectory.windows(starts, self.lags):
            yield place, window[-1], last_steps(window, self.lags)


def last_steps(
    window: Float64[np.ndarray, "row param"], lags: int
) -> Float64[np.ndarray, "lag param"]:
    """Return the last steps of a window, newest first; 0 for those before it."""
    steps = np.zeros((lags, window.shape[1]))
    known = np.diff(window[-(lags + 1) :], axis=0)[::-1]
    steps[: len(known)] = known
    return steps


@dataclass(frozen=True)
class Slope(Features):
    """Slope of the straight line that fits the last snapshots best, by least squares."""

    window: int = 20
    """Number of snapshots; fewer at the beginning of the run."""
    kind = "slope"
    size = 1

    @property
    def name(self) -> str:
        """``trend-20``, for example."""
        return f"trend-{self.window}"

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the features of each start."""
        for place, window in trajectory.windows(starts, self.window - 1):
            time = np.arange(len(window)) - (len(window) - 1) / 2
            slope = time @ window / (float(time @ time) or 1.0)  # phi_0 alone has no slope
            yield place, window[-1], slope[None]


@dataclass(frozen=True)
class Ema(Features):
    """Exponential moving average of the steps: m_t = beta m_{t-1} + (1 - beta) d_t.

    It is divided by 1 - beta^n after n steps, as in Adam. So it is the step itself on a straight
    line, and the first, large steps of a run are not damped, which is worth 0.06 of skill at h = 1
    and 0.09 at h = 5 (beta 0.95, fitted factor, InvertedPendulum).

    The recursion restarts at certain snapshots, so that a late start needs only a part of the
    past: steps that would weigh less than 1e-6 are left out.
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
        """``ema-0.95``, for example."""
        return f"ema-{self.beta:g}"

    @property
    def period(self) -> int:
        """Number of snapshots from one restart of the recursion to the next."""
        return math.ceil(math.log(1e-6) / math.log(self.beta))

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the features of each start."""
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


@dataclass(frozen=True)
class EndPoints(Features):
    """LFD-2: the oldest weights of a window, the newest, and 1.

    After "Less is More: Efficient Weight Farcasting with 1-Layer Neural Network" (Shou et al.,
    2025, arXiv:2505.02714), which Knyazev et al. (ICLR 2025, arXiv:2409.04434) call LFD-2.

    The paper fixes: of all weights so far only the first and the last are looked at; one linear
    layer with a bias, shared by all parameters, gives all future weights at once. Ours: the first
    is that of a window of five snapshots, as long as the other networks' (measured on validation
    runs: skill 0.19 at h = 1 with 5, 0.14 with 11, 0.04 with 51, 0.00 with phi_0 itself); squared
    errors instead of absolute ones, as the skill counts those; no regulariser.

    The bias adds the same to every parameter, and the weights enter as they are, not as
    differences. So a fit follows neither a flip of signs nor the scale of the steps.
    """

    context: int = 5
    """Snapshots in the window."""
    kind = "end-points"
    name = "lfd-2"
    size = 3

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the features of each start."""
        for place, window in trajectory.windows(starts, self.context - 1):
            last = window[-1]
            yield place, last, np.stack([window[0], last, np.ones_like(last)])
