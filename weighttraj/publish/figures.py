"""The figures of the page: returns, step sizes, spectrum, path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64
from matplotlib.colors import LinearSegmentedColormap, Normalize

from weighttraj.publish.curves import NAMES, Curve, Kind, band, thin
from weighttraj.publish.source import MINUS, number
from weighttraj.publish.svg import (
    COLORS,
    FAINT,
    INK,
    Picture,
    blank,
    inline,
    logarithmic,
    logarithmic_x,
    short,
    style,
    thousands,
)
from weighttraj.publish.walk import SHARE_FLOOR, Walk

RAMP = ("#4668d8", "#1d9a7c", "#c8770a")
"""Low, middle and high returns: seen on white and on black, and by the colour-blind."""

BINS = 100
"""Stretches of time in the figure of step sizes."""

_MAP = LinearSegmentedColormap.from_list("ramp", RAMP)
_RETURNS: dict[Kind, str] = {
    "deterministic": "return, deterministic actions",
    "sampled": "return, sampled actions",
    "training": "return, training episodes",
}
_POINTS = 150  # of a path
_RANKS = 80  # of a spectrum
_GROUPS = 6  # of phases


def returns(lines: Sequence[Curve], kind: Kind) -> Picture:
    """Draw learning curves: thin lines of the runs, their median and interquartile band.

    Args:
        lines: at least one.
        kind: which returns they are.
    """
    fig, axes = blank()
    color = COLORS[1] if kind == "sampled" else COLORS[0]
    if len(lines) > 1:
        faint = float(np.clip(4 / len(lines), 0.2, 0.6))
        for line in lines:
            axes.plot(line.steps, line.returns, lw=0.7, color=color, alpha=faint)
    middle = band(lines)
    if len(lines) > 1:
        axes.fill_between(middle.steps, middle.low, middle.high, color=color, alpha=0.3, lw=0)
        axes.plot(middle.steps, middle.median, lw=2.4, color=color)
    else:
        axes.plot(lines[0].steps, lines[0].returns, lw=1.6, color=color)
    thousands(axes)
    style(axes, "environment steps", _RETURNS[kind])
    first, last = (number(float(middle.median[i])) for i in (0, -1))
    who = "one run" if len(lines) == 1 else f"median of {len(lines)} runs"
    label = (
        f"{NAMES[kind].capitalize()}, against environment steps; {who}: from {first} to {last} "
        f"after {short(middle.steps[-1])} steps"
    )
    return Picture(svg=inline(fig, f"returns-{kind}"), label=label)


def step_sizes(walks: Sequence[Walk], phases: Sequence[Int64[np.ndarray, " time"]]) -> Picture:
    """L2 norm of each step, by the part of the iteration that it ends: median and quartiles.

    Args:
        walks: of the runs, all of which moved.
        phases: of their snapshots.
    """
    fig, axes = blank()
    longest = max(len(w.steps) for w in walks)
    edges = np.linspace(0, longest, min(BINS, longest) + 1)
    groups = phase_groups(phases)
    for (name, members), color in zip(groups, COLORS, strict=False):
        stretch, sizes = _steps_of(walks, phases, members, edges)
        known = np.unique(stretch)
        quartiles = np.array([np.quantile(sizes[stretch == b], [0.25, 0.5, 0.75]) for b in known])
        at = np.array([(edges[b] + edges[b + 1]) / 2 for b in known])
        if len(known):
            axes.fill_between(at, quartiles[:, 0], quartiles[:, 2], color=color, alpha=0.2, lw=0)
            axes.plot(at, quartiles[:, 1], lw=1.3, color=color, label=name)
    logarithmic(axes)
    if len(groups) > 1:
        axes.legend(
            title="phase of the step", ncols=len(groups), fontsize=9, frameon=False,
            loc="lower center", bbox_to_anchor=(0.5, 1), borderaxespad=0.2,
            handlelength=1.2, columnspacing=1.2, labelcolor=INK,
        ).get_title().set(color=INK, fontsize=9)  # fmt: skip
    style(axes, "snapshot t", f"‖φₜ₊₁ {MINUS} φₜ‖")
    return Picture(svg=inline(fig, "steps"), label=_gist_of_steps(walks, phases))


def phase_groups(
    phases: Sequence[Int64[np.ndarray, " time"]],
) -> list[tuple[str, Int64[np.ndarray, " phase"]]]:
    """Names of the phases of steps and their numbers; neighbours together if there are many."""
    found = np.unique(np.concatenate([phase[1:] for phase in phases]))
    if len(found) < 2:
        return [("all steps", found)]
    parts = np.array_split(found, min(_GROUPS, len(found)))
    return [(f"{p[0]}" if len(p) == 1 else f"{p[0]} to {p[-1]}", p) for p in parts]


def phase_table(
    walks: Sequence[Walk], phases: Sequence[Int64[np.ndarray, " time"]]
) -> list[tuple[str, str, str]]:
    """Of each phase: its name, the number of steps, and their median size."""
    edges = np.array([0.0, np.inf])
    rows = []
    for name, members in phase_groups(phases):
        sizes = _steps_of(walks, phases, members, edges)[1]
        if len(sizes):
            rows.append((name, f"{len(sizes):,}", number(float(np.median(sizes)))))
    return rows


def spectra(walks: Sequence[Walk]) -> Picture:
    """Draw singular values over the largest one, against their number."""
    fig, axes = blank()
    for walk in walks:
        _thin_line(axes, walk.singular / (walk.singular[0] or 1), len(walks))
    logarithmic(axes)
    logarithmic_x(axes)
    thousands(axes)
    style(axes, "component i", "singular value σᵢ / σ₁")
    ratio = float(np.median([w.singular[1] / w.singular[0] for w in walks]))
    label = (
        f"Singular values over the largest one, {_of(walks)}: the second is {ratio:.2g} of the "
        f"first, the last shown {float(walks[0].singular[-1] / walks[0].singular[0]):.1g}"
    )
    return Picture(svg=inline(fig, "spectrum"), label=label)


def tails(walks: Sequence[Walk]) -> Picture:
    """Draw the share of the squared Frobenius norm beyond rank d."""
    fig, axes = blank()
    for walk in walks:
        left = np.where(walk.beyond > SHARE_FLOOR, walk.beyond, np.nan)
        _thin_line(axes, left, len(walks))
    logarithmic(axes)
    logarithmic_x(axes)
    thousands(axes)
    style(axes, "rank d", "share of ‖Φ‖² beyond d")
    one = float(np.median([w.beyond[0] for w in walks]))
    label = (
        f"Share of the squared Frobenius norm beyond rank d, {_of(walks)}: {one:.2g} beyond the "
        "first component, falling with d"
    )
    return Picture(svg=inline(fig, "tail"), label=label)


def path(
    run: str,
    walk: Walk,
    values: Float64[np.ndarray, " time"],
    limits: tuple[float, float],
    what: str,
) -> Picture:
    """Draw the way of one run's weights in the two directions in which it goes farthest.

    Args:
        run: its id.
        walk: of the run.
        values: colour of each snapshot; NaN: grey.
        limits: lowest and highest value of the colours.
        what: the values are called.
    """
    fig, axes = blank()
    keep = thin(len(walk.rows), _POINTS)
    x, y = walk.path[keep].T
    colors = values[walk.rows[keep]]
    known = np.isfinite(colors)
    axes.plot(x, y, lw=0.7, color=FAINT, zorder=1)
    axes.scatter(x[~known], y[~known], s=7, color=FAINT, lw=0, zorder=2)
    axes.scatter(
        x[known], y[known], s=11, c=colors[known], cmap=_MAP, norm=Normalize(*limits), lw=0,
        zorder=2,
    )  # fmt: skip
    for i, marker, name in ((0, "o", "start"), (-1, "s", "end")):
        axes.plot(x[i], y[i], marker, ms=7, mfc="none", mec=INK, mew=1.4, zorder=3)
        away = _away(walk.path, i)
        axes.annotate(
            name, (x[i], y[i]), (18 * away[0], 14 * away[1]), textcoords="offset points",
            ha="center", va="center", color=INK, zorder=4,
        )  # fmt: skip
    axes.margins(0.14)
    axes.set_aspect("equal", adjustable="datalim")
    shares = [f"{100 * share:.1f} %" for share in walk.path_share]
    style(axes, f"first direction ({shares[0]})", f"second direction ({shares[1]})")
    length = float(np.hypot(x[-1], y[-1]))
    label = (
        f"Path of run {run} in its first two directions from the start, coloured by {what}; it "
        f"ends {length:.3g} away from where it began"
    )
    return Picture(svg=inline(fig, f"path-{run}"), label=label, caption=run)


def _away(way: Float64[np.ndarray, "point 2"], end: int) -> Float64[np.ndarray, " 2"]:
    """Return the direction from the path around one of its ends to where the path is not."""
    distance = np.hypot(*(way - way[end]).T)
    towards = way[end] - way[distance <= 0.2 * distance.max()].mean(0)
    length = float(np.hypot(*towards))
    return towards / length if length else np.array([0.0, 1.0])


def _steps_of(
    walks: Sequence[Walk],
    phases: Sequence[Int64[np.ndarray, " time"]],
    members: Int64[np.ndarray, " phase"],
    edges: Float64[np.ndarray, " edge"],
) -> tuple[Int64[np.ndarray, " step"], Float64[np.ndarray, " step"]]:
    """Stretch of time and size of every step of some phases; steps of size 0 have no logarithm."""
    places, sizes = [], []
    for walk, phase in zip(walks, phases, strict=True):
        mine = np.flatnonzero(np.isin(phase[1:], members) & (walk.steps > 0))
        places.append(np.searchsorted(edges, mine, side="right") - 1)
        sizes.append(walk.steps[mine])
    return np.concatenate(places), np.concatenate(sizes)


def _gist_of_steps(walks: Sequence[Walk], phases: Sequence[Int64[np.ndarray, " time"]]) -> str:
    sizes = np.concatenate([w.steps for w in walks])
    middle = number(float(np.median(sizes)))
    label = f"L2 norm of each step against t, {_of(walks)}, logarithmic: median {middle}"
    rows = phase_table(walks, phases)
    by_phase = [f"{size} in phase {name}" for name, _, size in rows] if len(rows) > 1 else []
    return "; ".join([label, *filter(None, [", ".join(by_phase)])])


def _thin_line(axes: object, values: Float64[np.ndarray, " rank"], runs: int) -> None:
    # Few points on a logarithmic axis, so that a page of many runs stays small.
    order = np.unique(np.geomspace(1, len(values), _RANKS).round().astype(np.int64))
    wide = {"lw": 1.6, "alpha": 1.0} if runs == 1 else {"lw": 0.9, "alpha": 0.65}
    axes.plot(order, values[order - 1], color=COLORS[0], **wide)  # type: ignore[attr-defined]


def _of(walks: Sequence[Walk]) -> str:
    return "one run" if len(walks) == 1 else f"{len(walks)} runs"
