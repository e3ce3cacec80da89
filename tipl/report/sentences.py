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
from tipl.report.tables import label

NEAR = (1, 10)
"""Horizons at which weight errors are told, where these were measured."""
TOLD = 3
"""Number of the best baselines that are described where there is no model."""


def sentences(results: Results) -> list[str]:
    """Return what was done, what was found, and how sure it is; one sentence each."""
    return [_opening(results), *findings(results), *_bound(results), _certainty(results)]


def findings(results: Results) -> list[str]:
    """Return one sentence for each model, and one about the best baselines."""
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
    return (
        f"{who} the weights of {runs} {seen}, h snapshots ahead; persistence, the forecast to "
        "beat, repeats the last weights, and errors are squared errors of the weights."
    )


def _finding(results: Results, name: str) -> str:
    """Return the sentence about one forecaster: errors of weights, then the return it gains."""
    scores = results.forecasters[name]
    who = label(name) if scores.causal else f"{label(name)}, which uses the future of the run,"
    said = f"{who} {' and '.join(_errors(results, name))}"
    h = gain_horizon(results)
    gained = None if h is None else row_at(scores, GAIN, h)
    if gained is not None and gained.value is not None:
        said += (
            f"; its policies gain {_percent(gained)} of the return that training gains in "
            f"{gained.h} snapshots"
        )
    return f"{said}."


def _errors(results: Results, name: str) -> Iterator[str]:
    """Yield what each skill means; words that would be repeated are left out."""
    before = ""
    for h in _near(results):
        row = row_at(results.forecasters[name], SKILL, h)
        if row is None or row.value is None:
            continue
        verb, amount, of = _error(row)
        same = verb == before and bool(amount)
        before = verb
        yield f"{amount} at h = {h}" if same else f"{verb} {amount}{of} at h = {h}"


def _near(results: Results) -> list[int]:
    measured = list(results.horizons)
    return [h for h in NEAR if h in measured] or measured[:1]


def _error(row: Row) -> tuple[str, str, str]:
    """Return the part of the error that is removed, or its multiple: verb, amount, of what."""
    value = row.value or 0
    low = value if row.low is None else row.low
    high = value if row.high is None else row.high
    error = "the error of persistence"
    if low <= 0 <= high:
        return "has", "", f"about {error}"
    if value > 0:
        return "removes", _percent(row), f" of {error}"
    return "has", _times(row), f" {error}"


def _percent(row: Row) -> str:
    """Return a share with its interval: 50 % [40, 61]."""
    text = f"{100 * (row.value or 0):.0f} %"
    if row.low is not None and row.high is not None and row.low != row.high:
        text += f" [{100 * row.low:.0f}, {100 * row.high:.0f}]"
    return text


def _times(row: Row) -> str:
    """Return the multiple of an error, 1 - skill, with its interval: 29.3 times [24.1, 35.2]."""
    text = f"{_digits(1 - (row.value or 0))} times"
    if row.low is not None and row.high is not None and row.low != row.high:
        text += f" [{_digits(1 - row.high)}, {_digits(1 - row.low)}]"
    return text


def _digits(value: float) -> str:
    """Return a number with three digits."""
    return f"{float(f'{value:.3g}'):,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _baselines(results: Results) -> Iterator[str]:
    """Yield the best baselines, if there are several, in weights and in return."""
    names, h = baselines(results), gain_horizon(results)
    if len(names) < 2:
        return
    found = [
        f"in weight error, {label(first)}, which {' and '.join(_errors(results, first))}"
        for first in best(results, names, SKILL, _near(results)[-1])
    ]
    for first in best(results, names, GAIN, h) if h is not None else ():
        row = row_at(results.forecasters[first], GAIN, h or 0)
        if row is not None:
            found.append(f"in return, {label(first)}, which gains {_percent(row)} at h = {h}")
    if found:
        yield f"The best of {len(names)} baselines are: {'; '.join(found)}."


def _bound(results: Results) -> Iterator[str]:
    if found := [label(name) for name in oracles(results)]:
        verb = (
            "is a bound and not a forecast" if len(found) == 1 else "are bounds and not forecasts"
        )
        yield (
            f"{' and '.join(found)} {verb}: the true weights after a round trip through as few "
            "coefficients as TIPL writes."
        )


def _certainty(results: Results) -> str:
    look = "This is a quick evaluation, with few starts and episodes; " if results.quick else ""
    if len(results.runs) < 2:
        return f"{look}{'with' if look else 'With'} one run there are no intervals."
    return f"{look}{'brackets' if look else 'Brackets'} hold 95 % intervals over runs."
