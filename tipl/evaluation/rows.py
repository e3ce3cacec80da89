"""One line for each task, forecaster, measure, horizon and run: what a leaderboard is made of.

``tipl evaluate`` writes ``rows.csv`` beside ``results.json``. A file of the same columns that
somebody else made joins a leaderboard as it is.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

import weighttraj as wt
from tipl.errors import EvaluateError
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.measure import Measured
from tipl.evaluation.returns import MODES
from tipl.evaluation.starts import shares
from tipl.runs import checksum_of
from weighttraj import Run
from weighttraj.atomic import replacing

Measure = Literal["skill", "function skill", "gain"]
Seen = Literal["this", "others", "nothing", "unknown"]


class TaskRow(msgspec.Struct, frozen=True, kw_only=True):
    """A forecaster's error on one run. Its score is 1 - sum of error / sum of reference."""

    task: str
    """Id of the data set."""
    fingerprint: str
    """SHA-256 (hex) of the runs that were evaluated on."""
    split: str
    """Split of the run."""
    measure: Measure
    """``skill``: squared errors of weights; ``function skill``: divergences of policies; ``gain``:
    returns in the learning phase, sampled with the ``log_std`` of the start."""
    horizon: int
    """Snapshots ahead."""
    run: str
    """Id of the run."""
    forecaster: str
    """Name of the forecaster. ``gate@2`` is the second training of ``gate``."""
    error: float
    """Of the forecasts, summed over the starts. Gain: what training earned and they did not."""
    reference: float
    """Of persistence, summed over the same starts. Gain: what training earned."""
    trained_on: Seen = "unknown"
    """Whether it was trained on runs of this data set, of others, or on none."""
    oracle: bool = False
    """Whether it reads the true future, and so is a bound and not a forecast."""
    wall_seconds: float | None = None
    """Time that one forecast of all horizons took, a mean over the starts; unset: not measured."""
    cpu_seconds: float | None = None
    """CPU time of the same."""


def rows_of(
    measured: Sequence[Measured],
    config: EvaluateConfig,
    *,
    task: str,
    fingerprint: str,
    persistence: str,
    failed: Container[str] = (),
    trained_on: dict[str, Seen],
    oracles: Iterable[str] = (),
) -> Iterator[TaskRow]:
    """Yield the rows of what was measured, persistence's own among them."""
    for m in measured:
        for name in (name for name in m.weights if name not in failed):
            wall, cpu = m.weights[name].get("seconds", (None, None))  # unset in old files
            for measure, horizons, error, reference in _sums(m, config, name, persistence):
                for j, h in enumerate(horizons):
                    if np.isfinite(error[j]) and np.isfinite(reference[j]):
                        yield TaskRow(
                            task=task,
                            fingerprint=fingerprint,
                            split=config.split,
                            measure=measure,
                            horizon=h,
                            run=m.run,
                            forecaster=name,
                            error=float(error[j]),
                            reference=float(reference[j]),
                            trained_on=trained_on.get(name, "unknown"),
                            oracle=name in set(oracles),
                            wall_seconds=wall if wall is None else float(wall),
                            cpu_seconds=cpu if cpu is None else float(cpu),
                        )


def _sums(
    m: Measured, config: EvaluateConfig, name: str, persistence: str
) -> Iterator[
    tuple[Literal["skill", "function skill", "gain"], Sequence[int], np.ndarray, np.ndarray]
]:
    """Yield each measure of one run: its horizons, errors and reference errors."""
    share = shares(m.starts.weights)
    squared = (m.weights[each]["squared"].sum(2) for each in (name, persistence))
    error, reference = (share @ each for each in squared)
    yield "skill", config.horizons, error, reference
    if m.functions:
        share = shares(m.function_starts)
        error, reference = (share @ m.functions[each]["kl"] for each in (name, persistence))
        yield "function skill", config.horizons, error, reference
    if m.true and len(m.starts.learning):
        mode, n = MODES.index("held"), len(m.starts.learning)
        now, later = m.true["now"][mode][:n, None], m.true["later"][mode][:n]
        forecast = m.returns[name]["forecast"][mode][:n]
        yield "gain", config.return_horizons, (later - forecast).sum(0), (later - now).sum(0)


def data_fingerprint(runs: Sequence[Run]) -> str:
    """Return the SHA-256 (hex) of the ids and the weights of some runs."""
    lines = sorted(f"{run.id} {checksum_of(run)}" for run in runs)
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def trained_on(folder: Path | None, dataset: wt.Dataset) -> Seen:
    """Return what a forecaster was trained on, as its folder tells: train.json or metrics.json.

    Args:
        folder: where it was saved; None: nowhere, as it needs no training.
        dataset: the data set that it is evaluated on.
    """
    if folder is None:
        return "nothing"
    for file, ids in (("train.json", _trained_ids), ("metrics.json", _released_ids)):
        if (path := folder / file).is_file():
            try:
                known = ids(json.loads(path.read_bytes()))
            except (OSError, ValueError, TypeError, KeyError, AttributeError):
                return "unknown"
            return "this" if dataset.info.id in known else "others" if known else "unknown"
    return "unknown"


def _trained_ids(settings: dict[str, Any]) -> set[str]:
    data = settings["data"]
    return {wt.open_dataset(name).info.id for name in ([data] if isinstance(data, str) else data)}


def _released_ids(metrics: dict[str, Any]) -> set[str]:
    return {str(part["data"]) for part in metrics["trained_on"]}


def write_rows(file: Path, rows: Iterable[TaskRow]) -> None:
    """Write rows as CSV with a header; figures have nine digits."""
    names = TaskRow.__struct_fields__
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values = (getattr(row, name) for name in names)
        writer.writerow([f"{v:.9g}" if isinstance(v, float) else v for v in values])
    with replacing(file) as stream:
        stream.write(text.getvalue().encode())


def read_rows(file: Path) -> list[TaskRow]:
    """Read a CSV file of rows.

    Raises:
        EvaluateError: it has other columns, or a value of another kind.
        FileNotFoundError: there is no such file.
    """
    with file.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        rows = []
        for number, line in enumerate(reader, start=2):
            try:
                known = {k: v for k, v in line.items() if v not in (None, "")}
                known["oracle"] = known.get("oracle", "false").lower()
                rows.append(msgspec.convert(known, TaskRow, strict=False))
            except msgspec.ValidationError as error:
                raise EvaluateError(
                    "this line is no row of a leaderboard",
                    expected=f"the columns {', '.join(TaskRow.__struct_fields__)}",
                    got=error,
                    where=f"{file}, line {number}",
                    do="write rows.csv as `tipl evaluate` does; docs/evaluate.md has an example",
                ) from error
    if not rows:
        raise EvaluateError(
            "the file holds no rows",
            expected=f"a header and lines of {', '.join(TaskRow.__struct_fields__)}",
            where=file,
            do="evaluate a forecaster first: tipl evaluate FORECASTER --data DATASET --out FOLDER",
        )
    return rows
