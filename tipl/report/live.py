"""Results of a study of trainings with forecasts: tables in Markdown, and learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Drawing

from tipl.errors import EvaluateError
from tipl.evaluation.statistics import Bootstrap, interquartile_mean
from tipl.live.results import Figure, LiveResults, Series
from tipl.live.summary import returns_of
from tipl.report.figures import svg
from tipl.report.markdown import places, rewrite
from weighttraj.atomic import replace_file
from weighttraj.text import markdown as escaped

COLUMNS = ("steps to 50 %", "75 %", "90 %", "95 %", "final", "area", "worst decile", "forecasts")
"""Columns of a table behind the arm, where the plan has these thresholds."""
_COLOURS = ("#c0392b", "#2471a3", "#17a589", "#8e44ad", "#e67e22", "#7d6608", "#d6529e", "#5dade2")
_WHAT = "live"


def insert_live(results: LiveResults, source: Path, page: Path) -> None:
    """Write every place of a study's results in a Markdown page, and the curves beside it.

    A place begins with ``<!-- live of FILE, TASK -->``, with the task's hyphens as underscores, or
    ``<!-- live of FILE -->`` for all tasks, and ends with ``<!-- end of live -->``.
    """
    old = page.read_text(encoding="utf-8")
    new = rewrite(old, _WHAT, source.as_posix(), lambda section: render(results, source, section))
    if any(place.source == source.as_posix() for place in places(new)):
        write_figures(results, page.parent / source.stem)
    replace_file(page.resolve(), new.encode())


def render(results: LiveResults, source: Path, section: str) -> str:
    """Return the tables and the learning curves of a task, or of all."""
    wanted = [
        task
        for task in results.thresholds
        if section in ("overview", task.replace("-", "_").replace(".", "_"))
    ]
    if not wanted:
        raise EvaluateError(
            "the results have no such task",
            expected="overview, for all, or one of " + ", ".join(results.thresholds),
            got=section,
            where=source,
            do="correct the marker in the page",
        )
    parts = []
    for task in wanted:
        parts += [f"![Learning curves of {task}]({source.stem}/{file_name(task)})"]
        for against in dict.fromkeys((results.baseline, results.rival)):
            if rows_of(results, task, against):
                parts.append(_markdown(results, task, against))
    return "\n\n".join(parts) + "\n"


def rows_of(results: LiveResults, task: str, against: str) -> list[str]:
    """Return the arms that are compared with another one on a task."""
    mine = [f.arm for f in results.figures if (f.task, f.against) == (task, against)]
    return list(dict.fromkeys(mine))


def cells(
    results: LiveResults, task: str, arm: str, against: str, *, interval: bool = True
) -> list[str]:
    """Return the texts of an arm's columns."""
    found = {
        figure.name: figure
        for figure in results.figures
        if (figure.task, figure.arm, figure.against) == (task, arm, against)
    }
    names = [*(f"steps to {share} %" for share in ("50", "75", "90", "95")), *COLUMNS[4:7]]
    texts = [_text(found.get(name), interval) for name in names]
    cpu = chosen(results, task, arm).cpu
    return [*texts, f"{100 * cpu.forecasts / cpu.training:.1f} %"]


def chosen(results: LiveResults, task: str, arm: str) -> Series:
    """Return the series of an arm's best trial."""
    best = results.best[task][arm]
    return next(one for one in results.series if (one.task, one.trial) == (task, best))


def write_figures(results: LiveResults, folder: Path) -> None:
    """Draw the learning curves of each task into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for task in results.thresholds:
        content = svg(curves_figure(results, task)).encode()
        replace_file(folder / file_name(task), content)


def file_name(task: str) -> str:
    """Return the file name of a task's learning curves."""
    return f"{task}.svg"


def curves_figure(results: LiveResults, task: str) -> Drawing:
    """Return the learning curves of each arm's best trial: J, with 95 % intervals over seeds."""
    fig = Drawing(figsize=(9, 5), layout="constrained")
    axes = fig.subplots()
    arms = list(results.best[task])
    others = [arm for arm in arms if arm != results.baseline]
    colours = {arm: _COLOURS[i % len(_COLOURS)] for i, arm in enumerate(others)}
    for arm in arms:
        series = chosen(results, task, arm)
        colour = colours.get(arm, "#1c1c1c")
        _draw(axes, series, colour, "-" if arm in (results.baseline, results.rival) else "--")
    for share, value in results.thresholds[task].items():
        axes.axhline(value, lw=0.5, color="#a6acaf")
        axes.annotate(f"{share} %", (axes.get_xlim()[1], value), fontsize=7, color="#7f8c8d")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return J of the policy")
    axes.set_title(f"{task}, {len(chosen(results, task, results.baseline).curves)} seeds")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8)
    return fig


def _draw(axes: Any, series: Series, colour: str, line: str) -> None:
    """Draw the interquartile mean over seeds, and its interval."""
    returns = np.nan_to_num(returns_of(series), nan=0.0)
    rows = Bootstrap(resamples=500, seed=0).interval(interquartile_mean, returns)
    value, low, high = (
        np.array([row[end] for row in rows], np.float64) for end in ("value", "low", "high")
    )
    axes.plot(series.num_timesteps, value, color=colour, ls=line, lw=1.5, label=series.trial)
    if len(returns) > 1:
        band = {"color": colour, "alpha": 0.12, "linewidth": 0}
        axes.fill_between(series.num_timesteps, low, high, **band)


def _markdown(results: LiveResults, task: str, against: str) -> str:
    """Return one table: an arm a line, compared with another arm."""
    baseline = chosen(results, task, results.baseline)
    lines = [
        f"**{escaped(task)}, {len(baseline.curves)} {results.stage} seeds, against "
        f"{escaped(results.best[task][against])}**",
        "",
        f"| arm | {' | '.join(COLUMNS)} |",
        f"|---|{'---:|' * len(COLUMNS)}",
    ]
    for arm in rows_of(results, task, against):
        texts = cells(results, task, arm, against)
        lines.append(f"| {escaped(results.best[task][arm])} | {' | '.join(texts)} |")
    return "\n".join(lines)


def _text(figure: Figure | None, interval: bool) -> str:
    """Return a ratio of steps, or a difference of returns in per cent, with its interval."""
    if figure is None or figure.value is None:
        return "-"
    numbers: Sequence[float | None] = (figure.value, figure.low, figure.high)
    if figure.name.startswith("steps"):
        told = [f"{x:.2f}" for x in numbers if x is not None]
    else:
        told = [f"{100 * x:+.0f} %" for x in numbers if x is not None]
    text = told[0]
    if interval and len(told) == 3:
        text += f" [{told[1]}, {told[2]}]"
    if figure.censored or figure.censored_against:
        text += f" ({figure.censored}/{figure.censored_against} never)"
    return text
