"""Which forecasters of a result file matter, and where their figures stand in it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tipl.errors import EvaluateError

Row = dict[str, Any]
"""A figure: ``value``, its interval from ``low`` to ``high``, and ``h``; None: not known."""

COPY = "persistence"
SKILL = ("skill", "ratio_of_sums", "all")
FUNCTION_SKILL = ("function_skill", "all")
GAIN = ("gain", "held")
REPW = ("repw", "sampled", "learning")
MODELS = ("tipl", "gate", "causal", "drift")
"""Kinds that are no baselines."""
BEST = 3
"""So many baselines count as the best in weight error."""
GAIN_HORIZON = 50
"""Gains are compared here, or at the largest horizon below."""


def read_results(file: Path) -> dict[str, Any]:
    """A result file of ``tipl evaluate``.

    Raises:
        EvaluateError: it is none.
        FileNotFoundError: it is not there.
    """
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        known = {"forecasters", "data", "runs", "horizons"} <= document.keys()
    except (ValueError, AttributeError):
        known = False
    if not known:
        raise EvaluateError(
            "the file holds no results",
            expected="results.json, as `tipl evaluate` wrote it",
            where=file,
            do="name that file, or give the command of the evaluation again",
        )
    return dict(document)


def rows_of(scores: dict[str, Any], path: Sequence[str]) -> list[Row]:
    """A row for each horizon of one figure of a forecaster; none: it was not measured."""
    found: Any = scores
    for key in path:
        found = found.get(key, {})
    return list(found or [])


def row_at(scores: dict[str, Any], path: Sequence[str], h: int) -> Row | None:
    """The row of one horizon, if it was measured."""
    return next((row for row in rows_of(scores, path) if row["h"] == h), None)


def models(results: dict[str, Any]) -> list[str]:
    """The networks of this package; of what says no kind, what begins with ``tipl``."""
    return [
        name
        for name, scores in results["forecasters"].items()
        if (kind in MODELS if (kind := scores.get("kind")) else name.startswith("tipl"))
    ]


def floors(results: dict[str, Any]) -> list[str]:
    """What is no forecast, but the truth through a basis."""
    return [name for name, scores in results["forecasters"].items() if scores["floor"]]


def baselines(results: dict[str, Any]) -> list[str]:
    """All others but the copy."""
    known = {COPY, *models(results), *floors(results)}
    return [name for name in results["forecasters"] if name not in known]


def best(
    results: dict[str, Any], names: Iterable[str], path: Sequence[str], h: int, count: int = 1
) -> list[str]:
    """So many of the forecasters that are highest in a figure, the highest one first."""
    values = {}
    for name in names:
        row = row_at(results["forecasters"][name], path, h)
        if row is not None and row["value"] is not None:
            values[name] = row["value"]
    return sorted(values, key=lambda name: values[name], reverse=True)[:count]


def gain_horizon(results: dict[str, Any]) -> int | None:
    """Where gains are compared; None: they were not measured."""
    measured = [row["h"] for row in rows_of(results["forecasters"][COPY], GAIN)]
    return max((h for h in measured if h <= GAIN_HORIZON), default=None)


def that_matter(results: dict[str, Any]) -> list[str]:
    """The models, the copy, and the best baselines: three by skill at h = 10, one by gain."""
    others, h = baselines(results), gain_horizon(results)
    chosen = [*models(results), COPY, *best(results, others, SKILL, 10, BEST)]
    if h is not None:
        chosen += best(results, others, GAIN, h)
    return list(dict.fromkeys(chosen))


__all__ = [
    "COPY",
    "FUNCTION_SKILL",
    "GAIN",
    "REPW",
    "SKILL",
    "Row",
    "baselines",
    "best",
    "floors",
    "gain_horizon",
    "models",
    "read_results",
    "row_at",
    "rows_of",
    "that_matter",
]
