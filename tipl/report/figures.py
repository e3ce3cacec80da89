"""Results as pictures."""

from __future__ import annotations

import io
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tipl.report.tables import MODE_NAMES, label

COLORS = {"tipl": "#c0392b", "persistence": "#2c3e50"}
_FLOOR = "#7f8c8d"
_MANY = 12
"""So many forecasters at most are drawn into the paper's figure."""


def figures(results: dict[str, Any]) -> dict[str, Figure]:
    """All figures of a page, by title."""
    found = {"Skill against horizon": skill_figure(results)}
    if results["modes"]:
        found["Inference gain against horizon"] = gain_figure(results)
        found |= {
            f"The paper's figure, {MODE_NAMES[mode]}": paper_figure(results, mode)
            for mode in results["modes"]
            if mode != "held"
        }
    return found


def skill_figure(results: dict[str, Any]) -> Figure:
    """Skill in weights, all starts and at boundaries, and in function; below -0.5 it is cut off."""
    fig = Figure(figsize=(12, 4.2), layout="constrained")
    panels = [
        ("weights, all starts", ("skill", "ratio_of_sums", "all")),
        ("weights, next step in a new iteration", ("skill", "ratio_of_sums", "boundary")),
        ("policies (divergence)", ("function_skill", "all")),
    ]
    all_axes = fig.subplots(1, 3, sharey=True)
    for axes, (title, path) in zip(all_axes, panels, strict=True):
        for name, scores in results["forecasters"].items():
            rows: Any = scores
            for key in path:
                rows = rows.get(key, {})
            _draw_band(axes, name, scores, rows or [])
        axes.set_xscale("log")
        axes.set_ylim(-0.5, 1)
        axes.set_title(title, fontsize=10)
        _style(axes, "horizon h, snapshots", "skill" if axes is all_axes[0] else "")
    _legend(fig, all_axes[0])
    return fig


def gain_figure(results: dict[str, Any]) -> Figure:
    """What a forecast earns of what training earns, in each action mode."""
    fig = Figure(figsize=(12, 4.2), layout="constrained")
    all_axes = fig.subplots(1, 3, sharey=True)
    for axes, mode in zip(all_axes, results["modes"], strict=True):
        for name, scores in results["forecasters"].items():
            _draw_band(axes, name, scores, scores["gain"][mode])
        axes.axhline(1, ls=":", color="black", lw=1)
        axes.set_xscale("log")
        axes.set_ylim(-0.5, 1.2)
        axes.set_title(MODE_NAMES[mode], fontsize=10)
        _style(axes, "horizon h, snapshots", "inference gain" if axes is all_axes[0] else "")
    _legend(fig, all_axes[0])
    return fig


def paper_figure(results: dict[str, Any], mode: str) -> Figure:
    """The paper's figure, with what it leaves out: the copy, the floor and the noise.

    Left: WPE and REPW against the forecast step. Right: return of the true policy against the
    return of the forecast policy, over all steps.
    """
    fig = Figure(figsize=(12, 4.2), layout="constrained")
    wpe, repw, scatter = fig.subplots(1, 3)
    for name, scores in list(results["forecasters"].items())[:_MANY]:
        gaps = scores["repw"][mode]["learning"]
        for axes, rows in ((wpe, scores["wpe"]), (repw, gaps)):
            near = [row for row in rows if row["h"] <= 10]
            h, y = [row["h"] for row in near], [row["value"] for row in near]
            axes.plot(h, y, "o-", ms=3, label=label(name), color=_color(name, scores))
        for points in scores["scatter"][mode]:
            true, forecast = points["true"], points["forecast"]
            scatter.plot(true, forecast, "o", ms=2, alpha=0.3, color=_color(name, scores))
    floor = results["noise_floor"][mode]
    repw.axhline(floor, ls=":", color="black", label="noise: true policy, other episodes")
    _style(wpe, "forecast step h", "WPE: mean squared error of weights")
    wpe.set_yscale("log")
    _style(repw, "forecast step h", "REPW while learning: |J(true) - J(forecast)|")
    repw.set_ylim(bottom=0)
    _style(scatter, "J(true policy)", "J(forecast policy)")
    scatter.axline((0, 0), slope=1, ls=":", color="black")
    _legend(fig, repw)
    return fig


def _draw_band(axes: Axes, name: str, scores: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    rows = [row for row in rows if row["value"] is not None]
    if not rows:
        return
    h = [row["h"] for row in rows]
    (line,) = axes.plot(
        h, [row["value"] for row in rows], "o-", ms=3, label=label(name), color=_color(name, scores)
    )
    if rows[0]["low"] is not None:
        low, high = ([row[end] for row in rows] for end in ("low", "high"))
        axes.fill_between(h, low, high, alpha=0.15, color=line.get_color(), linewidth=0)


def _color(name: str, scores: dict[str, Any]) -> str | None:
    return _FLOOR if scores["floor"] else COLORS.get(name)


def _style(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(fig: Figure, axes: Axes) -> None:
    fig.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)


def svg(fig: Figure) -> str:
    """The figure as text that can stand inside a page; the same bytes for the same figure."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "weighttraj"}):
        fig.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue().split("?>", 1)[-1]


__all__ = ["figures", "svg"]
