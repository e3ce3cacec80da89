"""Results of a study of trainings with forecasts: tables in Markdown, and learning curves."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import StrMethodFormatter

from tipl.errors import EvaluateError
from tipl.evaluation.statistics import Bootstrap, interquartile_mean
from tipl.live.results import Figure, LiveResults, Series
from tipl.live.summary import returns_of
from tipl.report.figures import svg
from tipl.report.markdown import places, rewrite
from weighttraj.atomic import replace_file
from weighttraj.text import markdown as escaped

DIFFERENCES = ("final", "area", "worst decile")
"""Figures that are differences of returns, in the order of the columns."""
_COLOURS = ("#c0392b", "#2471a3", "#17a589", "#8e44ad", "#e67e22", "#7d6608", "#d6529e", "#5dade2")
_WHAT = "live"


def insert_live(results: LiveResults, source: Path, page: Path) -> None:
    """Write every place of a study's results in a Markdown page, and draw the figures it shows.

    The figures lie beside the results.

    A place begins with ``<!-- live of FILE, TASK -->``, with the task's hyphens as underscores, or
    ``<!-- live of FILE -->`` for all tasks, ``<!-- live of FILE, summary -->`` for a table with a
    line for each, or ``<!-- live of FILE, tables -->`` for every figure, and ends with
    ``<!-- end of live -->``.
    """
    old = page.read_text(encoding="utf-8")
    folder = Path(os.path.relpath(source.parent, page.parent)).as_posix()
    new = rewrite(
        old, _WHAT, source.as_posix(), lambda section: render(results, source, folder, section)
    )
    mine = [place.section for place in places(new) if place.source == source.as_posix()]
    if {*mine} - {"summary"} - ({"tables"} if results.stage == "tuning" else set()):
        write_figures(results, source.parent)
    replace_file(page.resolve(), new.encode())


def render(results: LiveResults, source: Path, folder: str, section: str) -> str:
    """Return the tables and the figures of a task, or of all.

    Args:
        results: of one stage of a study.
        source: their file, for messages.
        folder: the figures' folder, as the page links to it.
        section: a task with underscores, ``overview`` for all, ``summary`` for a line each, or
            ``tables`` for every figure, and the learning curves of the test seeds.
    """
    if section == "summary":
        return summary(results)
    if section == "tables":
        parts = []
        for task in results.thresholds:
            if results.stage == "test":
                parts.append(f"![Learning curves of {task}]({folder}/{task}.svg)")
            parts += [
                _markdown(results, task, against)
                for against in _others(results)
                if rows_of(results, task, against)
            ]
        return "\n\n".join(parts)
    wanted = [
        task
        for task in results.thresholds
        if section in ("overview", task.replace("-", "_").replace(".", "_"))
    ]
    if not wanted:
        raise EvaluateError(
            "the results have no such task",
            expected="overview, summary, tables, or one of " + ", ".join(results.thresholds),
            got=section,
            where=source,
            do="correct the marker in the page",
        )
    parts = []
    for task in wanted:
        parts.append(f"![Learning curves of {task}]({folder}/{task}.svg)")
        if rows_of(results, task, results.baseline):
            parts.append(f"![Ratios of environment steps, {task}]({folder}/{task}-ratios.svg)")
            parts.append(_short(results, task))
    if section == "overview" and (told := not_run(results)):
        parts.append(told)
    return "\n\n".join(parts)


def not_run(results: LiveResults) -> str:
    """Return a sentence on the arms and tasks of the plan without results, or nothing."""
    arms, parts = results.plan["arms"], []
    for task in results.plan["tasks"]:
        wanted = [name for name, arm in arms.items() if not arm["tasks"] or task in arm["tasks"]]
        missing = [name for name in wanted if name not in results.best.get(task, {})]
        if missing:
            parts.append(f"{escaped(task)} ({len(missing)} of {len(wanted)} arms)")
    return f"Not run yet: {'; '.join(parts)}." if parts else ""


def rows_of(results: LiveResults, task: str, against: str) -> list[str]:
    """Return the arms that are compared with another one on a task."""
    mine = [f.arm for f in results.figures if (f.task, f.against) == (task, against)]
    return list(dict.fromkeys(mine))


def shares_of(results: LiveResults) -> list[str]:
    """Return the thresholds of a study, in per cent of the baseline's final return."""
    return [f"{100 * share:g}" for share in results.plan["thresholds"]]


def cells(
    results: LiveResults, task: str, arm: str, against: str, *, short: bool = False
) -> list[str]:
    """Return an arm's figures as texts: a ratio for each threshold, differences, CPU time.

    Args:
        results: of one stage of a study.
        task: one of its tasks.
        arm: one of its arms.
        against: the arm that it is compared with.
        short: without intervals, and without the numbers of trainings that never arrive.
    """
    found = {
        figure.name: figure
        for figure in results.figures
        if (figure.task, figure.arm, figure.against) == (task, arm, against)
    }
    names = [*(f"steps to {share} %" for share in shares_of(results)), *DIFFERENCES]
    told = _number if short else _text
    texts = [told(found.get(name), interval=not short) for name in names]
    cpu = chosen(results, task, arm).cpu
    return [*texts, f"{100 * cpu.forecasts / cpu.training:.1f} %"]


def chosen(results: LiveResults, task: str, arm: str) -> Series:
    """Return the series of an arm's best trial."""
    best = results.best[task][arm]
    return next(one for one in results.series if (one.task, one.trial) == (task, best))


def arm_label(results: LiveResults, task: str, arm: str) -> str:
    """Return an arm and the best values of its grid, in words."""
    _, _, point = results.best[task][arm].partition(":")
    values = [value.replace("=", " ").replace("_", " ") for value in point.split(",") if value]
    # A learning rate is a factor of the plan's.
    told = ", ".join(value.replace("learning rate ", "learning rate x") for value in values)
    return f"{arm} ({told})" if told else arm


def write_figures(results: LiveResults, folder: Path) -> None:
    """Draw the learning curves of each task into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for task in results.thresholds:
        found = {"": curves_figure(results, task)}
        if rows_of(results, task, results.baseline):
            found["-ratios"] = ratios_figure(results, task)
        if task in results.primary:
            few = (results.baseline, results.rival, results.primary[task])
            found["-primary"] = curves_figure(results, task, few)
        for suffix, figure in found.items():
            replace_file(folder / f"{task}{suffix}.svg", svg(figure).encode())


def _main_share(results: LiveResults) -> str:
    """Return the threshold of short tables: 90 %, or the plan's last one."""
    shares = shares_of(results)
    return "90" if "90" in shares else shares[-1]


def summary(results: LiveResults) -> str:
    """Return a table of the arms that were best on the tuning seeds, a task a line."""
    others, threshold = _others(results), _main_share(results)
    lines = [
        f"| task ({results.stage} seeds) | tuned forecast | steps to {threshold} %, against "
        f"{' | against '.join(map(escaped, others))} | final return |",
        f"|---|---|{'---:|' * (len(others) + 1)}",
    ]
    for task in results.thresholds:
        arm = results.primary.get(task)
        name = escaped(arm) if arm else "-"
        found = _primary_figures(results, task, f"steps to {threshold} %")
        final = _primary_figures(results, task, "final")
        # How many trainings never arrive is in the long tables, which explain it.
        texts = [_number(found.get(against), interval=True) for against in others]
        texts.append(_number(final.get(others[0]), interval=True))
        count = len(chosen(results, task, results.baseline).curves)
        lines.append(f"| {escaped(task)} ({count}) | {name} | {' | '.join(texts)} |")
    return "\n".join(lines)


def _primary_figures(results: LiveResults, task: str, name: str) -> dict[str, Figure]:
    """Return a figure of the primary arm, by the arm it is compared with."""
    wanted = (task, results.primary.get(task), name)
    return {f.against: f for f in results.figures if (f.task, f.arm, f.name) == wanted}


def curves_figure(results: LiveResults, task: str, only: Sequence[str] = ()) -> Drawing:
    """Return the learning curves of each arm's best trial: J, with 95 % intervals over seeds.

    Args:
        results: of one stage of a study.
        task: one of its tasks.
        only: the arms that are drawn; empty: all.
    """
    fig = Drawing(figsize=(9, 4 if only else 5), layout="constrained")
    axes = fig.subplots()
    arms = [arm for arm in results.best[task] if not only or arm in only]
    others = [arm for arm in arms if arm != results.baseline]
    colours = {arm: _COLOURS[i % len(_COLOURS)] for i, arm in enumerate(others)}
    for arm in arms:
        series = chosen(results, task, arm)
        colour = colours.get(arm, "#1c1c1c")
        line = "-" if arm in (results.baseline, results.rival) else "--"
        _draw(axes, series, arm_label(results, task, arm), colour, line)
    for share, value in results.thresholds[task].items():
        axes.axhline(value, lw=0.5, color="#a6acaf")
        axes.annotate(f"{share} %", (axes.get_xlim()[1], value), fontsize=7, color="#7f8c8d")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return J of the policy")
    axes.set_title(f"{task}, {len(chosen(results, task, results.baseline).curves)} seeds")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8)
    return fig


def ratios_figure(results: LiveResults, task: str) -> Drawing:
    """Return the ratios of environment steps to each threshold, against both other arms."""
    rivals = _others(results)
    shares = list(results.thresholds[task])
    arms = rows_of(results, task, results.baseline)
    fig = Drawing(figsize=(9, 1 + 0.45 * len(arms)), layout="constrained")
    for axes, against in zip(
        fig.subplots(1, len(rivals), sharey=True, squeeze=False)[0], rivals, strict=True
    ):
        for figure in results.figures:
            name = figure.name.removeprefix("steps to ").removesuffix(" %")
            if (figure.task, figure.against) != (task, against) or name not in shares:
                continue
            if figure.value is None or figure.arm not in arms:
                continue
            place = shares.index(name)
            y = -arms.index(figure.arm) - 0.18 * (place - (len(shares) - 1) / 2)
            colour = _COLOURS[place % len(_COLOURS)]
            axes.plot([figure.low, figure.high], [y, y], color=colour, lw=2)
            label = f"to {name} %" if figure.arm == arms[0] else None
            axes.plot(figure.value, y, "o", color=colour, ms=4, label=label)
        axes.axvline(1, color="#1c1c1c", lw=0.8)
        axes.set_title(f"against {against}", fontsize=10)
        axes.set_xlabel("ratio of environment steps")
        axes.set_yticks(
            [-i for i in range(len(arms))], [arm_label(results, task, arm) for arm in arms]
        )
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    fig.axes[0].legend(fontsize=7)
    return fig


def _draw(axes: Any, series: Series, name: str, colour: str, line: str) -> None:
    """Draw the interquartile mean over seeds, and its interval."""
    returns = returns_of(series)
    rows = Bootstrap(resamples=500, seed=0).interval(interquartile_mean, returns)
    value, low, high = (
        np.array([row[end] for row in rows], np.float64) for end in ("value", "low", "high")
    )
    axes.plot(series.num_timesteps, value, color=colour, ls=line, lw=1.5, label=name)
    if len(returns) > 1:
        band = {"color": colour, "alpha": 0.12, "linewidth": 0}
        axes.fill_between(series.num_timesteps, low, high, **band)


def _others(results: LiveResults) -> list[str]:
    """Return the arms that all others are compared with."""
    return [arm for arm in dict.fromkeys((results.baseline, results.rival)) if arm]


def _short(results: LiveResults, task: str) -> str:
    """Return a table of the most important figures: an arm a line, the primary one in bold."""
    others, name = _others(results), f"steps to {_main_share(results)} %"
    count = len(chosen(results, task, results.baseline).curves)
    found = {(f.arm, f.against, f.name): f for f in results.figures if f.task == task}
    lines = [
        f"| {escaped(task)}, {count} {results.stage} seeds | {name}, against "
        f"{' | against '.join(map(escaped, others))} | final | worst decile | forecasts |",
        f"|---|{'---:|' * (len(others) + 3)}",
    ]
    for arm in rows_of(results, task, results.baseline):
        wanted = [(arm, other, name) for other in others]
        wanted += [(arm, results.baseline, column) for column in ("final", "worst decile")]
        texts = [_text(found.get(key), interval=True) for key in wanted]
        cost = cells(results, task, arm, results.baseline)[-1]
        label = escaped(arm_label(results, task, arm))
        label = f"**{label}**" if arm == results.primary.get(task) else label
        lines.append(f"| {label} | {' | '.join(texts)} | {cost} |")
    return "\n".join(lines)


def _markdown(results: LiveResults, task: str, against: str) -> str:
    """Return one table: an arm a line, compared with another arm."""
    baseline = chosen(results, task, results.baseline)
    first, *others = (f"{share} %" for share in shares_of(results))
    columns = [f"steps to {first}", *others, *DIFFERENCES, "forecasts"]
    lines = [
        f"**{escaped(task)}, {len(baseline.curves)} {results.stage} seeds, against "
        f"{escaped(arm_label(results, task, against))}**",
        "",
        f"| arm | {' | '.join(columns)} |",
        f"|---|{'---:|' * len(columns)}",
    ]
    for arm in rows_of(results, task, against):
        texts = cells(results, task, arm, against)
        lines.append(f"| {escaped(arm_label(results, task, arm))} | {' | '.join(texts)} |")
    return "\n".join(lines)


def _text(figure: Figure | None, interval: bool) -> str:
    """Return a figure, and how many trainings of each arm never arrive, where some do not."""
    text = _number(figure, interval)
    if figure is not None and (figure.censored or figure.censored_against):
        text += f" ({figure.censored}/{figure.censored_against} never)"
    return text


def _ratio(value: float) -> str:
    """Return a ratio with two decimals, or three where two would hide on which side of 1 it is."""
    text = f"{value:.2f}"
    return f"{value:.3f}" if text == "1.00" and abs(value - 1) >= 0.0005 else text


def _number(figure: Figure | None, interval: bool) -> str:
    """Return a ratio of steps, or a difference of returns in per cent, with its interval."""
    if figure is None or figure.value is None:
        return "-"
    numbers: Sequence[float | None] = (figure.value, figure.low, figure.high)
    if figure.name.startswith("steps"):
        told = [_ratio(x) for x in numbers if x is not None]
    else:
        told = [f"{100 * x:+.0f} %" for x in numbers if x is not None]
    text = told[0]
    if interval and len(told) == 3:
        text += f" [{told[1]}, {told[2]}]"
    return text
