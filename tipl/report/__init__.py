"""Results as tables, figures and a page."""

from tipl.report.page import write_report
from tipl.report.tables import insert_markdown, label, markdown, verdict

__all__ = ["insert_markdown", "label", "markdown", "verdict", "write_report"]
