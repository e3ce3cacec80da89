"""Scores over tasks: mean skill, error ratio, win rate, rank, each with an interval.

Everything is computed from rows (``rows.csv``), so that forecasters of different evaluations, and
of strangers, stand on one scale. A score of a task is 1 - sum of error / sum of reference over its
runs: skill, or gain. Intervals are percentile bootstraps that draw runs within each task, trainings
of a forecaster that has several, and, for figures over tasks, the tasks; draws are the same for all
forecasters, so that differences are paired.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np
from jaxtyping import Float

from tipl.errors import EvaluateError
from tipl.evaluation.results import Interval, TaskScore
from tipl.evaluation.rows import TaskRow

PERSISTENCE = "persistence"
CLIP = 1.0
"""Scores of a task are clipped to [-1, 1] in the mean over tasks: one blow-up is no verdict."""

Cell = tuple[str, str, int]
"""Task, measure and horizon."""


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the leaderboard."""

    forecaster: str
    measure: str
    horizon: int
    tasks: int
    """Number of tasks that it was evaluated on."""
    score: Interval
    """Mean over tasks of the score, clipped to [-1, 1]."""
    ratio: Interval
    """Geometric mean over tasks of error over persistence's; unset for gains."""
    wins: Interval
    """Share of tasks on which its score is above persistence's."""
    wins_over: Interval
    """Share of tasks on which its score is above the chosen rival's; unset: rival not evaluated."""
    rank: Interval
    """Mean rank among the forecasters of a task; 1: the best. Equal scores share a rank."""
    cpu_ms: float | None = None
    """CPU milliseconds of one forecast of all horizons, a mean over the tasks that tell it."""
    oracle: bool = False


class Leaderboard(msgspec.Struct, frozen=True, kw_only=True):
    """All lines, and the score of each task behind them."""

    rival: str
    """Whom win rates are computed against, beside persistence."""
    entries: tuple[Entry, ...]
    scores: tuple[TaskScore, ...]


@dataclass(frozen=True)
class _Sums:
    """Errors and references of one forecaster in one cell."""

    error: Float[np.ndarray, "training run"]
    reference: Float[np.ndarray, "training run"]


def leaderboard(
    rows: Iterable[TaskRow], *, rival: str = "ar-20-phase", resamples: int = 2000, seed: int = 0
) -> Leaderboard:
    """Return the leaderboard of some rows.

    Args:
        rows: of any number of evaluations.
        rival: forecaster that win rates are computed against, beside persistence.
        resamples: number of bootstrap draws.
        seed: seed of the draws.

    Raises:
        EvaluateError: rows of one task come from different runs or data, or two evaluations
            disagree about a forecaster.
    """
    rows = list(rows)
    (cells, oracles), cpu_ms = _collect(rows), _costs(rows)
    drawn: dict[Cell, dict[str, np.ndarray]] = {}
    scores = []
    for cell, forecasters in sorted(cells.items()):
        runs = next(iter(forecasters.values())).error.shape[1]
        random = np.random.default_rng([seed, runs])
        picks = np.vstack([np.arange(runs), random.integers(runs, size=(resamples, runs))])
        drawn[cell] = {name: _scores(sums, picks, seed) for name, sums in forecasters.items()}
        theirs = drawn[cell].get(rival)
        for name, values in drawn[cell].items():
            lead = np.full_like(values, np.nan) if theirs is None else values - theirs
            scores.append(
                TaskScore(
                    task=cell[0],
                    measure=cell[1],
                    horizon=cell[2],
                    forecaster=name,
                    score=_interval(values, alone=runs == 1),
                    lead=_interval(lead, alone=runs == 1),
                    runs=runs,
                    trainings=len(forecasters[name].error),
                )
            )
    entries = []
    for measure, horizon in sorted({cell[1:] for cell in cells}, key=lambda key: (key[0], key[1])):
        tasks = {cell[0]: drawn[cell] for cell in drawn if cell[1:] == (measure, horizon)}
        lines = _entries(tasks, measure, horizon, rival, oracles, seed)
        entries += [msgspec.structs.replace(e, cpu_ms=cpu_ms.get(e.forecaster)) for e in lines]
    return Leaderboard(rival=rival, entries=tuple(entries), scores=tuple(scores))


def _costs(rows: Iterable[TaskRow]) -> dict[str, float]:
    """Return the CPU milliseconds of a forecast by forecaster, a mean over tasks."""
    found: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row.cpu_seconds is not None and np.isfinite(row.cpu_seconds):
            found[row.forecaster.partition("@")[0]][row.task].append(1_000 * row.cpu_seconds)
    return {
        name: float(np.mean([np.mean(each) for each in tasks.values()]))
        for name, tasks in found.items()
    }


def _collect(rows: Iterable[TaskRow]) -> tuple[dict[Cell, dict[str, _Sums]], set[str]]:
    """Group rows by task, measure and horizon, then by forecaster and training."""
    prints: dict[str, TaskRow] = {}
    found: dict[Cell, dict[str, dict[str, dict[str, TaskRow]]]] = {}
    oracles = set()
    for row in rows:
        first = prints.setdefault(row.task, row)
        if (first.fingerprint, first.split) != (row.fingerprint, row.split):
            raise EvaluateError(
                "results of one task come from different runs",
                expected=f"runs {first.fingerprint[:12]}, split {first.split}",
                got=f"runs {row.fingerprint[:12]}, split {row.split}",
                where=f"{row.task}, {row.forecaster}",
                do="evaluate all forecasters on the same runs of the same version",
            )
        name, _, training = row.forecaster.partition("@")
        cell = found.setdefault((row.task, row.measure, row.horizon), {})
        runs = cell.setdefault(name, defaultdict(dict))[training]
        _check_same(runs.setdefault(row.run, row), row)
        if row.oracle:
            oracles.add(name)
    return {cell: _stacked(cell, names) for cell, names in found.items()}, oracles


def _check_same(old: TaskRow, row: TaskRow) -> None:
    """Accept the same line twice, as when persistence is in every file; refuse another figure."""
    pairs = ((old.error, row.error), (old.reference, row.reference))
    if not all(np.isclose(a, b, rtol=1e-6, atol=0) for a, b in pairs):
        raise EvaluateError(
            "two evaluations disagree about a forecaster",
            expected=f"error {old.error:.6g}, reference {old.reference:.6g}",
            got=f"error {row.error:.6g}, reference {row.reference:.6g}",
            where=f"{row.task}, {row.run}: {row.measure} at h = {row.horizon}, {row.forecaster}",
            do="give different forecasters different names, and evaluate all on the same starts",
        )


def _stacked(
    cell: Cell, names: Mapping[str, Mapping[str, Mapping[str, TaskRow]]]
) -> dict[str, _Sums]:
    """Return the errors of each forecaster, all over the same runs in the same order."""
    runs = sorted({run for trainings in names.values() for by in trainings.values() for run in by})
    stacked = {}
    for name, trainings in names.items():
        for training, by in trainings.items():
            if missing := [run for run in runs if run not in by]:
                raise EvaluateError(
                    "a forecaster was not evaluated on all runs of a task",
                    expected=f"{len(runs)} runs",
                    got=f"no rows of {', '.join(missing)}",
                    where=f"{cell[0]}, {cell[1]} at h = {cell[2]}, {name} {training}".strip(),
                    do="evaluate it on the whole split",
                )
        each = [[by[run] for run in runs] for by in trainings.values()]
        stacked[name] = _Sums(
            np.array([[row.error for row in by] for by in each]),
            np.array([[row.reference for row in by] for by in each]),
        )
    return stacked


def _scores(sums: _Sums, picks: np.ndarray, seed: int) -> Float[np.ndarray, " draw"]:
    """Return the score of all runs, then of each draw of runs and trainings."""
    trainings = len(sums.error)
    rng = np.random.default_rng([seed, trainings])
    drawn = rng.integers(trainings, size=(len(picks) - 1, trainings))
    who = np.vstack([np.arange(trainings), drawn])
    error, reference = (
        each[who[:, :, None], picks[:, None, :]].sum((1, 2))
        for each in (sums.error, sums.reference)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(reference == 0, np.nan, 1 - error / reference)


def _entries(
    tasks: Mapping[str, Mapping[str, np.ndarray]],
    measure: str,
    horizon: int,
    rival: str,
    oracles: set[str],
    seed: int,
) -> list[Entry]:
    """Return a line for each forecaster, over the tasks that it was evaluated on, best first."""
    ranks = {task: _ranks(scores, oracles) for task, scores in tasks.items()}
    entries = []
    for name in sorted({name for scores in tasks.values() for name in scores}):
        mine = [task for task in tasks if name in tasks[task]]
        both = [task for task in mine if rival in tasks[task]]
        own = np.stack([tasks[task][name] for task in mine])  # (task, draw)
        entries.append(
            Entry(
                forecaster=name,
                measure=measure,
                horizon=horizon,
                tasks=len(mine),
                score=_over_tasks(np.clip(own, -CLIP, CLIP), seed),
                ratio=_error_ratio(own, seed) if measure != "gain" else Interval(value=None),
                wins=_over_tasks(_won(own, np.zeros_like(own)), seed),
                wins_over=_over_tasks(
                    _won(*(np.stack([tasks[t][who] for t in both]) for who in (name, rival))), seed
                )
                if both
                else Interval(value=None),
                rank=_over_tasks(np.stack([ranks[task][name] for task in mine]), seed),
                oracle=name in oracles,
            )
        )
    return sorted(entries, key=_place)


def _place(entry: Entry) -> tuple[bool, float]:
    """Best first, then those without a score, then bounds."""
    return entry.oracle, np.inf if entry.score.value is None else -entry.score.value


def _ranks(scores: Mapping[str, np.ndarray], oracles: set[str]) -> dict[str, np.ndarray]:
    """Return the rank of each forecaster in each draw; a bound is ranked, but shifts nobody."""
    table = np.stack([scores[name] for name in scores])
    rivals = np.stack([scores[name] for name in scores if name not in oracles])
    better = (rivals[None] > table[:, None]).sum(1)
    equal = (rivals[None] == table[:, None]).sum(1)
    ranks = 1 + better + np.maximum(equal - 1, 0) / 2
    return dict(zip(scores, ranks, strict=True))


def _won(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return 1 where the own score is higher, 1/2 for a tie; NaN where one is not known."""
    known = np.isfinite(own) & np.isfinite(other)
    return np.where(known, (own > other) + 0.5 * (own == other), np.nan)


def _error_ratio(scores: Float[np.ndarray, "task draw"], seed: int) -> Interval:
    """Return the geometric mean over tasks of error over reference error."""
    logs = np.log(np.maximum(1 - scores, np.finfo(float).tiny))
    mean = _over_tasks(logs, seed)
    exp = {name: _exp(getattr(mean, name)) for name in ("value", "low", "high")}
    return Interval(**exp)


def _exp(value: float | None) -> float | None:
    return None if value is None else float(np.exp(value))


def _over_tasks(table: Float[np.ndarray, "task draw"], seed: int) -> Interval:
    """Return the mean over tasks, with an interval that draws tasks too.

    The first draw is the data as they are. Tables of as many tasks draw the same ones.
    """
    n, draws = table.shape
    picks = np.random.default_rng([seed, n]).integers(n, size=(n, draws))
    picks[:, 0] = np.arange(n)
    return _interval(np.take_along_axis(table, picks, axis=0).mean(0), alone=False)


def _interval(draws: Float[np.ndarray, " draw"], *, alone: bool) -> Interval:
    """Return the first draw with the 95 % interval of the others; none from a single run."""
    value = float(draws[0]) if np.isfinite(draws[0]) else None
    known = draws[1:][np.isfinite(draws[1:])]
    if alone or value is None or not len(known):
        return Interval(value=value)
    low, high = np.quantile(known, (0.025, 0.975))
    return Interval(value=value, low=float(low), high=float(high))
