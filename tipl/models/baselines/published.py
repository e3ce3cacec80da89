"""Published ways to go on from the path so far, each as one direction v_t per snapshot.

``Extrapolation`` makes a forecast of each, phi_t + h v_t, and ``tipl.models.stretched`` stretches
it by what the returns of validation runs say. Most of these papers train language models and choose
directions by tensor over whole trainings; here each sees the last snapshots before the start and
nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tipl.models.baselines.data import Trajectory
from tipl.models.baselines.features import Features, Inputs


def iteration_length(trajectory: Trajectory, t: int) -> int:
    """Return the number of snapshots of an iteration, as seen up to snapshot t; at least 1."""
    return max(1, int(trajectory.phase[: t + 1].max()) + 1)


@dataclass(frozen=True)
class LastIteration(Features):
    """The change over the last iteration of PPO, per snapshot.

    Stretched (``tipl train stretched``), this is "last iteration x alpha": the rival that a public
    replication of RELEX found level with the end of a training ("the first update times 1000").
    Moving on by a multiple of each iteration's change is also the outer step of Nichol et al., "On
    First-Order Meta-Learning Algorithms" (arXiv:1803.02999), and of outer-PPO.
    """

    kind = "last-iteration"
    name = "last-iteration"
    size = 1

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield (phi_t - phi_{t-n}) / n, with n snapshots an iteration; 0 for phi_0."""
        for place, t in enumerate(starts):
            n = min(iteration_length(trajectory, t), t)
            last = trajectory.weights[t].astype(np.float64)
            yield place, last, ((last - trajectory.weights[t - n]) / max(n, 1))[None]


@dataclass(frozen=True)
class Lines(Features):
    """A line through the recent values of each weight, where a line fits.

    After "Not All Steps are Informative: On the Linearity of LLMs' RLVR Training"
    (arXiv:2601.04537): most weights move on lines, so each is extrapolated by its own line where
    R^2 is high. Ours: the lines go through the last snapshots and not through the whole training,
    and a weight that no line fits stays where it is.
    """

    window: int = 50
    """Number of snapshots that a line is fitted to."""
    least: float = 0.7
    """R^2 from which on a weight follows its line."""
    kind = "lines"
    size = 1

    @property
    def name(self) -> str:
        """``lines`` and the window."""
        return f"lines-{self.window}"

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the slope of each weight; 0 where R^2 is below ``least``."""
        for place, window in trajectory.windows(starts, self.window - 1):
            time = np.arange(len(window)) - (len(window) - 1) / 2
            centred = window - window.mean(0)
            slope = time @ centred / (float(time @ time) or 1.0)
            total = np.maximum((centred**2).sum(0), np.finfo(float).tiny)
            fits = slope**2 * float(time @ time) / total >= self.least
            yield place, window[-1], np.where(fits, slope, 0.0)[None]


@dataclass(frozen=True)
class Relex(Features):
    """One direction for each tensor, and a line through the path along it.

    After RELEX (arXiv:2605.21468): the changes of each tensor since the first checkpoint are
    reduced to rank 1 by an SVD, a line is fitted to the coefficients, and goes on. Ours: changes
    since the oldest snapshot of a window, and the line begins at the newest weights: a rank-1
    reconstruction of them would be further off than the forecast moves.
    """

    window: int = 50
    """Number of snapshots that are seen."""
    kind = "relex"
    size = 1

    @property
    def name(self) -> str:
        """``relex`` and the window."""
        return f"relex-{self.window}"

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the slope along each tensor's direction; 0 for phi_0."""
        tensors = [np.flatnonzero(trajectory.tensor == i) for i in np.unique(trajectory.tensor)]
        for place, window in trajectory.windows(starts, self.window - 1):
            velocity = np.zeros(window.shape[1])
            time = np.arange(len(window)) - (len(window) - 1) / 2
            for columns in tensors:
                deltas = window[:, columns] - window[0, columns]
                (direction,) = leading(deltas, 1)
                slope = time @ (deltas @ direction) / (float(time @ time) or 1.0)
                velocity[columns] = slope * direction
            yield place, window[-1], velocity[None]


@dataclass(frozen=True)
class LeadingDirections(Features):
    """The change over the last iteration, along the leading directions of the recent path.

    After Policy Path Trimming and Boosting, PPTB, of "The Ladder in Chaos" (Tang et al.,
    NeurIPS 2024), from which Temporal SVD comes: the minor directions of the path are trimmed and
    the major ones boosted. Ours: trimmed of the change and not of the weights, whose minor
    directions hold what a policy was initialised with; ``stretched`` boosts.
    """

    window: int = 50
    """Number of snapshots whose path gives the directions."""
    rank: int = 4
    """Number of directions that are kept."""
    kind = "leading-directions"
    size = 1

    @property
    def name(self) -> str:
        """``pptb`` and the number of directions."""
        return f"pptb-{self.rank}"

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the projected change per snapshot; 0 for phi_0."""
        for place, window in trajectory.windows(starts, self.window - 1):
            n = min(iteration_length(trajectory, starts[place]), len(window) - 1)
            change = (window[-1] - window[-1 - n]) / max(n, 1)
            directions = leading(window - window.mean(0), self.rank)
            yield place, window[-1], (directions.T @ (directions @ change))[None]


def leading(
    rows: Float64[np.ndarray, "time param"], rank: int
) -> Float64[np.ndarray, "direction param"]:
    """Return the leading right singular vectors of some rows, of length 1, or 0 for lack of rank.

    By the eigenvectors of the rows' products, of which there are fewer than parameters.
    """
    values, vectors = np.linalg.eigh(rows @ rows.T)
    kept = vectors[:, ::-1][:, :rank].T
    sizes = np.sqrt(np.maximum(values[::-1][:rank], 0.0))
    known = sizes > 1e-7 * max(float(sizes[0]), np.finfo(float).tiny)
    directions: np.ndarray = kept @ rows * (known / np.where(known, sizes, 1.0))[:, None]
    return directions
