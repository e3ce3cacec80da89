"""The answers of the results page, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from board import ABLATION_BATCHES, LEARNED, SEEDS, SIMPLE, TASKS, VARIANTS, Board, ablation_tasks
from result_tables import cell

from tipl.evaluation.rows import TaskRow


def answers(rows: Sequence[TaskRow], weights: Board, returns: Board) -> str:
    """Return the answers to the page's questions, a line each."""
    ahead, clear, tasks = weights.wins("tipl-gate", "skill", 10)
    first, first_clear, _ = weights.wins("tipl-gate", "skill", 1)
    lines = [
        "1. **Does a learned forecast beat last-iteration-stretched in return?** "
        + _beaten(returns),
        "2. **Does a smaller weight error mean a higher return?** " + _agreement(weights),
        "3. **What transfers?** " + _transfer(weights),
        "4. **What reduces the error of the paper's model?** " + _paper(weights),
        f"5. **One gate for all tasks:** it beats AR(20) by phase, fitted to each task, on "
        f"{first} of {tasks} tasks at h = 1 ({first_clear} with an interval above 0) and on "
        f"{ahead} at h = 10 ({clear}). Its skill differs by at most {_spread(rows):.3f} between "
        f"{len(SEEDS)} training seeds (h = 1 and 10, each task).",
    ]
    return "\n".join(lines)


def findings(weights: Board, returns: Board) -> str:
    """Return the same in short sentences, for the README."""
    ahead, clear, tasks = weights.wins("tipl-gate", "skill", 10)
    others, _, _ = weights.wins("gate-elsewhere", "skill", 10)
    _, gains, _ = returns.wins("tipl-gate-stretched", "gain", 50)
    best, simple = (returns.entry(name, "gain", 50) for name in ("tipl-gate-stretched", SIMPLE))
    return "\n".join(
        [
            "- In weight error at h = 10, `tipl-gate` beats AR(20) by phase, fitted to each task, "
            f"on {ahead} of {tasks} tasks ({clear} with an interval above 0). A gate trained on "
            f"the six other tasks beats it on {others}.",
            "- *Stretched* by a factor that validation returns choose, `tipl-gate` has a mean gain "
            f"of {cell(best and best.score)} at h = 50, the last iteration's displacement "
            f"{cell(simple and simple.score)}; the gate leads on {gains} of {tasks} tasks with an "
            "interval above 0.",
            "- " + _paper(weights).partition(" At h = 1, models")[0],
        ]
    )


def _beaten(returns: Board) -> str:
    found = []
    for name in LEARNED:
        if (entry := returns.entry(name, "gain", 50)) is None:
            continue
        _, clear, tasks = returns.wins(name, "gain", 50)
        found.append((clear, entry.score.value or 0, f"{name} on {clear} of {tasks} tasks"))
    best = sorted(found, reverse=True)[:3]
    simple = returns.entry(SIMPLE, "gain", 50)
    verdict = "Yes" if best[0][0] >= 2 else "Hardly" if best[0][0] else "No"
    return (
        f"{verdict}: with an interval above 0 at h = 50, {'; '.join(text for *_, text in best)}. "
        f"The mean gain of {SIMPLE} is {cell(simple and simple.score)}."
    )


def _agreement(weights: Board) -> str:
    found = {
        name: (skill.score.value, gain.score.value)
        for name in weights.names("gain", 50)
        if (skill := weights.entry(name, "skill", 50)) is not None
        and (gain := weights.entry(name, "gain", 50)) is not None
        and not skill.oracle
    }
    x, y = np.array(list(found.values()), float).T
    rank = float(np.corrcoef(x.argsort().argsort(), y.argsort().argsort())[0, 1])
    in_weights, in_return = (max(found, key=lambda name: found[name][i]) for i in (0, 1))
    stretched = sum(name.endswith("-stretched") for name in found)
    return (
        f"{'No' if rank < 0 else 'Partly'}: over {len(found)} forecasters, {stretched} of them "
        f"stretched, the rank correlation between mean skill and mean gain at h = 50 is "
        f"{rank:.2f}. Best in weights is {in_weights}, best in return is "
        f"{in_return}."
    )


def _transfer(weights: Board) -> str:
    better = sum(
        (score.score.low or 0) > 0
        for task in TASKS
        if (score := weights.score(task, "gate-elsewhere", "skill", 10)) is not None
    )
    ahead, clear, tasks = weights.wins("gate-elsewhere", "skill", 10)
    return (
        f"A gate that never saw the task is better than persistence on {better} of {tasks} tasks "
        f"at h = 10, and better than AR(20) fitted to the task itself on {ahead} ({clear} with an "
        "interval above 0)."
    )


def _paper(weights: Board) -> str:
    skills = {
        name: [
            s.score.value
            for task in ablation_tasks(weights)
            if (s := weights.score(task, name, "skill", 1)) is not None
            and s.score.value is not None
        ]
        for name in VARIANTS
    }
    means = {name: float(np.mean(values)) for name, values in skills.items() if values}
    order = [name for name in VARIANTS if name in means]
    tasks = len(skills[order[0]])
    jumps = {b: means[b] - means[a] for a, b in pairwise(order)}
    largest = max(jumps, key=lambda name: jumps[name])
    crossed = next((name for name in order if means[name] > 0), None)
    text = (
        f"TIPL's design, trained for {ABLATION_BATCHES:,} batches (the paper: 500,000), has skill "
        f"{means[order[0]]:,.0f} at h = 1 on average over {tasks} tasks. The change that helps "
        f"most is “{VARIANTS[largest].lstrip('+ ')}”."
    )
    if crossed:
        place = order.index(crossed) + 1
        text += (
            f" At h = 1, models are better than persistence from line {place} of the "
            f"table on: “{VARIANTS[crossed].lstrip('+ ')}”."
        )
    return text


def _spread(rows: Sequence[TaskRow]) -> float:
    """Return the largest difference of skill between trainings of the gate."""
    spreads = []
    for task in TASKS:
        for h in (1, 10):
            skills = []
            for seed in SEEDS:
                mine = [
                    row
                    for row in rows
                    if (row.task, row.measure, row.horizon, row.forecaster)
                    == (task, "skill", h, f"tipl-gate@{seed}")
                ]
                if mine:
                    skills.append(1 - sum(r.error for r in mine) / sum(r.reference for r in mine))
            spreads.append(max(skills) - min(skills))
    return max(spreads)
