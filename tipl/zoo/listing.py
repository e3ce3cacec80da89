"""A released model in one line, for ``tipl zoo``."""

from __future__ import annotations

from tipl import registry
from tipl.report.scores import GAIN, SKILL, row_at
from tipl.report.tables import cell
from tipl.zoo.metrics import read_metrics

HEADLINE = {
    "skill, h = 1": (SKILL, 1),
    "skill, h = 10": (SKILL, 10),
    "gain, h = 50": (GAIN, 50),
}
"""Columns that sum a model up: a figure and its horizon."""


def listed(name: str, *, interval: bool = True) -> tuple[str, ...]:
    """Return a line of ``tipl zoo``: name, kind, causal, data set, and ``HEADLINE`` figures."""
    folder = registry.MODELS / name
    metrics = read_metrics(folder)
    if metrics is None:
        return (name, registry.kind_in(folder), *["-"] * (2 + len(HEADLINE)))
    rows = [row_at(metrics.scores, measure, h) for measure, h in HEADLINE.values()]
    figures = [cell(row, interval=interval) for row in rows]
    causal = "yes" if metrics.causal else "no"
    return (name, metrics.kind, causal, metrics.results.data, *figures)
