"""What an evaluation finds: one schema for all that writes, reads, reports and releases results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from tipl.errors import EvaluateError
from weighttraj.atomic import replace_file
from weighttraj.errors import FormatError
from weighttraj.store.objects import read_plain


class Interval(msgspec.Struct, frozen=True, kw_only=True):
    """A figure with its 95 % interval; None: not measured."""

    value: float | None
    low: float | None = None
    high: float | None = None


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """A figure at one horizon, with its 95 % interval; None: not measured."""

    h: int
    """Number of snapshots ahead."""
    value: float | None
    low: float | None = None
    high: float | None = None


class GainRow(Row, frozen=True, kw_only=True):
    """An inference gain, and the mean returns that it comes from."""

    now: float | None = None
    """Return of the policies at the starts."""
    later: float | None = None
    """Return of the policies that training made of them."""
    forecast: float | None = None
    """Return of the forecast policies."""


class Points(msgspec.Struct, frozen=True, kw_only=True):
    """Returns of true and forecast policies of one run, for the paper's scatter."""

    run: str
    true: tuple[float | None, ...]
    forecast: tuple[float | None, ...]


Rows = tuple[Row, ...]


class Scores(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All figures of one forecaster. What was not measured is empty."""

    kind: str | None = None
    """Kind of the forecaster; unset: not recorded."""
    causal: bool
    """Whether it sees nothing that comes after a start."""
    is_oracle: bool = False
    """Whether it reads the true future, and so is a bound and not a forecast."""
    fingerprint: str | None = None
    """SHA-256 of the files that it saves; unset: not recorded."""
    skill: dict[str, dict[str, Rows]] = {}
    """Skill by aggregate and kind of start."""
    wpe: Rows = ()
    """Weight prediction error."""
    function_skill: dict[str, Rows] = {}
    """Function skill by kind of start."""
    repw: dict[str, dict[str, Rows]] = {}
    """REPW by mode of action and phase."""
    repw_ratio: dict[str, Interval] = {}
    """REPW over persistence's by mode of action, summed over the paper's horizons."""
    gain: dict[str, tuple[GainRow, ...]] = {}
    """Inference gain by mode of action."""
    scatter: dict[str, tuple[Points, ...]] = {}
    """Returns by mode of action."""


class StartCounts(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers of starts over all runs."""

    weights: int
    policies: int
    learning: int
    plateau: int


class TaskScore(msgspec.Struct, frozen=True, kw_only=True):
    """The score of a forecaster on one task, at one horizon."""

    task: str
    measure: str
    horizon: int
    forecaster: str
    score: Interval
    lead: Interval
    """The score minus the chosen rival's, of the same draws; unset: rival not evaluated."""
    runs: int
    """Number of runs."""
    trainings: int
    """Number of trainings of the forecaster."""


class Results(msgspec.Struct, frozen=True, kw_only=True):
    """What ``results.json`` holds."""

    format: Literal[1] = 1
    """Version of the schema."""
    data: str
    """Id of the data set."""
    version: str
    """Version of the data set."""
    split: str
    """Split of the runs."""
    runs: tuple[str, ...]
    """Ids of the runs that forecasters were evaluated on."""
    left_out: dict[str, str] = {}
    """Runs of the split that could not be evaluated on, and why."""
    failed: dict[str, str] = {}
    """Forecasters that could not be evaluated, and why."""
    env_steps_per_snapshot: float | None = None
    """Mean number of environment steps from one snapshot to the next; unset: not recorded."""
    horizons: tuple[int, ...]
    """Numbers of snapshots ahead for weights."""
    return_horizons: tuple[int, ...]
    """Numbers of snapshots ahead for returns."""
    modes: tuple[str, ...]
    """Modes of action in which returns were measured."""
    episodes: int
    """Number of episodes for the return of a policy."""
    seed: int
    """Seed of episodes and resamples."""
    quick: bool
    """Whether fewer starts and episodes were taken than usual."""
    starts: StartCounts
    """How many starts were taken."""
    noise_floor: dict[str, float] = {}
    """Mean difference of true returns over two sets of episodes, by mode."""
    forecasters: dict[str, Scores]
    """Figures by name of the forecaster."""
    command: str
    """The command that made them."""


_MOST = 2**28
"""Bytes that a result file may have."""

Measure = Callable[[Scores], Sequence[Row]]
"""Reads one figure of a forecaster: a row for each horizon, or nothing."""


def read_results(file: Path) -> Results:
    """Read a result file of ``tipl evaluate``.

    Raises:
        EvaluateError: it is none, or its schema has another version.
        FileNotFoundError: it is not there.
    """
    try:
        return msgspec.json.decode(_content(file), type=Results)
    except (msgspec.DecodeError, RecursionError, FormatError) as error:
        raise EvaluateError(
            "the file holds no results",
            expected="results.json, as `tipl evaluate` writes it",
            got=error,
            where=file,
            do="evaluate again",
        ) from error


def _content(file: Path) -> bytes:
    """Return the bytes of a result file, which a stranger may have sent.

    Raises:
        FileNotFoundError: it is not there.
        FormatError: it is no plain file, or too large.
    """
    if not file.exists():
        raise FileNotFoundError(f"no results at {file}")
    return read_plain(file.resolve(), _MOST)  # a link of the user's own is followed


def write_document(file: Path, document: Any) -> None:
    """Write a document as indented JSON."""
    file.parent.mkdir(parents=True, exist_ok=True)
    text = msgspec.json.format(msgspec.json.encode(document), indent=1)
    replace_file(file, text + b"\n", root=file.parent)
