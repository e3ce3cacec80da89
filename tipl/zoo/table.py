"""The released models as a table in a Markdown page."""

from __future__ import annotations

from pathlib import Path

from tipl import registry
from tipl.report.markdown import rewrite
from tipl.report.scores import GAIN, SKILL, row_at
from tipl.report.tables import cell
from tipl.saved import ARRAYS
from tipl.zoo.metrics import read_metrics
from weighttraj import text
from weighttraj.atomic import replace_file

FIGURES = (("skill", SKILL, 10), ("gain", GAIN, 50), ("gain", GAIN, 100))
COLUMNS = (*(f"{what}, h = {h}" for what, _, h in FIGURES), "kB", "trained on")
CARDS = "cards/models"
"""Folder of the cards, beside the page."""


def insert_models(page: Path) -> None:
    """Write the table between ``<!-- models of zoo: ... -->`` and ``<!-- end of models -->``.

    Raises:
        EvaluateError: the page has no such place.
    """
    old = page.read_text(encoding="utf-8")
    new = rewrite(old, "models", "zoo", lambda _: models_table(page.parent / CARDS))
    replace_file(page.resolve(), new.encode())


def models_table(cards: Path) -> str:
    """Return a line for each released model that was evaluated, with a link to its card."""
    lines = [f"| model | {' | '.join(COLUMNS)} |", f"|---|{'---:|' * (len(COLUMNS) - 1)}---|"]
    for name in registry.names():
        card = f"{CARDS}/{name}.md"
        title = f"[{name}]({card})" if (cards / f"{name}.md").is_file() else text.markdown(name)
        lines.append(f"| {' | '.join([title, *_cells(registry.MODELS / name)])} |")
    return "\n".join(lines)


def _cells(folder: Path) -> list[str]:
    metrics = read_metrics(folder)
    size = sum(file.stat().st_size for file in folder.rglob(ARRAYS)) / 1000
    if metrics is None:
        return [*("-" for _ in FIGURES), f"{size:,.0f}", "-"]
    rows = (row_at(metrics.scores, measure, h) for _, measure, h in FIGURES)
    figures = [cell(row, interval=False) for row in rows]
    names = [text.markdown(trained.data) for trained in metrics.trained_on]
    many = f"{len(names)} data sets" if len(names) > 1 else "".join(names) or "-"
    return [*figures, f"{size:,.0f}", many]
