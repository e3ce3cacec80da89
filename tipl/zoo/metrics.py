"""What is known of a released model: ``metrics.json`` beside its weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from tipl.checks.results import CheckResults
from tipl.errors import ModelError
from tipl.evaluation.results import Results, Scores, TaskScore

FILE = "metrics.json"


@dataclass(frozen=True, kw_only=True)
class TrainedOn:
    """The runs that a model was trained on."""

    data: str
    """Id of the data set."""
    version: str
    """Version of the data set."""
    runs: tuple[str, ...]
    """Ids of the runs."""
    environment: str | None
    """Id of the environment; None: not recorded."""
    algorithm: str | None
    """Algorithm that trained the policies; None: not recorded."""
    every: int | None
    """Number of gradient steps from one snapshot to the next; None: not recorded."""
    parameters: int
    """Number of parameters of one policy."""


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Everything that a card says in numbers."""

    name: str
    """Name in the zoo."""
    kind: str
    """Which forecaster it is."""
    causal: bool
    """Whether a forecast from t uses nothing that comes after t."""
    fingerprint: str
    """SHA-256 of the files that were evaluated, and that lie beside this one."""
    evaluated_as: str
    """Its name in ``results``."""
    results: Results
    """A result file, reduced to the forecasters and figures that a card shows."""
    trained_on: tuple[TrainedOn, ...] = ()
    """What it was trained on, one entry for each data set; empty: not recorded."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the training."""
    log: list[dict[str, float]] = field(default_factory=list)
    """Some lines of the training's log: ``batch``, and errors on training and validation runs."""
    tasks: tuple[TaskScore, ...] = ()
    """Scores on several tasks, of all trainings of the model, from the rows of a leaderboard."""
    checks: CheckResults | None = None
    """What ``tipl check`` wrote; None: not checked."""

    @property
    def scores(self) -> Scores:
        """Return the model's own figures."""
        return self.results.forecasters[self.evaluated_as]


def read_metrics(folder: Path) -> Metrics | None:
    """Return what is known of the model in a folder; None: it was never evaluated.

    Raises:
        ModelError: the file is damaged.
    """
    file = folder / FILE
    if not file.exists():
        return None
    try:
        return msgspec.json.decode(file.read_bytes(), type=Metrics)
    except msgspec.DecodeError as error:
        raise ModelError(
            "the metrics of the model cannot be read",
            expected=f"{FILE} as `tipl release` writes it",
            got=error,
            where=file,
            do="release the model again",
        ) from error
