"""Pages whose figures come from result files say what the files say."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

STUDIES = Path(__file__).parents[1] / "docs/studies"


@pytest.mark.parametrize("name", ["final_normalizer"])
def test_the_page_says_what_was_measured(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(STUDIES))
    study = importlib.import_module(name)
    page = study.PAGE.read_text()
    assert study.insert(page) == page, f"the page is stale: run python docs/studies/{name}.py"
    stale = page.replace("snapshot's own normaliser,", "final normaliser,")
    assert study.insert(stale) == page != stale
