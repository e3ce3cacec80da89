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

COLUMNS = ("skill, h = 1", "skill, h = 10", "gain, h = 50", "kB", "trained on")
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
        return ["-", "-", "-", f"{size:,.0f}", "-"]
    wanted = ((SKILL, 1), (SKILL, 10), (GAIN, 50))
    figures = [cell(row_at(metrics.scores, *each), interval=False) for each in wanted]
    tasks = list(dict.fromkeys(str(trained.environment) for trained in metrics.trained_on))
    many = f"{len(tasks)} tasks" if len(tasks) > 1 else text.markdown("".join(tasks) or "-")
    return [*figures, f"{size:,.0f}", many]
