"""Windows of coefficients as batches for a causal model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tipl.errors import TrainError
from tipl.representation import Embedded


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
    rows: int
    """Unpadded rows of the whole batch, also where this is a share of it."""

    def to(self, device: str | torch.device) -> Batch:
        """The same batch on another device."""
        return self._each(lambda tensor: tensor.to(device))

    def share(self, windows: slice) -> Batch:
        """Some windows of the batch. Errors of shares that make up the batch add up to its own."""
        return self._each(lambda tensor: tensor[windows])

    def _each(self, change: Callable[[Tensor], Tensor]) -> Batch:
        return Batch(
            tokens=change(self.tokens),
            timesteps=change(self.timesteps),
            mask=change(self.mask),
            targets=change(self.targets),
            weights=change(self.weights),
            rows=self.rows,
        )


@dataclass(frozen=True, kw_only=True)
class TokenRun:
    """One run in coefficients."""

    coefficients: Float[np.ndarray, "time rank"]
    """float32; row t stands for phi_t."""
    weights: Float[np.ndarray, " rank"]
    """Squared singular values over P."""

    @classmethod
    def of(cls, embedded: Embedded) -> TokenRun:
        """A run in the basis of its whole trajectory."""
        svd = embedded.svd
        return cls(
            coefficients=embedded.coefficients.astype(np.float32),
            weights=(svd.singular_values**2 / svd.components.shape[1]).astype(np.float32),
        )


class TokenSampler:
    """Draws random windows; batch n is a function of (seed, n) alone.

    Ours, where the paper is silent: windows end at each snapshot that has a successor with equal
    probability, with replacement; the first ones of a run are padded on the left, as Decision
    Transformer's are.

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
        return self._windows(self._run[pick], self._t[pick])

    def tiles(self, most: int) -> list[Batch]:
        """Windows side by side that predict each snapshot of each run once, phi_0 left out.

        Args:
            most: no more windows than this; they are evenly chosen if there are.

        Returns:
            shares of one large batch, each of at most ``batch_size`` windows.
        """
        ends = [np.arange(n - 2, -1, -self.window) for n in self._lengths]
        run, t = np.repeat(np.arange(len(ends)), [len(e) for e in ends]), np.concatenate(ends)
        pick = np.linspace(0, len(t) - 1, min(len(t), most)).round().astype(int)
        everything = self._windows(run[pick], t[pick])
        starts = range(0, len(pick), self.batch_size)
        return [everything.share(slice(start, start + self.batch_size)) for start in starts]

    def _windows(self, run: Int[np.ndarray, " batch"], t: Int[np.ndarray, " batch"]) -> Batch:
        """Windows of these runs that end at these snapshots."""
        steps = t[:, None] + np.arange(-self.window + 1, 1)
        first = (self._first[run] + t - self.window + 1)[:, None]
        rows = torch.from_numpy(self._rows[first + np.arange(self.window + 1)])
        return Batch(
            tokens=rows[:, :-1],
            timesteps=torch.from_numpy(np.maximum(steps, 0)),
            mask=torch.from_numpy(steps >= 0),
            targets=rows[:, 1:],
            weights=torch.from_numpy(self._weights[run]),
            rows=int((steps >= 0).sum()),
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
