"""Results in a few plain sentences: what a command prints, and what a page begins with."""

from __future__ import annotations

from collections.abc import Iterator

from tipl.evaluation.results import Results, Row
from tipl.report.scores import (
    GAIN,
    SKILL,
    baselines,
    best,
    gain_horizon,
    models,
    oracles,
    row_at,
)
from tipl.report.tables import cell, label

NEAR = (1, 10)
"""Horizons at which skills are told, where these were measured."""
STRETCHED = "-stretched"
"""End of the names of baselines whose displacement is stretched by a factor, chosen by returns."""
TOLD = 3
"""Number of the best baselines that are described where there is no model."""


def sentences(results: Results) -> list[str]:
    """Return what was done, what was found, and how sure it is; one sentence each."""
    return [_opening(results), *findings(results), *_bound(results), _certainty(results)]


def findings(results: Results) -> list[str]:
    """Return one sentence for each model, and some about the best baselines."""
    names = models(results) or best(results, baselines(results), SKILL, NEAR[-1], TOLD)
    return [*(_finding(results, name) for name in names), *_baselines(results)]


def _opening(results: Results) -> str:
    ours = models(results)
    who = "The models forecast" if len(ours) != 1 else f"{label(ours[0])} forecasts"
    they = "they were" if len(ours) != 1 else "it was"
    if not ours:
        who, they = "The baselines forecast", "they were"
    seen = (
        "that they may have been trained on"
        if results.split == "train"
        else f"that {they} not trained on"
    )
    runs = f"{len(results.runs)} runs" if len(results.runs) != 1 else "1 run"
    gain = (
        "; gain is what the forecast adds to the return, divided by what h more snapshots of "
        "training add"
    )
    return (
        f"{who} the weights of {runs} {seen}, h snapshots ahead. Persistence repeats the last "
        "weights. Skill compares squared errors of the weights: it is 1 for a perfect forecast "
        f"and 0 for persistence{gain if gain_horizon(results) is not None else ''}."
    )


def _finding(results: Results, name: str) -> str:
    """Return the sentence about one forecaster: skill of its weights, then the gain."""
    scores = results.forecasters[name]
    who = label(name) if scores.causal else f"{label(name)}, which uses the future of the run,"
    said = [f"{who} has skill {_skills(results, name)}"]
    h = gain_horizon(results)
    gained = None if h is None else row_at(scores, GAIN, h)
    if gained is not None and gained.value is not None:
        said.append(f"its gain is {cell(gained)} at h = {gained.h}")
    return f"{'; '.join(said)}."


def _skills(results: Results, name: str) -> str:
    """Return the skill at each horizon that is told: 0.50 [0.49, 0.51] at h = 1 and ..."""
    rows = [row_at(results.forecasters[name], SKILL, h) for h in _near(results)]
    return " and ".join(f"{cell(row)} at h = {row.h}" for row in rows if row is not None)


def _near(results: Results) -> list[int]:
    measured = list(results.horizons)
    return [h for h in NEAR if h in measured] or measured[:1]


def _baselines(results: Results) -> Iterator[str]:
    """Yield the best baselines, if there are several, in weights and in return."""
    names, h = baselines(results), gain_horizon(results)
    if len(names) < 2:
        return
    for first in best(results, names, SKILL, _near(results)[-1]):
        yield (
            f"{label(first)} has the highest skill of {len(names)} baselines: "
            f"{_skills(results, first)}."
        )
    for first in best(results, names, GAIN, h) if h is not None else ():
        row = row_at(results.forecasters[first], GAIN, h or 0)
        yield f"{label(first)} has the highest gain of these baselines: {cell(row)} at h = {h}."
        yield from _compared(results, first, h or 0)


def _compared(results: Results, baseline: str, h: int) -> Iterator[str]:
    """Yield what it means if the best model and the best baseline cannot be told apart in gain."""
    for model in best(results, models(results), GAIN, h):
        one, other = (row_at(results.forecasters[name], GAIN, h) for name in (model, baseline))
        if one is None or other is None or not _overlap(one, other):
            continue
        yield (
            f"The intervals of {label(model)} and {label(baseline)} overlap: these runs do not "
            "show which one gains more."
        )


def _overlap(one: Row, other: Row) -> bool:
    """Say whether two intervals have a value in common; False if one of them is missing."""
    if one.low is None or one.high is None or other.low is None or other.high is None:
        return False
    return one.low <= other.high and other.low <= one.high


def _bound(results: Results) -> Iterator[str]:
    if found := [label(name) for name in oracles(results)]:
        what = "is not a forecast" if len(found) == 1 else "are not forecasts"
        yield (
            f"{' and '.join(found)} {what}: the true future weights, compressed to the "
            "number of coefficients that TIPL writes, and back. TIPL cannot do better than that; "
            "other models can."
        )


def _certainty(results: Results) -> str:
    look = "This is a quick evaluation, with few starts and episodes; " if results.quick else ""
    if len(results.runs) < 2:
        return f"{look}{'with' if look else 'With'} one run there are no intervals."
    return f"{look}{'brackets' if look else 'Brackets'} hold 95 % intervals over runs."
