"""Figures as text that stands inside a page: small, without clashing ids, in the page's colours."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

INK = "#0a0b0c"
"""Stands for the colour of the page's text, light or dark."""

FAINT = "#80858c"
"""Grid and thin lines: seen on white and on black."""

COLORS = ("#3f74d9", "#c8770a", "#1d9a7c", "#c4476b", "#8a63d2", "#5f8a1c", "#b0602f", "#4d8fa8")
"""One line each; all of middle lightness, so that they show on white and on black."""

_SETTINGS: Any = {
    "svg.fonttype": "none",  # text stays text: it can be read out, and takes the page's font
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "path.simplify": True,
    "axes.unicode_minus": True,
}
_SIZE = (5.2, 3.3)
_NOTHING = (1e-3, 1.0)
"""Limits of a logarithmic axis on which there is nothing."""
_DIGITS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A figure of the page."""

    svg: str
    """The ``<svg>`` element; matplotlib escaped the text in it."""
    label: str
    """What it shows, in words."""
    caption: str = ""
    """Line below it."""


def blank() -> tuple[Figure, Axes]:
    """A figure with one pair of axes; sizes that are legible on a telephone."""
    with mpl.rc_context(_SETTINGS):
        fig = Figure(figsize=_SIZE, layout="constrained")
        FigureCanvasSVG(fig)
        axes = fig.subplots()
    return fig, axes


def style(axes: Axes, x: str, y: str) -> None:
    """Labels and lines in the page's colours; a faint grid."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(which="both", color=FAINT, labelcolor=INK)
    axes.grid(color=FAINT, alpha=0.25, lw=0.6)
    axes.set_axisbelow(True)
    legend = axes.get_legend()
    if legend is not None:
        for text in legend.get_texts():
            text.set_color(INK)


def _is_seen(axes: Axes) -> bool:
    """Return whether a line has a point above 0."""
    return any((np.asarray(line.get_ydata(), np.float64) > 0).any() for line in axes.lines)


def logarithmic_x(axes: Axes) -> None:
    """A logarithmic x axis; it is empty where nothing that is drawn is above 0."""
    axes.set_xscale("log")
    if not _is_seen(axes):
        axes.set_xlim(*_NOTHING)


def logarithmic(axes: Axes) -> None:
    """A logarithmic y axis, labelled in plain text; call it when everything is drawn.

    The axis is empty where nothing that is drawn is above 0.
    """
    axes.set_yscale("log")
    if not _is_seen(axes):
        axes.set_ylim(*_NOTHING)
    low, high = axes.get_ylim()
    decades = np.log10(high / low)
    subs = (1.0,) if decades > 2.5 else (1.0, 2.0, 5.0) if decades > 0.7 else tuple(range(1, 10))
    axes.yaxis.set_major_locator(LogLocator(subs=subs, numticks=9))
    axes.yaxis.set_minor_locator(NullLocator())
    label = power if len(subs) == 1 else "{:.4g}".format
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: label(value)))


def power(value: float) -> str:
    """A power of ten: 10⁻³."""
    return "10" + f"{round(float(f'{value:e}'.split('e')[1]))}".translate(_DIGITS)


def thousands(axes: Axes) -> None:
    """Counts on the x axis: 0, 50k, 100k, 1.5M."""
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))


def short(value: float) -> str:
    """A count in four characters or so."""
    for unit, factor in (("M", 1e6), ("k", 1e3)):
        if abs(value) >= factor:
            return f"{value / factor:.3g}{unit}"
    return f"{value:.3g}"


def inline(fig: Figure, name: str) -> str:
    """The figure as an ``<svg>`` element; the same bytes for the same figure.

    Args:
        fig: from ``blank``.
        name: distinguishes its ids from those of other figures of the page.
    """
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with mpl.rc_context({**_SETTINGS, "svg.hashsalt": name}):
        fig.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text)  # HTML knows them
    text = re.sub(r'(<svg\b[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg\b[^>]*?) height="[^"]*"', r'\1 aria-hidden="true"', text, count=1)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r">\s*\n\s*<", "><", text)
    return _ids(text, name).replace(INK, "currentColor")


def _ids(text: str, name: str) -> str:
    """Ids that something refers to, with the figure's name before them; others go."""
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))

    def rename(match: re.Match[str]) -> str:
        return f' id="{name}-{match[1]}"' if match[1] in used else ""

    text = re.sub(r' id="([^"]*)"', rename, text)
    return re.sub(r'(url\(#|href="#)([^")]+)', rf"\g<1>{name}-\2", text)
