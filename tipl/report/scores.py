"""Which forecasters of a result file are shown, and how their figures are read."""

from __future__ import annotations

from collections.abc import Iterable

from tipl.evaluation.results import Measure, Results, Row, Rows, Scores
from tipl.registry import is_model

PERSISTENCE = "persistence"
BEST = 3
"""Number of baselines that count as the best in weight error."""
GAIN_HORIZON = 50
"""Horizon at which gains are compared, or the largest one below, or else the smallest one."""


def skill(aggregate: str = "ratio_of_sums", starts: str = "all") -> Measure:
    """Return what reads a skill in weights."""
    return lambda scores: scores.skill.get(aggregate, {}).get(starts, ())


def gain(mode: str) -> Measure:
    """Return what reads an inference gain."""
    return lambda scores: scores.gain.get(mode, ())


def repw(mode: str, phase: str) -> Measure:
    """Return what reads a REPW."""
    return lambda scores: scores.repw.get(mode, {}).get(phase, ())


def wpe(scores: Scores) -> Rows:
    """Read the weight prediction error."""
    return scores.wpe


def function_skill(scores: Scores) -> Rows:
    """Read the function skill over all starts."""
    return scores.function_skill.get("all", ())


SKILL = skill()
GAIN = gain("held")
REPW = repw("sampled", "learning")


def row_at(scores: Scores, measure: Measure, h: int) -> Row | None:
    """Return the row of one horizon, if it was measured."""
    return next((row for row in measure(scores) if row.h == h), None)


def models(results: Results) -> list[str]:
    """Return the models; without a recorded kind, names that begin with ``tipl`` are models."""
    return [
        name
        for name, scores in results.forecasters.items()
        if (is_model(scores.kind) if scores.kind else name.startswith("tipl"))
    ]


def oracles(results: Results) -> list[str]:
    """Return the oracles: they are bounds and no forecasts."""
    return [name for name, scores in results.forecasters.items() if scores.is_oracle]


def baselines(results: Results) -> list[str]:
    """Return all others but persistence."""
    known = {PERSISTENCE, *models(results), *oracles(results)}
    return [name for name in results.forecasters if name not in known]


def best(
    results: Results, names: Iterable[str], measure: Measure, h: int, count: int = 1
) -> list[str]:
    """Return the forecasters that are highest in a figure, the highest one first."""
    values = {}
    for name in names:
        row = row_at(results.forecasters[name], measure, h)
        if row is not None and row.value is not None:
            values[name] = row.value
    return sorted(values, key=lambda name: values[name], reverse=True)[:count]


def gain_horizon(results: Results) -> int | None:
    """Return the horizon at which gains are compared; None: they were not measured."""
    measured = [row.h for row in GAIN(results.forecasters[PERSISTENCE])]
    return max((h for h in measured if h <= GAIN_HORIZON), default=min(measured, default=None))


def shown(results: Results) -> list[str]:
    """Return the models, persistence, and the best baselines: three by skill, one by gain."""
    others, h = baselines(results), gain_horizon(results)
    chosen = [*models(results), PERSISTENCE, *best(results, others, SKILL, 10, BEST)]
    if h is not None:
        chosen += best(results, others, GAIN, h)
    return list(dict.fromkeys(chosen))
