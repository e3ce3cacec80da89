"""Results as pictures.

The models, persistence and the best baselines have colours, the other baselines are grey, and
oracles are dashed.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from tipl.evaluation.results import GainRow, Measure, Results, Row
from tipl.report.scores import (
    PERSISTENCE,
    SKILL,
    function_skill,
    gain,
    models,
    oracles,
    repw,
    shown,
    skill,
    wpe,
)
from tipl.report.tables import MODE_NAMES, label

SIZE = (12, 4.6)
"""Width and height of a figure, in inches."""
OTHERS = "other baselines"
"""Entry of the grey ones in legends."""
_OF_MODELS = ("#c0392b", "#e67e22", "#8e44ad", "#d6529e")
_OF_BASELINES = ("#2471a3", "#17a589", "#7d6608", "#5dade2")
_BLACK, _GREY = "#1c1c1c", "#a6acaf"
_LOWEST = -0.5
"""Smallest skill and gain that is drawn."""

Style = dict[str, Any]
"""Style of a line, as ``Axes.plot`` takes it."""


def figures(results: Results) -> dict[str, Figure]:
    """Return all figures of a page, by title."""
    return {title: draw() for title, draw in _plans(results).items()}


def titles(results: Results) -> list[str]:
    """Return the titles of all figures of a page; nothing is drawn."""
    return list(_plans(results))


def file_name(title: str) -> str:
    """Return the file name of the picture of this title."""
    return title.lower().replace("'", "").replace(",", "").replace(" ", "-") + ".png"


def _plans(results: Results) -> dict[str, Callable[[], Figure]]:
    found = {"Skill against horizon": partial(skill_figure, results)}
    if results.modes:
        found["Inference gain against horizon"] = partial(gain_figure, results)
        found["Return of one forecast"] = partial(return_figure, results)
        found |= {
            f"The paper's figure, {MODE_NAMES[mode]}": partial(paper_figure, results, mode)
            for mode in results.modes
            if mode != "held"
        }
    return dict(found)


def skill_figure(results: Results) -> Figure:
    """Return the skill in weights, all starts and at boundaries, and in function."""
    panels = {
        "weights, all starts": SKILL,
        "weights, next step in a new iteration": skill(starts="boundary"),
        "policies (divergence)": function_skill,
    }
    return _bands(results, panels, "skill", top=1)


def gain_figure(results: Results) -> Figure:
    """Return what a forecast earns of what training earns, in each action mode."""
    panels = {MODE_NAMES[mode]: gain(mode) for mode in results.modes}
    fig = _bands(results, panels, "inference gain", top=1.2)
    for axes in fig.axes:
        axes.axhline(1, ls=":", color="black", lw=1)
    return fig


def _bands(results: Results, panels: dict[str, Measure], y: str, top: float) -> Figure:
    """Draw a measure against the horizon in each panel, every forecaster with its interval."""
    fig = Figure(figsize=SIZE, layout="constrained")
    all_axes = fig.subplots(1, len(panels), sharey=True)
    for axes, (title, measure) in zip(all_axes, panels.items(), strict=True):
        for name, style in styles(results).items():
            _draw_band(axes, measure(results.forecasters[name]), style)
        _logarithmic(axes)
        axes.set_ylim(_LOWEST, top)
        _name_those_outside(axes)
        axes.set_title(title, fontsize=10)
        _label(axes, "horizon h, snapshots", y if axes is all_axes[0] else "")
    _legend(fig)
    return fig


def return_figure(results: Results) -> Figure:
    """Return returns of forecast policies beside the environment steps that PPO takes instead.

    Interquartile means over starts in the learning phase of all runs. A forecast takes no step.
    """
    fig = Figure(figsize=SIZE, layout="constrained")
    all_axes = fig.subplots(1, 3, sharey=True)
    each = results.env_steps_per_snapshot
    for axes, mode in zip(all_axes, results.modes, strict=True):
        for name, style in styles(results).items():
            rows = results.forecasters[name].gain.get(mode, ())
            if not results.forecasters[name].is_oracle:
                axes.plot(*_curve(rows, "forecast", each), **style)
        trained = {"color": "black", "ls": ":", "lw": 2, "zorder": 4, "label": "PPO itself"}
        axes.plot(
            *_curve(results.forecasters[PERSISTENCE].gain.get(mode, ()), "later", each), **trained
        )
        _logarithmic(axes)
        axes.set_title(MODE_NAMES[mode], fontsize=10)
        x = "horizon h, snapshots" if each is None else "environment steps that PPO takes meanwhile"
        _label(axes, x, "return" if axes is all_axes[0] else "")
    _legend(fig)
    return fig


def _curve(
    rows: Sequence[GainRow], key: str, each: float | None
) -> tuple[list[float], list[float]]:
    """Return returns against environment steps, or against snapshots where these are unknown."""
    found = [(row.h * (each or 1), getattr(row, key)) for row in rows]
    known = [(x, y) for x, y in found if y is not None]
    return [x for x, _ in known], [y for _, y in known]


def paper_figure(results: Results, mode: str) -> Figure:
    """Return the paper's figure, with persistence, baselines, the oracle and the noise beside it.

    Left: WPE and REPW against the forecast step. Right: return of the true policy against the
    return of the forecast policy, over all steps, of those that have a colour.
    """
    fig = Figure(figsize=SIZE, layout="constrained")
    errors, returns, scatter = fig.subplots(1, 3)
    coloured = shown(results)
    for name, style in styles(results).items():
        scores = results.forecasters[name]
        for axes, measure in ((errors, wpe), (returns, repw(mode, "learning"))):
            near = [row for row in measure(scores) if row.h <= 10]
            axes.plot([row.h for row in near], [row.value for row in near], **style)
        for points in scores.scatter.get(mode, ()) if name in coloured else ():
            dots = {"ms": 2, "alpha": 0.3, "color": style["color"]}
            scatter.plot(points.true, points.forecast, "o", **dots)
    noise = results.noise_floor[mode]
    returns.axhline(noise, ls=":", color="black", label="noise: true policy, other episodes")
    _label(errors, "forecast step h", "WPE: mean squared error of weights")
    errors.set_yscale("log")
    _label(returns, "forecast step h", "REPW while learning: |J(true) - J(forecast)|")
    returns.set_ylim(bottom=0)
    _label(scatter, "J(true policy)", "J(forecast policy)")
    scatter.axline((0, 0), slope=1, ls=":", color="black")
    _legend(fig)
    return fig


def styles(results: Results) -> dict[str, Style]:
    """Return how each forecaster is drawn."""
    coloured, ours, dashed = shown(results), models(results), oracles(results)
    rivals = [name for name in coloured if name not in (*ours, PERSISTENCE)]
    colors = dict(zip(ours, _cycle(_OF_MODELS, len(ours)), strict=True))
    colors |= dict(zip(rivals, _cycle(_OF_BASELINES, len(rivals)), strict=True))
    colors[PERSISTENCE] = _BLACK
    found: dict[str, Style] = {}
    for name in results.forecasters:
        if name in coloured:
            line = {"color": colors[name], "marker": "o", "ms": 3, "lw": 1.5, "zorder": 3}
            found[name] = line | {"label": label(name)}
        elif name in dashed:
            line = {"color": "#7f8c8d", "ls": "--", "lw": 1.2, "zorder": 2}
            found[name] = line | {"label": label(name)}
        else:
            found[name] = {"color": _GREY, "lw": 0.6, "zorder": 1, "label": OTHERS}
    return found


def _cycle(colors: tuple[str, ...], count: int) -> list[str]:
    return [colors[i % len(colors)] for i in range(count)]


def _draw_band(axes: Axes, rows: Sequence[Row], style: Style) -> None:
    """Draw a line, and its interval where it has a colour of its own."""
    rows = [row for row in rows if row.value is not None]
    if not rows:
        return
    h = [row.h for row in rows]
    value, low, high = (
        np.array([getattr(row, end) for row in rows], np.float64)  # None becomes NaN
        for end in ("value", "low", "high")
    )
    axes.plot(h, value, **style)
    if "marker" in style and rows[0].low is not None:
        axes.fill_between(h, low, high, alpha=0.15, color=style["color"], linewidth=0)


def _name_those_outside(axes: Axes) -> None:
    """Name the lines with a colour that leave the frame, each with its most extreme value."""
    low, high = axes.get_ylim()
    lines = [
        (str(line.get_label()), np.asarray(line.get_ydata(), float))
        for line in axes.get_lines()
        if line.get_label() != OTHERS
    ]
    below = [f"{text} (down to {y.min():.3g})" for text, y in lines if y.min() < low]
    above = [f"{text} (up to {y.max():.3g})" for text, y in lines if y.max() > high]
    for names, y, where, va in ((below, 0.02, "below", "bottom"), (above, 0.98, "above", "top")):
        if names:
            text = "\n".join([f"{where} the frame:", *names])
            box = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 1}
            at = axes.transAxes
            axes.text(0.02, y, text, transform=at, fontsize=7, va=va, bbox=box, zorder=5)


def _logarithmic(axes: Axes) -> None:
    """Make the axis of horizons or steps logarithmic, with numbers at 1, 2 and 5 times 10^n."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(fig: Figure) -> None:
    """Draw one entry for each label of any panel; those without a colour come last."""
    entries = {
        text: handle
        for axes in fig.axes
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if OTHERS in entries:
        entries[OTHERS] = entries.pop(OTHERS)
    fig.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=5, fontsize=8
    )


def png(fig: Figure, dpi: int) -> bytes:
    """The figure as a picture."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def svg(fig: Figure) -> str:
    """Return the figure as text for a page; the same bytes for the same figure."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "weighttraj"}):
        fig.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue().split("?>", 1)[-1]
