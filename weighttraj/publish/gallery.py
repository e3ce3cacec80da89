"""All data sets that are here, and models by their cards, as pages that open from disk.

``index.html`` lists them and can be searched; each data set has the page that ``report`` writes,
and each card, of data or of a model, one of its own. No server is needed, and nothing is loaded
from elsewhere.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, unquote

from markdown_it import MarkdownIt
from markdown_it.token import Token
from rich.console import Console

from weighttraj.atomic import refuse_existing, refuse_link, replace_file
from weighttraj.errors import FormatError, WeightTrajError
from weighttraj.publish import figures
from weighttraj.publish.curves import KINDS, curves
from weighttraj.publish.report import MARK, refuse_foreign, report, template
from weighttraj.publish.source import Source, facts, lead, open_source
from weighttraj.publish.svg import Picture
from weighttraj.store.objects import MAX_NAME, read_plain

CARD = "README.md"
INDEX = "index.html"
PICTURES = (".png", ".jpg", ".jpeg", ".gif", ".webp", ".svg")
"""What a picture beside a card may be."""
MAX_CARD = 1 << 18
"""Bytes of a card, at most."""
MAX_PICTURE = 16 << 20
"""Bytes of a picture beside it, at most."""

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
    out.mkdir(parents=True, exist_ok=True)
    found, models = [], []
    for name, path in datasets.items():
        console.print(name, markup=False)
        with _left_out(console):
            found.append(_dataset(name, path, out, film, console))
    for card in cards:
        with _left_out(console):
            models.append(_model(card, out))
    page = template("gallery.html.j2")
    text = page.render(mark=MARK, datasets=found, models=models, script=SCRIPT, hash=_hash(SCRIPT))
    replace_file(out / INDEX, text.encode(), root=out)
    return out / INDEX


@contextlib.contextmanager
def _left_out(console: Console) -> Iterator[None]:
    """Say what is wrong with one entry, and go on without it."""
    try:
        yield
    except WeightTrajError as error:
        console.print(f"  left out: {error}", markup=False)


def page_name(name: str) -> str:
    """Return the name of a page without its ending; no two ids, or names of cards, share one."""
    page = quote(name, safe="/", errors="surrogateescape").replace("~", "%7E").replace("/", "~")
    if len(page) <= MAX_NAME:
        return page
    return f"{page[:100]}~~{hashlib.sha256(page.encode()).hexdigest()[:32]}"


def _dataset(name: str, path: Path, out: Path, film: bool, console: Console) -> Entry:
    source, place = open_source(path), page_name(name)
    card = path / CARD
    text = _card_text(card) if card.is_symlink() or card.exists() else None
    page = f"data/{place}.html"
    refuse_link(out / page, out)
    report(path, out / page, film=film, console=console)
    links = [("returns, steps, path", quote(page))]
    if text is not None:
        links.append(("card", _write_card(text, card, out, f"cards/{place}")))
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
    text = _card_text(card)
    front = _FRONT.match(text)
    about = re.findall(r"^datasets:\n((?:- .*\n?)+)", front[1] if front else "", re.MULTILINE)
    learnt = ", ".join(line[2:] for block in about for line in block.splitlines())
    paragraphs = [p.strip() for p in re.split(r"\n\s*\n", _body(text))]
    paragraphs = [p for p in paragraphs if p and not p.startswith("#")]
    start = " ".join(paragraphs[:1])[:2000]
    first = re.sub(r"\[([^\]]*)\]\([^)]*\)|[*`]", r"\1", start).strip()
    said = [("data", learnt)] if learnt else []
    page = _write_card(text, card, out, f"models/{page_name(card.stem)}")
    return Entry(id=card.stem, lead=" ".join(first.split()), facts=said, links=[("card", page)])


def _card_text(card: Path) -> str:
    """Return the text of a card.

    Raises:
        FormatError: it is a link, no file, too large, or no text.
    """
    try:
        return read_plain(card, MAX_CARD).decode()
    except UnicodeDecodeError as error:
        raise FormatError(
            "the card is no text in UTF-8", got=error, where=card, do="save it as UTF-8"
        ) from error


def _write_card(text: str, card: Path, out: Path, page: str) -> str:
    """Write the page of a card, with the pictures that lie beside it; return its address.

    Pictures lie in a folder of the page's own: two cards may have pictures of one name.
    """
    html, pictures = as_html(text, lambda src: _shown_as(card, src, page))
    target = out / f"{page}.html"
    refuse_foreign(target, overwrite=False)
    files = {out / page / name: card.with_name(name) for name in pictures}
    if not target.exists():  # no page of ours has put these there
        for file in files:
            refuse_existing(file)
    rendered = template("card.html.j2")
    body = rendered.render(mark=MARK, name=page.partition("/")[2], body=html)
    replace_file(target, body.encode(), root=out)
    for file, picture in files.items():
        replace_file(file, read_plain(picture, MAX_PICTURE), root=out)
    return quote(f"{page}.html")


def _shown_as(card: Path, src: str, page: str) -> tuple[str, str] | None:
    """Name and new address of a picture that lies beside a card; None: it is not shown."""
    name = unquote(src)
    if "/" in name or "\\" in name or not name.lower().endswith(PICTURES):
        return None
    try:
        read_plain(card.with_name(name), MAX_PICTURE)
    except (FormatError, ValueError):
        return None
    return name, quote(f"{page.rpartition('/')[2]}/{name}")


def _body(text: str) -> str:
    """A card without front matter and comments."""
    kept, at, text = [], 0, _FRONT.sub("", text)
    while (start := text.find("<!--", at)) >= 0 and (end := text.find("-->", start)) >= 0:
        kept.append(text[at:start])
        at = end + 3
    return "".join([*kept, text[at:]])


def as_html(
    text: str, shown_as: Callable[[str], tuple[str, str] | None] = lambda src: (src, src)
) -> tuple[str, list[str]]:
    """Render the Markdown of a card, and name the pictures that it shows.

    Raw HTML stays text; links within a repository, which lead nowhere from here, become text, and
    so do pictures that are not shown.

    Args:
        text: of the card.
        shown_as: returns name and address of a picture for its address in the card; None: it is
            not shown.
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(_body(text))
    pictures: list[str] = []
    for token in tokens:
        if token.children:
            token.children = _outward(token.children, pictures, shown_as)
    return str(parser.renderer.render(tokens, parser.options, {})), pictures


def _outward(
    tokens: list[Token],
    pictures: list[str],
    shown_as: Callable[[str], tuple[str, str] | None],
) -> list[Token]:
    """Tokens without the links that lead nowhere; names of the pictures are noted."""
    kept, dropped = [], 0
    for token in tokens:
        if token.type == "image":
            found = shown_as(str(token.attrs["src"]))
            if found is None:
                kept.append(Token("text", "", 0, content=token.content))
                continue
            pictures.append(found[0])
            token.attrs["src"] = found[1]
        target = str(token.attrs.get("href", "")) if token.type == "link_open" else ""
        if token.type == "link_open" and not target.startswith(("https://", "http://", "#")):
            dropped += 1
        elif token.type == "link_close" and dropped:
            dropped -= 1
        else:
            kept.append(token)
    return kept


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
