"""Text that may be a stranger's, such as names in a data set: safe to print and to quote."""

from __future__ import annotations

import json
import re
import unicodedata

_PLAIN = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9.]+)+")
_MARKUP = re.compile(
    r"([\\`*<>|~&$]|\](?=[(\[])|:(?=//)|(?<=\S)@(?=\S)|(?<!\w)_|(?<=www)\.)", re.IGNORECASE
)


def printable(text: object, *, lines: bool = False) -> str:
    r"""Escape what a terminal obeys or does not show: control, format and bidirectional characters.

    >>> printable("CartPole\x1b[2J\u202e-v1")
    'CartPole\\x1b[2J\\u202e-v1'

    Args:
        text: anything; its ``str``.
        lines: leave line breaks and tabs as they are.
    """
    kept = "\n\t" if lines else ""
    return "".join(c if c in kept or _is_shown(c) else _escaped(c) for c in str(text))


def shortened(text: str, limit: int) -> str:
    """Cut the middle out of a text that is too long, and say how long it was.

    The end stays: an error that came through another process has its reason there.
    """
    if len(text) <= limit:
        return text
    half = limit // 2
    return f"{text[:half]}... ({len(text):,} characters) ...{text[-half:]}"


def markdown(text: object) -> str:
    r"""Escape text for one line of Markdown: no link, no HTML, no cell of a table begins in it.

    >>> markdown("n_steps <b>[x](y)|")
    'n_steps \\<b\\>[x\\](y)\\|'
    """
    return _MARKUP.sub(r"\\\1", printable(text))


def yaml(text: object) -> str:
    """Write text as a YAML scalar; only words such as ``cc-by-4.0`` need no quotes.

    >>> yaml("cc-by-4.0"), yaml("no")
    ('cc-by-4.0', '"no"')
    """
    plain = printable(text)
    return plain if _PLAIN.fullmatch(plain) else json.dumps(plain, ensure_ascii=False)


def between(page: str, start: str, end: str, content: str) -> str:
    r"""Return a page of Markdown with what stands between two marks replaced.

    >>> between("a <!-- x --> old <!-- end --> b", "<!-- x -->", "<!-- end -->", "new")
    'a <!-- x -->\n\nnew\n\n<!-- end --> b'

    Raises:
        ValueError: the page does not have each mark once.
    """
    before, rest = page.split(start)
    _, after = rest.split(end)
    return f"{before}{start}\n\n{content}\n\n{end}{after}"


def _is_shown(character: str) -> bool:
    return character.isprintable() or unicodedata.category(character) == "Zs"


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()
