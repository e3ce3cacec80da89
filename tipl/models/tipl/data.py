"""From the runs of a data set to batches of windows of coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

import weighttraj as wt
from tipl.errors import RepresentationError, TrainError
from tipl.forecaster import every_of
from tipl.representation import Embedded, embed
from tipl.runs import checksum_of
from tipl.training import Examples


@dataclass(frozen=True, kw_only=True)
class Windows(Examples):
    """Windows of one training step. Rows of padding, on the left, are marked in ``mask``."""

    tokens: Float[Tensor, "batch window rank"]
    """Coefficients of phi_{t-K+1}, ..., phi_t."""
    timesteps: Int[Tensor, "batch window"]
    """Index of each snapshot; 0 in padding."""
    mask: Bool[Tensor, "batch window"]
    """False in padding."""
    targets: Float[Tensor, "batch window rank"]
    """Coefficients one snapshot later."""
    weights: Float[Tensor, "batch rank"]
    """Squared singular values over P. They turn squared errors of coefficients into the mean
    squared error of policy weights."""


@dataclass(frozen=True, kw_only=True)
class TokenRun:
    """One run in coefficients."""

    coefficients: Float[np.ndarray, "time rank"]
    """float32; row t stands for phi_t."""
    weights: Float[np.ndarray, " rank"]
    """Squared singular values over P."""

    @classmethod
    def of(cls, embedded: Embedded, longest: int | None = None) -> TokenRun:
        """Return a run, or its first snapshots, in the basis of its whole trajectory."""
        svd = embedded.svd
        return cls(
            coefficients=embedded.coefficients[:longest].astype(np.float32),
            weights=(svd.singular_values**2 / svd.components.shape[1]).astype(np.float32),
        )


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """All that a training reads from a data set."""

    train: list[TokenRun]
    """Runs that are trained on."""
    validation: list[TokenRun]
    """Runs of the validation split, to log an error on; empty where there is none."""
    every: int | None
    """Number of gradient steps from one snapshot to the next."""
    parameters: int
    """Number of parameters of one policy."""
    longest: int
    """Number of snapshots of the longest training run."""
    checksums: dict[str, str]
    """Checksum of each training run, by id."""


class TokenSampler:
    """Draws random windows; batch n is a function of (seed, n) alone.

    Our choice, where the paper is silent: windows end at each snapshot that has a successor with
    equal probability, with replacement; the first ones of a run are padded on the left, as in
    Decision Transformer.

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

    def moments(self) -> tuple[Float[Tensor, " rank"], Float[Tensor, " rank"]]:
        """Return mean and standard deviation of each coefficient over all runs, without padding."""
        pieces = [self._rows[a : a + n] for a, n in zip(self._first, self._lengths, strict=True)]
        rows = torch.from_numpy(np.concatenate(pieces))
        return rows.mean(0), rows.std(0, correction=0)

    def step_size(self) -> Float[Tensor, " rank"]:
        """Return the root mean square of each coefficient's steps over all runs."""
        pieces = [self._rows[a : a + n] for a, n in zip(self._first, self._lengths, strict=True)]
        steps = np.concatenate([np.diff(rows, axis=0) for rows in pieces])
        return torch.from_numpy(steps).square().mean(0).sqrt()

    def batch(self, n: int) -> Windows:
        """Return batch number n."""
        rng = np.random.default_rng([self.seed, n])
        pick = rng.integers(len(self._t), size=self.batch_size)
        return self._windows(self._run[pick], self._t[pick])

    def tiles(self, most: int) -> list[Windows]:
        """Return adjacent windows, which predict each snapshot but phi_0 once, in batches.

        If there are more windows than ``most``, evenly spaced ones are taken.
        """
        ends = [np.arange(n - 2, -1, -self.window) for n in self._lengths]
        run, t = np.repeat(np.arange(len(ends)), [len(e) for e in ends]), np.concatenate(ends)
        pick = np.linspace(0, len(t) - 1, min(len(t), most)).round().astype(int)
        everything = self._windows(run[pick], t[pick])
        starts = range(0, len(pick), self.batch_size)
        return [everything[start : start + self.batch_size] for start in starts]

    def _windows(self, run: Int[np.ndarray, " batch"], t: Int[np.ndarray, " batch"]) -> Windows:
        """Return windows of these runs that end at these snapshots."""
        steps = t[:, None] + np.arange(-self.window + 1, 1)  # (batch, window)
        first = (self._first[run] + t - self.window + 1)[:, None]
        rows = torch.from_numpy(self._rows[first + np.arange(self.window + 1)])
        return Windows(
            tokens=rows[:, :-1],
            timesteps=torch.from_numpy(np.maximum(steps, 0)),
            mask=torch.from_numpy(steps >= 0),
            targets=rows[:, 1:],
            weights=torch.from_numpy(self._weights[run]),
        )


def history(
    coefficients: Float[np.ndarray, "time rank"], t: Int[np.ndarray, " start"], window: int
) -> tuple[Float[Tensor, "start window rank"], Int[Tensor, "start window"]]:
    """Return windows that end at each t, padded on the left with 0, and the index of each row.

    The index is negative in padding.
    """
    steps = np.asarray(t)[:, None] + np.arange(-window + 1, 1)
    tokens = coefficients[np.maximum(steps, 0)] * (steps >= 0)[..., None]
    return torch.from_numpy(tokens.astype(np.float32)), torch.from_numpy(steps)


def prepare(data: str | Path, *, rank: int, window: int) -> Prepared:
    """Read the runs of a data set and fit a basis to each whole run, as the paper does.

    The paper has no validation runs; here their bases are fitted in the same way.

    Raises:
        FormatError: no run is in the split ``train``.
        TrainError: the runs are shorter than the window, or differ in layout or cadence; or a run
            is not finite, or has fewer directions than the rank.
    """
    dataset = wt.open_dataset(data)
    train = dataset.split("train").runs
    held_out = [run for run in dataset if run.split == "validation"]
    longest = max(len(run) for run in train)
    if window > longest:
        raise TrainError(
            "the window is longer than every training run",
            expected=f"block_size at most {longest} snapshots",
            got=window,
            where=data,
            do="lower --block-size, or collect longer runs",
        )
    _check_alike([*train, *held_out], data)
    return Prepared(
        train=[_tokens(run, rank) for run in train],
        # The model has no time embedding for what comes after the longest training run.
        validation=[_tokens(run, rank, longest) for run in held_out],
        every=every_of(train[0]),
        parameters=train[0].layout.size,
        longest=longest,
        checksums={run.id: checksum_of(run) for run in train},
    )


def _check_alike(runs: Sequence[wt.Run], data: str | Path) -> None:
    """Refuse runs whose weights mean different things, or lie at different distances in time."""
    first = runs[0]
    for run in runs:
        for what, same in (
            ("layouts", run.layout == first.layout),
            ("cadences", every_of(run) == every_of(first)),
        ):
            if not same:
                raise TrainError(
                    f"the runs have different {what}",
                    expected=f"as run {first.id}: {first.layout.size} parameters, "
                    f"a snapshot every {every_of(first)} gradient steps",
                    got=f"run {run.id}: {run.layout.size} parameters, every {every_of(run)}",
                    where=data,
                    do="train on one data set of one policy and one cadence",
                )


def _tokens(run: wt.Run, rank: int, longest: int | None = None) -> TokenRun:
    try:
        return TokenRun.of(embed(run, rank), longest)
    except RepresentationError as error:
        raise TrainError(
            f"run {run.id} has no such coefficients",
            got=error,
            where=run.path,
            do="change --rank, or leave the run out",
        ) from error
