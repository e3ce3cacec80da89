"""Pages whose figures come from result files say what the files say."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import pytest

import weighttraj as wt

DOCS = Path(__file__).parents[1] / "docs"
STUDIES = Path(__file__).parents[1] / "docs/studies"


@pytest.mark.parametrize("name", ["final_normalizer"])
def test_the_page_says_what_was_measured(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(STUDIES))
    study = importlib.import_module(name)
    page = study.PAGE.read_text()
    assert study.insert(page) == page, f"the page is stale: run python docs/studies/{name}.py"
    stale = page.replace("snapshot's own normaliser,", "final normaliser,")
    assert study.insert(stale) == page != stale


def run_blocks(name: str, change: tuple[str, str] = ("", "")) -> dict[str, Any]:
    """Run the Python of a guide; returns its names."""
    names: dict[str, Any] = {}
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / f"{name}.md").read_text(), re.DOTALL)
    for block in blocks:
        exec(compile(block.replace(*change), f"{name}.md", "exec"), names)  # noqa: S102
    return names


def test_publish_and_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_blocks("publish", ("/tmp/weighttraj-published", f"{tmp_path}/published"))  # noqa: S108
    assert names["window"].shape == (20, 122)
    assert len(names["copy"]) == 50
    assert [len(run) for run in names["part"]] == [241, 241]
    assert wt.verify(tmp_path / "published/inverted-pendulum-v4-ppo-v1") == []


def test_bring_your_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_blocks("bring-your-own")
    for path in tmp_path.glob("data/mine/*.zarr"):
        assert wt.verify(path) == []
    made = wt.open("data/mine/all")
    assert {run.id: (run.split, len(run)) for run in made} == {
        "cartpole": ("train", 33),
        "pendulum": ("", 18),
        "checkpoints": ("test", 4),
    }
    before, after = names["returns"].returns.mean(1)
    assert after > before
