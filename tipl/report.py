"""Results as a figure, a table and a page."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import jinja2
import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tipl.errors import EvaluateError

LABELS = {"tipl": "TIPL", "persistence": "copy"}
SHOWN_HORIZONS = (1, 2, 5, 10)
COLORS = {"tipl": "#c0392b", "persistence": "#2c3e50"}


def verdict(results: dict[str, Any]) -> str:
    """One plain sentence a measure: does the model beat a copy of the last weights?"""
    by_name = results["forecasters"]
    copy = by_name["persistence"]
    sentences = []
    for name, scores in by_name.items():
        if name == "persistence" or scores["floor"]:
            continue
        skills = scores["skill"]
        better = [row["h"] for row in skills if row["value"] > 0]
        first, last = skills[0], skills[-1]
        relation = (
            "beats" if len(better) == len(skills) else "loses to" if not better else "splits with"
        )
        sentences.append(
            f"In weight error, {label(name)} {relation} copying the last weights: its WPE is "
            f"{1 - first['value']:.3g} times the copy's at h = {first['h']} and "
            f"{1 - last['value']:.3g} times at h = {last['h']}."
        )
        for mode, errors in scores["repw"].items():
            ours, theirs = (sum(r["value"] for r in rows) for rows in (errors, copy["repw"][mode]))
            relation = "smaller" if ours < theirs else "larger"
            ratio = f"{ours / theirs:.3g} times the copy's" if theirs else "the copy's is 0"
            sentences.append(
                f"In return ({mode} actions), its REPW over all horizons is {relation} ({ratio})."
            )
    return " ".join(sentences)


def label(name: str) -> str:
    """What a forecaster is called in text."""
    return LABELS.get(name, name.replace("reconstruction-", "floor, rank "))


def table(results: dict[str, Any]) -> list[dict[str, Any]]:
    """One row for each forecaster and horizon: WPE, skill with interval, REPW by mode."""
    rows = []
    for name, scores in results["forecasters"].items():
        for i, skill in enumerate(scores["skill"]):
            repw = {mode: values[i]["value"] for mode, values in scores["repw"].items()}
            rows.append({"name": name, **skill, "wpe": scores["wpe"][i]["value"], "repw": repw})
    return rows


def markdown(results: dict[str, Any]) -> str:
    """Table and verdict as Markdown: what README shows of a result file."""
    modes = results["modes"]
    head = ["forecaster", "h", "WPE", "skill", *(f"REPW, {mode}" for mode in modes)]
    lines = [" | ".join(head), " | ".join(["---"] + ["---:"] * (len(head) - 1))]
    for row in table(results):
        if row["h"] in SHOWN_HORIZONS:
            cells = [label(row["name"]), str(row["h"]), f"{row['wpe']:.3g}", f"{row['value']:.3g}"]
            cells += [f"{row['repw'][mode]:.1f}" for mode in modes]
            lines.append(" | ".join(cells))
    return "\n".join([f"| {line} |" for line in lines] + ["", verdict(results)])


def insert_markdown(results: dict[str, Any], source: Path, page: Path) -> None:
    """Replace what stands between the markers of a result file in a Markdown page.

    The markers are comments that begin with ``results of <source>`` and ``end of results``.

    Raises:
        EvaluateError: the page has no such markers.
    """
    text = page.read_text()
    before, start, rest = text.partition(f"<!-- results of {source}")
    marker_end, close, rest = rest.partition("-->\n")
    _, end, after = rest.partition("<!-- end of results -->")
    if not (start and close and end):
        raise EvaluateError(
            "the page has no place for these results",
            expected=f"<!-- results of {source} --> and <!-- end of results -->, a line each",
            where=page,
            do="write both lines where the table shall stand",
        )
    page.write_text(f"{before}{start}{marker_end}{close}\n{markdown(results)}\n\n{end}{after}")


def figure(results: dict[str, Any], mode: str) -> Figure:
    """The paper's figure, with what it leaves out: the copy and the floor.

    Left: WPE and REPW against the forecast step. Right: return of the true policy against the
    return of the forecast policy, over all steps.
    """
    fig = Figure(figsize=(12, 4.2), layout="constrained")
    wpe, repw, scatter = fig.subplots(1, 3)
    for name, scores in results["forecasters"].items():
        for axes, rows in ((wpe, scores["wpe"]), (repw, scores["repw"].get(mode, []))):
            if rows:
                h, y = [row["h"] for row in rows], [row["value"] for row in rows]
                axes.plot(h, y, "o-", ms=3, label=label(name), color=_color(name, scores))
        for points in scores["returns"].get(mode, []):
            true, forecast = points["true"], points["forecast"]
            scatter.plot(true, forecast, "o", ms=3, alpha=0.5, color=_color(name, scores))
    if mode in results["noise_floor"]:
        floor = results["noise_floor"][mode]
        repw.axhline(floor, ls=":", color="black", label="noise floor: true policy, other episodes")
    _style(wpe, "forecast step h", "WPE: mean squared error of weights")
    wpe.set_yscale("log")
    _style(repw, "forecast step h", f"REPW: |J(true) - J(forecast)|, {mode}")
    repw.set_ylim(bottom=0)
    _style(scatter, "J(true policy)", "J(forecast policy)")
    scatter.axline((0, 0), slope=1, ls=":", color="black")
    fig.legend(*repw.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
    return fig


def _color(name: str, scores: dict[str, Any]) -> str | None:
    return "#7f8c8d" if scores["floor"] else COLORS.get(name)


def _style(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)


def svg(fig: Figure) -> str:
    """The figure as text that can stand inside a page; the same bytes for the same figure."""
    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "weighttraj"}):
        fig.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue().split("?>", 1)[-1]


def write_report(results: dict[str, Any], out: Path) -> Path:
    """Write the page and the figure beside ``results.json``; returns the page's path."""
    modes = results["modes"]
    figures = {mode: svg(figure(results, mode)) for mode in modes}
    for mode in modes:
        figure(results, mode).savefig(out / f"figure-{mode}.png", dpi=150)
    loader = jinja2.PackageLoader("tipl", "templates")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    page = environment.get_template("report.html").render(
        results=results, verdict=verdict(results), rows=table(results), figures=figures, label=label
    )
    path = out / "report.html"
    path.write_text(page)
    return path
