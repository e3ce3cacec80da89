"""All data sets that are here, and models by their cards, as pages that open from disk.

``index.html`` lists them and can be searched; each data set has the page that ``report`` writes,
and each card, of data or of a model, one of its own. No server is needed, and nothing is loaded
from elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2
from markdown_it import MarkdownIt
from markdown_it.token import Token
from rich.console import Console

from weighttraj.errors import WeightTrajError
from weighttraj.format.objects import replace_file
from weighttraj.publish import figures
from weighttraj.publish.curves import KINDS, curves
from weighttraj.publish.report import MARK, refuse_foreign, report
from weighttraj.publish.source import Source, facts, lead, open_source
from weighttraj.publish.svg import Picture

CARD = "README.md"
INDEX = "index.html"

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_FRONT = re.compile(r"\A---\n(.*?)\n---\n", re.DOTALL)
_SHOWN = ("environment", "algorithm", "runs", "snapshots", "parameters", "size on disk")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of the index."""

    id: str
    """What it is loaded by."""
    lead: str
    """What it is, in a sentence."""
    facts: list[tuple[str, str]]
    """Labels and values."""
    links: list[tuple[str, str]]
    """Names and addresses of its pages."""
    figure: Picture | None = None
    """Learning curves."""

    @property
    def words(self) -> str:
        """What it is found by, in lower case."""
        return " ".join([self.id, self.lead, *(value for _, value in self.facts)]).lower()


def gallery(
    datasets: dict[str, Path],
    out: str | Path,
    *,
    cards: Sequence[Path] = (),
    film: bool = True,
    console: Console | None = None,
) -> Path:
    """Write the pages of data sets and cards, and the index of them.

    Args:
        datasets: ids, and where the data sets lie. What is damaged is left out, and said so.
        out: folder to be written; pages of ours that are in it are replaced.
        cards: cards of models, Markdown files.
        film: with films of policies, as ``report`` makes them.
        console: where progress is shown; None: nowhere.

    Returns:
        The index.

    Raises:
        StoreExistsError: a page to be written is there, and is none of ours.
    """
    out, console = Path(out), console or Console(quiet=True)
    refuse_foreign(out / INDEX, overwrite=False)
    (out / "cards").mkdir(parents=True, exist_ok=True)
    found = []
    for name, path in datasets.items():
        console.print(name)
        try:
            found.append(_dataset(name, path, out, film, console))
        except WeightTrajError as error:
            console.print(f"  left out: {error}")
    models = [_model(card, out) for card in cards]
    page = _environment().get_template("gallery.html.j2")
    text = page.render(mark=MARK, datasets=found, models=models, script=SCRIPT, hash=_hash(SCRIPT))
    replace_file(out / INDEX, text.encode())
    return out / INDEX


def _dataset(name: str, path: Path, out: Path, film: bool, console: Console) -> Entry:
    source, place = open_source(path), name.replace("/", "__")
    page = f"data/{place}.html"
    report(path, out / page, film=film, console=console)
    links = [("returns, steps, path", page)]
    if (path / CARD).is_file():
        links.append(("card", _write_card(path / CARD, out, place)))
    said = [(label, value) for label, value in facts(source) if label in _SHOWN]
    return Entry(id=name, lead=lead(source), facts=said, links=links, figure=_curves(source))


def _curves(source: Source) -> Picture | None:
    """Its learning curves, if returns are stored."""
    runs = [run for run in source.runs if len(run)]
    for kind in KINDS:
        if lines := curves(runs, kind):
            return figures.returns(lines, kind)
    return None


def _model(card: Path, out: Path) -> Entry:
    text = card.read_text()
    front = _FRONT.match(text)
    about = re.findall(r"^datasets:\n((?:- .*\n?)+)", front[1] if front else "", re.MULTILINE)
    learnt = ", ".join(line[2:] for block in about for line in block.splitlines())
    body = _COMMENT.sub("", _FRONT.sub("", text))
    paragraphs = [p.strip() for p in re.split(r"\n\s*\n", body)]
    paragraphs = [p for p in paragraphs if p and not p.startswith("#")]
    first = re.sub(r"\[([^\]]*)\]\([^)]*\)|[*`]", r"\1", " ".join(paragraphs[:1])).strip()
    said = [("data", learnt)] if learnt else []
    return Entry(
        id=card.stem,
        lead=" ".join(first.split()),
        facts=said,
        links=[("card", _write_card(card, out, card.stem))],
    )


def _write_card(card: Path, out: Path, name: str) -> str:
    """Write the page of a card, with the pictures that lie beside it; returns its address."""
    html, pictures = as_html(card.read_text())
    for picture in pictures:
        source = card.parent / picture
        if source.is_file() and source.resolve().parent == card.parent.resolve():
            shutil.copyfile(source, out / "cards" / source.name)
    text = _environment().get_template("card.html.j2").render(mark=MARK, name=name, body=html)
    refuse_foreign(out / "cards" / f"{name}.html", overwrite=False)
    replace_file(out / "cards" / f"{name}.html", text.encode())
    return f"cards/{name}.html"


def as_html(text: str) -> tuple[str, list[str]]:
    """Markdown of a card as HTML, and the pictures that it shows.

    Raw HTML stays text; links within a repository, which lead nowhere from here, become text.
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(_COMMENT.sub("", _FRONT.sub("", text)))
    pictures: list[str] = []
    for token in tokens:
        token.children = _outward(token.children or [], pictures) if token.children else None
    return str(parser.renderer.render(tokens, parser.options, {})), pictures


def _outward(tokens: list[Token], pictures: list[str]) -> list[Token]:
    """Tokens without the links that lead nowhere; names of the pictures are noted."""
    kept, dropped = [], 0
    for token in tokens:
        if token.type == "image":
            pictures.append(str(token.attrs["src"]))
        target = str(token.attrs.get("href", "")) if token.type == "link_open" else ""
        if token.type == "link_open" and not target.startswith(("https://", "http://", "#")):
            dropped += 1
        elif token.type == "link_close" and dropped:
            dropped -= 1
        else:
            kept.append(token)
    return kept


def _environment() -> jinja2.Environment:
    loader = jinja2.PackageLoader("weighttraj.publish", "templates")
    return jinja2.Environment(
        loader=loader,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def _hash(script: str) -> str:
    """What the page's policy knows its one script by."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


SCRIPT = """
const field = document.getElementById("search"), told = document.getElementById("told");
const entries = [...document.querySelectorAll("[data-words]")];
function search() {
  const words = field.value.toLowerCase().split(/\\s+/).filter(Boolean);
  let count = 0;
  for (const entry of entries) {
    const fits = words.every((word) => entry.dataset.words.includes(word));
    entry.hidden = !fits;
    count += fits;
  }
  told.textContent = words.length ? `${count} of ${entries.length}` : "";
}
field.addEventListener("input", search);
if (location.hash.startsWith("#q=")) field.value = decodeURIComponent(location.hash.slice(3));
document.getElementById("finder").hidden = false;
search();
"""


__all__ = ["INDEX", "Entry", "as_html", "gallery"]
