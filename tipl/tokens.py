"""Windows of coefficients as batches for a causal model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tipl.errors import TrainError
from tipl.representation import TemporalSVD


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Windows of one training step. Left-padded rows are marked in ``mask``."""

    tokens: Tensor
    """float32 (batch, window, rank): coefficients of phi_{t-K+1}, ..., phi_t."""
    timesteps: Tensor
    """int64 (batch, window): index of each snapshot; 0 in padding."""
    mask: Tensor
    """bool (batch, window): False in padding."""
    targets: Tensor
    """float32 (batch, window, rank): coefficients one snapshot later."""
    weights: Tensor
    """float32 (batch, rank): squared singular values over P. They turn squared errors of
    coefficients into the mean squared error of policy weights."""

    def to(self, device: str) -> Batch:
        """The same batch on another device."""
        return replace(self, **{name: tensor.to(device) for name, tensor in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class TokenRun:
    """One run in coefficients."""

    coefficients: Float[np.ndarray, "time rank"]
    """float32; row t stands for phi_t."""
    weights: Float[np.ndarray, " rank"]
    """Squared singular values over P."""

    @classmethod
    def of(cls, svd: TemporalSVD, weights: Float[np.ndarray, "time param"]) -> TokenRun:
        """Coefficients of a trajectory in its basis."""
        return cls(
            coefficients=svd.transform(weights).astype(np.float32),
            weights=(svd.singular_values**2 / weights.shape[1]).astype(np.float32),
        )


class TokenSampler:
    """Draws random windows; batch n is a function of (seed, n) alone.

    Args:
        runs: runs in coefficients.
        window: snapshots in a window, K.
        batch_size: windows in a batch.
        seed: seed of the order.

    Raises:
        TrainError: there are no runs, or one has fewer than two snapshots.
    """

    def __init__(
        self, runs: Sequence[TokenRun], *, window: int, batch_size: int, seed: int
    ) -> None:
        lengths = [len(run.coefficients) for run in runs]
        if min(lengths, default=0) < 2:
            raise TrainError(
                "windows need runs of at least two snapshots",
                expected="one run or more",
                got=f"runs of {lengths} snapshots",
                do="collect runs for the split that is trained on",
            )
        self.window, self.batch_size, self.seed = window, batch_size, seed
        self._weights = np.stack([run.weights for run in runs])
        # All runs in one array, each behind a window of padding, so that a batch is one gather.
        pad = np.zeros((window, runs[0].coefficients.shape[1]), np.float32)
        self._rows = np.concatenate([x for run in runs for x in (pad, run.coefficients)])
        ends = np.cumsum([window + n for n in lengths])
        self._first, self._lengths = ends - lengths, lengths
        # Every snapshot that has a successor can end a window.
        self._run = np.repeat(np.arange(len(runs)), np.array(lengths) - 1)
        self._t = np.concatenate([np.arange(n - 1) for n in lengths])

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of each coefficient over all runs, padding left out."""
        pieces = [self._rows[a : a + n] for a, n in zip(self._first, self._lengths, strict=True)]
        rows = torch.from_numpy(np.concatenate(pieces))
        return rows.mean(0), rows.std(0, correction=0)

    def batch(self, n: int) -> Batch:
        """Batch number n."""
        rng = np.random.default_rng([self.seed, n])
        pick = rng.integers(len(self._t), size=self.batch_size)
        run, t = self._run[pick], self._t[pick]
        steps = t[:, None] + np.arange(-self.window + 1, 1)
        rows = self._first[run][:, None] + steps
        return Batch(
            tokens=torch.from_numpy(self._rows[rows]),
            timesteps=torch.from_numpy(np.maximum(steps, 0)),
            mask=torch.from_numpy(steps >= 0),
            targets=torch.from_numpy(self._rows[rows + 1]),
            weights=torch.from_numpy(self._weights[run]),
        )


def history(
    coefficients: Float[np.ndarray, "time rank"], t: Int[np.ndarray, " start"], window: int
) -> tuple[Tensor, Tensor]:
    """Windows that end at each t, left-padded with zeros.

    Returns:
        float32 (start, window, rank), and the index of each row, negative in padding.
    """
    steps = np.asarray(t)[:, None] + np.arange(-window + 1, 1)
    tokens = coefficients[np.maximum(steps, 0)] * (steps >= 0)[..., None]
    return torch.from_numpy(tokens.astype(np.float32)), torch.from_numpy(steps)
