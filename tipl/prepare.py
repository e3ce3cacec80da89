"""From the training runs of a data set to runs in coefficients."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import weighttraj as wt
from tipl.errors import RepresentationError, TrainError
from tipl.representation import embed
from tipl.tokens import TokenRun


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """All that a training reads from a data set."""

    train: list[TokenRun]
    """Runs that are learnt from."""
    validation: list[TokenRun]
    """Runs of the validation split, to log an error on; empty where there is none."""
    every: int | None
    """Gradient steps from one snapshot to the next."""
    parameters: int
    """Of one policy."""
    longest: int
    """Snapshots of the longest training run."""
    digests: dict[str, str]
    """What the training runs hold, by id."""


def prepare(data: str | Path, *, rank: int, window: int) -> Prepared:
    """Read the runs of a data set and fit a basis to each, as the paper does: to the whole run.

    The bases of validation runs are fitted in the same way. The paper has no validation runs; they
    are ours, and nothing is chosen by them.

    Args:
        data: a data set with runs in the split ``train``.
        rank: coefficients of a token, d.
        window: snapshots in a window, K.

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
        validation=[_cut(_tokens(run, rank), longest) for run in held_out],
        every=_every(train[0]),
        parameters=train[0].layout.size,
        longest=longest,
        digests={run.id: digest_of(run) for run in train},
    )


def digest_of(run: wt.Run) -> str:
    """Hash of all weights of a run."""
    return hashlib.sha256(run["digest"][:].tobytes()).hexdigest()


def _every(run: wt.Run) -> int | None:
    return run.info.cadence.every if run.info.cadence else None


def _cut(run: TokenRun, longest: int) -> TokenRun:
    return replace(run, coefficients=run.coefficients[:longest])


def _check_alike(runs: Sequence[wt.Run], data: str | Path) -> None:
    """One network needs weights that mean the same, the same distance apart."""
    first = runs[0]
    for run in runs:
        for what, same in (
            ("layouts", run.layout == first.layout),
            ("cadences", _every(run) == _every(first)),
        ):
            if not same:
                raise TrainError(
                    f"the runs have different {what}",
                    expected=f"as run {first.id}: {first.layout.size} parameters, "
                    f"a snapshot every {_every(first)} gradient steps",
                    got=f"run {run.id}: {run.layout.size} parameters, every {_every(run)}",
                    where=data,
                    do="train on one data set of one policy and one cadence",
                )


def _tokens(run: wt.Run, rank: int) -> TokenRun:
    try:
        return TokenRun.of(embed(run, rank))
    except RepresentationError as error:
        raise TrainError(
            f"run {run.id} has no such coefficients",
            got=error,
            where=run.path,
            do="change --rank, or leave the run out",
        ) from error
