"""CMD: parameters that move together move as one of few.

After "Enhancing Neural Training via a Correlated Dynamics Model" (Brokman et al., ICLR 2024,
arXiv:2312.13247). The paper fixes: hierarchical clustering of a sample splits the parameters into
few modes of high correlation over time; each mode has a reference, the parameter that is most
correlated with the others of its mode; every other parameter joins the mode whose reference it is
most correlated with, and is modelled as an affine function of it, w_i = a_i w_ref + b_i.

The paper describes a training in these terms and forecasts nothing. Ours: correlations and affine
functions are those of the last 21 snapshots; the modes are found again at each ``renewal``; of
equally correlated parameters the one that moves most is the reference; a step of a parameter is a_i
times the step of its reference, and a regression on the last 20 of these steps forecasts. 10 modes,
as in the paper (on validation runs of InvertedPendulum skill at h = 1 is 0.22 with 10 modes and
0.27 with 30; on some of them 0.19 with correlations over 50 snapshots, 0.17 over the whole past).

Of a large policy 500 parameters are clustered, chosen by their place, so a permutation of hidden
units chooses others. Up to 500 parameters the forecast follows permutations, except for ties.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

from tipl.models.baselines.data import Trajectory, renewal
from tipl.models.baselines.features import Features, Inputs, last_steps

CLUSTERED = 500
"""Number of parameters that are clustered."""


@dataclass(frozen=True)
class ModeSteps(Features):
    """The last steps of each mode's reference, times the slope of the parameter."""

    lags: int = 20
    """Number of steps; correlations are taken over the snapshots around them."""
    modes: int = 10
    """Number of modes."""
    kind = "mode-steps"
    name = "cmd"

    @property
    def size(self) -> int:
        """Number of features."""
        return self.lags

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """Yield the features of each start."""
        found, references = -1, np.zeros(0, int)
        for place, window in trajectory.windows(starts, self.lags):
            if (newest := renewal(starts[place])) != found:
                found = newest
                past = trajectory.weights[max(0, newest - self.lags) : newest + 1]
                references = find_references(past.astype(np.float64), self.modes)
            mine, slope = _affine(window, references)
            steps = last_steps(window, self.lags)[:, references]
            yield place, window[-1], steps[:, mine] * slope


def find_references(
    window: Float64[np.ndarray, "time param"], modes: int
) -> Int[np.ndarray, " mode"]:
    """Return the reference parameter of each mode."""
    count = window.shape[1]
    sample = np.unique(np.linspace(0, count - 1, min(count, CLUSTERED)).round().astype(int))
    centred = window[:, sample] - window[:, sample].mean(0)
    size = np.linalg.norm(centred, axis=0)
    unit = centred / np.maximum(size, np.finfo(float).tiny)
    alike = np.abs(unit.T @ unit)
    label = cluster(alike, modes)
    chosen = []
    for number in np.unique(label):
        members = np.flatnonzero(label == number)
        together = alike[np.ix_(members, members)].sum(0)
        best = members[together > together.max() - 1e-9]  # two alone are equally correlated
        chosen.append(sample[best[size[best].argmax()]])
    return np.array(chosen)


def cluster(alike: Float64[np.ndarray, "item item"], count: int) -> Int[np.ndarray, " item"]:
    """Return the cluster of each item, named by one of its members: average linkage.

    ``alike`` says how alike two items are, and ``count`` is the number of clusters.
    """
    alike = alike.copy()
    np.fill_diagonal(alike, -np.inf)
    sizes, label = np.ones(len(alike)), np.arange(len(alike))
    for _ in range(len(alike) - count):
        a, b = np.unravel_index(alike.argmax(), alike.shape)
        merged = (sizes[a] * alike[a] + sizes[b] * alike[b]) / (sizes[a] + sizes[b])
        alike[a] = alike[:, a] = merged
        alike[b] = alike[:, b] = alike[a, a] = -np.inf
        sizes[a] += sizes[b]
        label[label == b] = a
    return label


def _affine(
    window: Float64[np.ndarray, "time param"], references: Int[np.ndarray, " mode"]
) -> tuple[Int[np.ndarray, " param"], Float64[np.ndarray, " param"]]:
    """Return the mode of each parameter, and a_i of its affine function of the reference."""
    centred = window - window.mean(0)
    squared = (centred**2).sum(0)
    products = centred[:, references].T @ centred  # (mode, param)
    known = np.maximum(squared[references], np.finfo(float).tiny)
    mine = (np.abs(products) / np.sqrt(known)[:, None]).argmax(0)
    return mine, products[mine, np.arange(len(squared))] / known[mine]
