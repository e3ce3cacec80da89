"""Results as tables, figures and pages."""

from tipl.report.markdown import insert_markdown
from tipl.report.page import write_report
from tipl.report.tables import label
from tipl.report.verdict import verdict

__all__ = ["insert_markdown", "label", "verdict", "write_report"]
