"""Results in plain sentences: do the models beat a copy of the last weights, and who is best?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tipl.report.scores import (
    COPY,
    GAIN,
    SKILL,
    Row,
    baselines,
    best,
    gain_horizon,
    models,
    row_at,
    rows_of,
)
from tipl.report.tables import MODE_NAMES, cell, label

NEAR = 10
"""The paper's horizons end here."""
TOLD = 3
"""So many of the best baselines are told of where no model is ours."""


def verdict(results: dict[str, Any]) -> str:
    """All sentences in one paragraph."""
    return " ".join(paragraphs(results))


def paragraphs(results: dict[str, Any]) -> list[str]:
    """A paragraph for each model, and one about the baselines."""
    names = models(results) or best(results, baselines(results), SKILL, NEAR, TOLD)
    found = [" ".join(_sentences(results, name)) for name in names]
    return [*found, *_rivals(results)]


def _sentences(results: dict[str, Any], name: str) -> Iterator[str]:
    scores = results["forecasters"][name]
    yield _weights(results, name)
    if said := ", ".join(_returns(results, name)):
        yield (
            f"In return, while PPO learns, its error REPW, summed over horizons up to {NEAR}, is "
            f"{said}."
        )
    gains = [row for row in rows_of(scores, GAIN) if row["value"] is not None][-2:]
    if gains:
        yield (
            "As optimisation: of the return that training earns in h snapshots its forecasts earn, "
            f"with the exploration noise of the start, {_listed(gains)} (0 is the copy, 1 is "
            "training itself)."
        )


def _weights(results: dict[str, Any], name: str) -> str:
    """Skill by horizon, and what it says of the model."""
    skills = rows_of(results["forecasters"][name], SKILL)
    better, worse, unclear = (
        ", ".join(str(row["h"]) for row in skills if _sign(row) == sign) for sign in (1, -1, 0)
    )
    if better and worse:
        relation = "splits with"
    elif better:
        relation = "beats"
    elif worse:
        relation = "loses to"
    else:
        relation = "does not clearly differ from"
    shown = [row for row in skills if row["h"] in (1, NEAR, skills[-1]["h"])]
    text = (
        f"In weight error, {label(name)} {relation} copying the last weights{_where(results)}: its "
        f"skill (0 is the copy, 1 the truth) is {_listed(shown)}."
    )
    if better and worse:
        text += f" It is better at h = {better}, worse at h = {worse}."
    elif unclear and (better or worse):
        text += f" It does not clearly differ at h = {unclear}."
    return text


def _where(results: dict[str, Any]) -> str:
    if not results.get("runs"):
        return ""
    seen = "may have been" if results.get("split") == "train" else "was not"
    return f" on {len(results['runs'])} runs that it {seen} trained on"


def _returns(results: dict[str, Any], name: str) -> Iterator[str]:
    """REPW over the copy's, by mode of action."""
    for mode in results["forecasters"][name].get("repw", {}):
        if mode == "held":
            continue
        row = _ratio(results, name, mode)
        if row["value"] is None:
            continue
        judged = ""
        if row["low"] is not None:
            sign = _sign(row | {end: row[end] - 1 for end in ("value", "low", "high")})
            judged = (" (not clearly different)", " (worse)", " (better)")[sign]
        shown = cell(row) if row["low"] is not None else f"{row['value']:.3g}"
        yield f"{shown} times the copy's with {MODE_NAMES[mode]}{judged}"


def _ratio(results: dict[str, Any], name: str, mode: str) -> Row:
    """As the evaluation found it; old files have the sums alone."""
    scores, copy = (results["forecasters"][n] for n in (name, COPY))
    if "repw_ratio" in scores:
        return dict(scores["repw_ratio"][mode])
    ours, theirs = (
        sum(r["value"] for r in each["repw"][mode]["learning"] if r["h"] <= NEAR)
        for each in (scores, copy)
    )
    return {"value": ours / theirs if theirs else None, "low": None, "high": None}


def _sign(row: Row) -> int:
    """1: above 0, -1: below, 0: the interval holds 0."""
    low = row["value"] if row["low"] is None else row["low"]
    high = row["value"] if row["high"] is None else row["high"]
    return 1 if low > 0 else -1 if high < 0 else 0


def _listed(rows: list[Row]) -> str:
    return ", ".join(f"{cell(row)} at h = {row['h']}" for row in rows)


def _rivals(results: dict[str, Any]) -> list[str]:
    """Which baseline is best, in weights and in return."""
    names, scores = baselines(results), results["forecasters"]
    measures: list[tuple[str, tuple[str, ...], int | None]] = [
        ("weight error", SKILL, 1),
        ("weight error", SKILL, NEAR),
        ("inference gain", GAIN, gain_horizon(results)),
    ]
    found = [
        f"in {what} at h = {h}, {label(first)}, {cell(row_at(scores[first], path, h))}"
        for what, path, h in measures
        if h is not None
        for first in best(results, names, path, h)
    ]
    return [f"Best of {len(names)} baselines: {'; '.join(found)}."] if found else []


__all__ = ["paragraphs", "verdict"]
