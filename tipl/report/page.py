"""Results as one page that opens from disk."""

from __future__ import annotations

from pathlib import Path

import jinja2

from tipl.evaluation.results import Results
from tipl.report.figures import figures, file_name, svg
from tipl.report.tables import cell, headline, label, tables
from tipl.report.verdict import verdict


def write_report(results: Results, out: Path) -> Path:
    """Write the page and the figures beside ``results.json``; return the path of the page."""
    drawn = figures(results)
    for title, figure in drawn.items():
        figure.savefig(out / file_name(title), dpi=150)
    loader = jinja2.PackageLoader("tipl", "templates")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
    page = environment.get_template("report.html").render(
        results=results,
        verdict=verdict(results),
        overview=headline(results),
        tables=tables(results),
        figures={title: svg(figure) for title, figure in drawn.items()},
        label=label,
        cell=cell,
    )
    path = out / "report.html"
    path.write_text(page, encoding="utf-8")
    return path
