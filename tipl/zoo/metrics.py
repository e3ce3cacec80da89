"""What is known of a released model: ``metrics.json`` beside its weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from tipl.errors import ModelError

FILE = "metrics.json"


@dataclass(frozen=True, kw_only=True)
class TrainedOn:
    """The runs that a model learnt from."""

    data: str
    """Id of the data set."""
    version: str
    """Version of the data set."""
    runs: tuple[str, ...]
    """Ids of the runs."""
    environment: str | None
    """Id of the environment; None: not said."""
    algorithm: str | None
    """What trained the policies; None: not said."""
    every: int | None
    """Gradient steps from one snapshot to the next; None: not said."""
    parameters: int
    """Of one policy."""


@dataclass(frozen=True, kw_only=True)
class Metrics:
    """Everything that a card says in numbers."""

    name: str
    """In the zoo."""
    kind: str
    """Which forecaster it is."""
    causal: bool
    """Whether a forecast from t uses nothing that comes after t."""
    fingerprint: str
    """Of the bytes that were judged, and that lie beside this file."""
    judged_as: str
    """Its name in ``results``."""
    results: dict[str, Any]
    """A result file, of those that matter and of the figures that matter."""
    trained_on: tuple[TrainedOn, ...] = ()
    """What it learnt from, a data set each; empty: it was not trained by a command that says."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Of the training."""
    log: list[dict[str, float]] = field(default_factory=list)
    """Some lines of the training's log: ``batch``, and errors on training and validation runs."""
    checks: dict[str, Any] | None = None
    """What ``tipl check`` wrote; None: not checked."""

    @property
    def scores(self) -> dict[str, Any]:
        """The model's own figures."""
        return dict(self.results["forecasters"][self.judged_as])


def read_metrics(folder: Path) -> Metrics | None:
    """What is known of the model in a folder; None: it was never judged.

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
            "what is known of the model cannot be read",
            expected=f"{FILE} as `tipl release` writes it",
            got=error,
            where=file,
            do="release the model again",
        ) from error


def write_metrics(folder: Path, metrics: Metrics) -> None:
    """Put the file beside the model."""
    (folder / FILE).write_text(json.dumps(asdict(metrics), indent=1) + "\n")


__all__ = ["FILE", "Metrics", "TrainedOn", "read_metrics", "write_metrics"]
