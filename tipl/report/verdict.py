"""Results in plain sentences: do the models beat persistence, and which baseline is best?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tipl.evaluation.results import Interval, Measure, Results, Row
from tipl.report.scores import (
    GAIN,
    PERSISTENCE,
    SKILL,
    baselines,
    best,
    gain_horizon,
    models,
    repw,
    row_at,
)
from tipl.report.tables import MODE_NAMES, cell, label

NEAR = 10
"""The paper's horizons end here."""
TOLD = 3
"""Number of the best baselines that are described where there is no model."""


def verdict(results: Results) -> str:
    """Return all sentences in one paragraph."""
    return " ".join(paragraphs(results))


def paragraphs(results: Results) -> list[str]:
    """Return a paragraph for each model, and one about the baselines."""
    names = models(results) or best(results, baselines(results), SKILL, NEAR, TOLD)
    found = [" ".join(_sentences(results, name)) for name in names]
    return [*found, *_rivals(results)]


def _sentences(results: Results, name: str) -> Iterator[str]:
    scores = results.forecasters[name]
    yield _weights(results, name)
    if said := ", ".join(_returns(results, name)):
        yield (
            f"In return, while PPO learns, its error REPW, summed over horizons up to {NEAR}, is "
            f"{said}."
        )
    gains = [row for row in GAIN(scores) if row.value is not None][-2:]
    if gains:
        yield (
            "As optimisation: of the return that training earns in h snapshots its forecasts earn, "
            f"with the exploration noise of the start, {_listed(gains)} (0 is persistence, 1 "
            "is training itself)."
        )


def _weights(results: Results, name: str) -> str:
    """Return a sentence about the skill by horizon."""
    skills = SKILL(results.forecasters[name])
    better, worse, unclear = (
        ", ".join(str(row.h) for row in skills if _sign(row) == sign) for sign in (1, -1, 0)
    )
    if better and worse:
        relation = "splits with"
    elif better:
        relation = "beats"
    elif worse:
        relation = "loses to"
    else:
        relation = "does not clearly differ from"
    shown = [row for row in skills if row.h in (1, NEAR, skills[-1].h)]
    text = (
        f"In weight error, {label(name)} {relation} persistence{_where(results)}: its "
        f"skill (0 is persistence, 1 the truth) is {_listed(shown)}."
    )
    if better and worse:
        text += f" It is better at h = {better}, worse at h = {worse}."
    elif unclear and (better or worse):
        text += f" It does not clearly differ at h = {unclear}."
    return text


def _where(results: Results) -> str:
    if not results.runs:
        return ""
    seen = "may have been" if results.split == "train" else "was not"
    return f" on {len(results.runs)} runs that it {seen} trained on"


def _returns(results: Results, name: str) -> Iterator[str]:
    """Yield REPW over persistence's, by mode of action."""
    for mode in results.forecasters[name].repw:
        if mode == "held":
            continue
        row = _ratio(results, name, mode)
        if row.value is None:
            continue
        if row.low is None or row.high is None:
            yield f"{row.value:.3g} times that of persistence with {MODE_NAMES[mode]}"
            continue
        above = Interval(value=row.value - 1, low=row.low - 1, high=row.high - 1)
        verdict = (" (not clearly different)", " (worse)", " (better)")[_sign(above)]
        yield f"{cell(row)} times that of persistence with {MODE_NAMES[mode]}{verdict}"


def _ratio(results: Results, name: str, mode: str) -> Interval:
    """Return the ratio as the evaluation found it; old files have the sums alone."""
    scores, persistence = (results.forecasters[n] for n in (name, PERSISTENCE))
    if mode in scores.repw_ratio:
        return scores.repw_ratio[mode]
    ours, theirs = (
        sum(row.value or 0 for row in repw(mode, "learning")(each) if row.h <= NEAR)
        for each in (scores, persistence)
    )
    return Interval(value=ours / theirs if theirs else None)


def _sign(row: Row | Interval) -> int:
    """Return 1 above 0, -1 below, 0 where the interval holds 0."""
    if row.value is None:
        return 0
    low = row.value if row.low is None else row.low
    high = row.value if row.high is None else row.high
    return 1 if low > 0 else -1 if high < 0 else 0


def _listed(rows: Sequence[Row]) -> str:
    return ", ".join(f"{cell(row)} at h = {row.h}" for row in rows)


def _rivals(results: Results) -> list[str]:
    """Return which baseline is best, in weights and in return."""
    names, scores = baselines(results), results.forecasters
    measures: list[tuple[str, Measure, int | None]] = [
        ("weight error", SKILL, 1),
        ("weight error", SKILL, NEAR),
        ("inference gain", GAIN, gain_horizon(results)),
    ]
    found = [
        f"in {what} at h = {h}, {label(first)}, {cell(row_at(scores[first], measure, h))}"
        for what, measure, h in measures
        if h is not None
        for first in best(results, names, measure, h)
    ]
    return [f"Best of {len(names)} baselines: {'; '.join(found)}."] if found else []
