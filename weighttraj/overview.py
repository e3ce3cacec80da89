"""What a data set holds, at a glance: a dozen lines, however many runs."""

from __future__ import annotations

import html
from collections import Counter
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from weighttraj.errors import WeightTrajError
from weighttraj.format.schema import DatasetInfo, Evaluation
from weighttraj.store.objects import bytes_in
from weighttraj.text import printable

Row = tuple[str, str]
"""A label and what stands beside it."""


@runtime_checkable
class _Runs(Protocol):
    """What of a data set is shown; see ``Dataset``."""

    path: Any
    info: DatasetInfo
    runs: list[Any]


def as_text(dataset: _Runs) -> str:
    """Return the overview for a terminal."""
    rows = _rows(dataset)
    width = max(len(label) for label, _ in rows)
    lines = [f"  {label:<{width}}  {printable(value)}" for label, value in rows]
    return "\n".join([f"<Dataset {printable(_title(dataset.info))}>", *lines])


def as_html(dataset: _Runs) -> str:
    """Return the overview for a notebook."""
    cells = "".join(
        f"<tr><th style='text-align:left'>{html.escape(label)}</th>"
        f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
        for label, value in _rows(dataset)
    )
    title = html.escape(_title(dataset.info))
    return f"<div><strong>Dataset {title}</strong><table>{cells}</table></div>"


def _title(info: DatasetInfo) -> str:
    return f"{info.id}, version {info.version}, {status_of(info)}"


def status_of(info: DatasetInfo) -> str:
    """Return the status; a complete data set that holds some runs of another is a complete part."""
    return "complete part" if info.part and info.status == "complete" else info.status


def _rows(dataset: _Runs) -> list[Row]:
    rows = [("runs", _runs(dataset))]
    if dataset.runs:
        rows += _first(dataset.runs[0])
    size = _size(dataset.path)
    where = f"{dataset.path}{f', {size}' if size else ''}"
    return [*rows, ("licence", dataset.info.licence), ("path", where)]


def _runs(dataset: _Runs) -> str:
    counts = Counter(run.split or "in no split" for run in dataset.runs)
    splits = ", ".join(f"{count} {split}" for split, count in counts.items())
    part = f"; a part: {dataset.info.part} runs of the whole" if dataset.info.part else ""
    return f"{len(dataset.runs)} runs{f': {splits}' if splits else ''}{part}"


def _first(run: Any) -> list[Row]:
    """Return what the first run tells; only its metadata are read."""
    try:
        info = run.info
    except (WeightTrajError, OSError) as error:
        return [("first run", f"cannot be read: {str(error).splitlines()[0]}")]
    rows = []
    if info.env is not None or info.algorithm is not None:
        names = (part for part in (info.algorithm, info.env) if part is not None)
        rows.append(("training", " on ".join(getattr(n, "name", "") or n.id for n in names)))
    weights = f"weights float32 (time {info.n_committed}, param {info.layout.size})"
    cadence = f", one every {info.cadence.every} gradient steps" if info.cadence else ""
    rows.append(("first run", f"{run.id}: {weights}{cadence}, {info.status}"))
    groups = sorted({name.partition("/")[0] for name in run.keys()})  # noqa: SIM118  no mapping
    rows.append(("arrays", ", ".join(groups)))
    rows.append(("returns", _returns(info.evaluation)))
    return rows


def _returns(evaluation: Evaluation | None) -> str:
    if evaluation is None:
        return "none stored in the first run"
    counts = Counter(evaluation.deterministic)
    modes = ((True, "deterministic"), (False, "sampled"))
    episodes = " and ".join(f"{counts[mode]} {name}" for mode, name in modes if counts[mode])
    also = " and others" if evaluation.first or evaluation.learning else ""
    return f"{episodes} episodes of every {evaluation.every}th snapshot, the last{also}"


def _size(path: Any) -> str:
    """Return the size of a data set on this machine; empty where it lies elsewhere."""
    if not isinstance(path, Path):
        return ""
    return f"{bytes_in(path) / 1e6:,.1f} MB"
