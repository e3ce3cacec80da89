"""Results in Markdown pages: each place says which file it shows, and which part of it.

A place begins with ``<!-- results of FILE, SECTION: rewrite with ... -->`` and ends with
``<!-- end of results -->``, a line each; what follows a colon is for readers. Without a section it
shows the overview. Text outside the places is never changed. Other writers mark their places in the
same way, with another word for *results*.

| section | what it shows |
|---|---|
| ``overview`` | skill and gain without intervals, and the result in plain sentences |
| ``table`` | the table of the overview |
| ``findings`` | one sentence for each model, and some about the best baselines |
| ``tables`` | all tables, the less important ones folded |
| ``figures`` | pictures, which lie in a folder beside the page, named after the result file |
| ``source`` | data, runs, starts and the command that made the results |
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from tipl.errors import EvaluateError
from tipl.evaluation.results import Results
from tipl.report.figures import figures, file_name, png, titles
from tipl.report.sentences import findings, sentences
from tipl.report.tables import Table, cell, compact, label, tables
from weighttraj import text
from weighttraj.atomic import replace_file

SECTIONS = ("overview", "table", "findings", "tables", "figures", "source")
DPI = 110
"""Resolution of pictures in Markdown pages."""

_START = r"<!-- (?P<what>\w+) of (?P<source>[^\s,]+?)(?:, (?P<section>\w+))?(?:: [^\n]*?)? -->\n"
_CONTENT = r"(?:(?!<!-- \w+ of ).)*?"
_PLACE = re.compile(
    rf"(?P<start>{_START})(?P<content>{_CONTENT})(?P<end><!-- end of (?P=what) -->)", re.DOTALL
)


@dataclass(frozen=True, kw_only=True)
class Place:
    """A part of a page that is rewritten."""

    what: str
    """First word of its marker: ``results``, for example."""
    source: str
    """What it shows: a result file, for example."""
    section: str
    """Part of the source that it shows."""
    empty: bool
    """Whether nothing was written into it yet."""


def places(page: str) -> list[Place]:
    """Return all places of a page, in order."""
    return [_place(match) for match in _PLACE.finditer(page)]


def rewrite(page: str, what: str, source: str, render: Callable[[str], str]) -> str:
    """Return the page with its places of one source rewritten.

    Args:
        page: the text of the page.
        what: first word of the markers: ``results``, for example.
        source: source of the places that are rewritten; others stay as they are.
        render: returns the content of a section.

    Raises:
        EvaluateError: the page has no such place.
    """
    if not any((place.what, place.source) == (what, source) for place in places(page)):
        raise EvaluateError(
            f"the page has no place for these {what}",
            expected=f"<!-- {what} of {source} --> and <!-- end of {what} -->, a line each",
            do="write both lines where the results belong",
        )

    def fill(match: re.Match[str]) -> str:
        place = _place(match)
        if (place.what, place.source) != (what, source):
            return match[0]
        content = render(place.section)
        return f"{match['start']}\n{content}\n\n{match['end']}"

    return _PLACE.sub(fill, page)


def insert_markdown(results: Results, source: Path, page: Path) -> None:
    """Write every place of a result file in a Markdown page, and the pictures that it shows."""
    old = page.read_text(encoding="utf-8")
    new = rewrite(old, "results", source.as_posix(), lambda s: render(results, source, s))
    if (source.as_posix(), "figures") in {(place.source, place.section) for place in places(new)}:
        folder = page.parent / source.stem
        for title, figure in figures(results).items():
            content = png(figure, dpi=DPI)
            replace_file(folder / file_name(title), content, root=folder.parent)
    replace_file(page.resolve(), new.encode())


def render(results: Results, source: Path, section: str) -> str:
    """Return one section as Markdown; nothing is drawn.

    Raises:
        EvaluateError: there is no such section.
    """
    if section not in SECTIONS:
        raise EvaluateError(
            "there is no such section of results",
            expected=", ".join(SECTIONS),
            got=section,
            where=source,
            do="change the marker in the page",
        )
    context = {
        "results": results,
        "file": source,
        "causal": [name for name, scores in results.forecasters.items() if scores.causal],
        "all_tables": tables,
        "file_name": file_name,
        "compact": compact,
        "findings_of": findings,
        "sentences": sentences,
        "table_lines": table_lines,
        "titles": titles,
    }
    return section_of("results.md", section, context)


def templates() -> jinja2.Environment:
    """Return the environment of Markdown templates."""
    loader = jinja2.PackageLoader("tipl", "templates")
    environment = jinja2.Environment(  # noqa: S701  Markdown, from our own templates
        loader=loader,
        trim_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"label": label, "text": text.markdown, "code": code, "yaml": text.yaml}
    return environment


def code(value: object) -> str:
    r"""Return what stands between backticks: a result file may be a stranger's.

    >>> code("a`b\n```")
    "a'b\\n'''"
    """
    return text.printable(value).replace("`", "'")


def section_of(template: str, section: str, context: dict[str, Any]) -> str:
    """Return the text of a section: of the macro of this name in a template."""
    sections: Any = templates().get_template(template).make_module(context)
    return str(getattr(sections, section)()).strip("\n")


def table_lines(table: Table, *, interval: bool = True) -> list[str]:
    """Return a table, line by line."""
    lines = [
        "| forecaster | " + " | ".join(table.columns) + " |",
        "|---|" + "---:|" * len(table.columns),
    ]
    for name, cells in table.rows:
        shown = " | ".join(cell(row, table.digits, interval=interval) for row in cells)
        lines.append(f"| {text.markdown(label(name))} | {shown} |")
    return lines


def _place(match: re.Match[str]) -> Place:
    return Place(
        what=match["what"],
        source=match["source"],
        section=match["section"] or "overview",
        empty=not match["content"].strip(),
    )
