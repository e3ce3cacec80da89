"""Sphinx: the Markdown pages of the repository, where they lie, as one site. ``make docs``."""

from __future__ import annotations

from typing import Any

import weighttraj

project = "weighttraj"
author = "the weighttraj authors"
version = release = weighttraj.__version__

# Sources are found from the top of the repository, so that links between pages hold on any
# Git server too.
root_doc = "docs/index"
include_patterns = [
    "docs/**.md",
    "cards/**.md",
    "datasets/README.md",
    "datasets/*/README.md",
    "weighttraj/format/FORMAT.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
]
exclude_patterns = [".*", "data", "docs/_build", "dist", "docs/results"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
html_theme = "furo"
html_title = "weighttraj"
html_show_copyright = False
html_extra_path = ["index.html"]


def prose_of_a_field(_: Any, what: str, *rest: Any) -> None:
    """Napoleon takes words before a colon in the first line for a type: put a comment there."""
    if what in ("attribute", "property", "data"):
        rest[-1][:0] = ["..", ""]


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", prose_of_a_field, priority=400)
