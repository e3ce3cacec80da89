"""What a study writes: the curves of all runs, and the figures that compare its arms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from tipl.errors import EvaluateError

SCHEMA = 1
"""Version of the schema."""


class Cpu(msgspec.Struct, frozen=True, kw_only=True):
    """CPU seconds."""

    training: float
    """Rollouts and updates, forecasts included."""
    forecasts: float
    """Forecasts and keeping the paths."""
    evaluation: float
    """Episodes that measure J."""


class Curve(msgspec.Struct, frozen=True, kw_only=True):
    """One training."""

    seed: int
    returns: list[float | None]
    """Mean return J at each evaluation, six digits; null: a simulation became unstable."""
    accepted: int = 0
    """Number of jumps that stand."""
    refused: int = 0
    """Number of jumps that the guard did not let happen."""
    undone: int = 0
    """Number of jumps that were taken back."""


class Series(msgspec.Struct, frozen=True, kw_only=True):
    """Trainings of one arm on one task."""

    task: str
    arm: str
    trial: str
    """Name of the arm, and the values of its grid."""
    settings: dict[str, Any]
    """What distinguishes it from plain PPO."""
    num_timesteps: list[int]
    """Environment steps at each evaluation."""
    curves: list[Curve]
    """One for each seed, in the order of the seeds."""
    cpu: Cpu


class Figure(msgspec.Struct, frozen=True, kw_only=True):
    """A comparison of one arm with another one on a task."""

    task: str
    arm: str
    against: str
    name: str
    """``steps to 75 %``: ratio of environment steps; ``final``, ``area``, ``worst decile``:
    difference of returns over the other's."""
    value: float | None
    low: float | None
    """Lower end of the 95 % interval."""
    high: float | None
    """Upper end of it."""
    censored: int = 0
    """Number of trainings of the arm that never reached the threshold."""
    censored_against: int = 0
    """Number of trainings of the other arm that never reached it."""


class LiveResults(msgspec.Struct, frozen=True, kw_only=True):
    """Results of one stage of a study."""

    live: int = SCHEMA
    """Version of the schema."""
    study: str
    stage: str
    baseline: str
    rival: str
    plan: dict[str, Any]
    """The plan, as it was read."""
    thresholds: dict[str, dict[str, float]]
    """Return of each threshold, by task and share in per cent."""
    final: dict[str, dict[str, float]]
    """Interquartile mean of the final return, by task and trial."""
    best: dict[str, dict[str, str]]
    """Best trial of each arm, by task and arm."""
    scores: dict[str, dict[str, float]]
    """What tuning minimises, by task and trial: the geometric mean over thresholds and seeds of the
    ratio of environment steps, against the baseline."""
    primary: dict[str, str]
    """By task, the arm that forecasts and was best on the tuning seeds, the rival aside."""
    series: list[Series]
    figures: list[Figure]
    command: str
    """The command that made the file."""


def read_live(file: Path) -> LiveResults:
    """Read the results of a study.

    Raises:
        EvaluateError: the file holds none.
    """
    try:
        results = msgspec.json.decode(file.read_bytes(), type=LiveResults)
        if results.live != SCHEMA:
            raise ValueError(f"version {results.live} of the schema, not {SCHEMA}")
    except (ValueError, RecursionError) as error:
        raise EvaluateError(
            "the file holds no results of a study",
            expected="results.json, as `tipl live` writes it",
            got=error,
            where=file,
            do="run `tipl live` again",
        ) from error
    return results


def is_live(file: Path) -> bool:
    """Say whether a file holds results of a study, and not those of an evaluation."""
    with file.open("rb") as opened:
        return b'"live":' in opened.read(64)
