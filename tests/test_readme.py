"""README is true: its Python and its commands run as they stand, its numbers come from a file."""

from __future__ import annotations

import importlib.util
import re
from functools import partial
from pathlib import Path

import pytest

from tests.pages import QUICKER, blocks, run_page
from tipl.evaluation.results import read_results
from tipl.report.markdown import places, render, rewrite
from weighttraj.policies import evaluate

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("cards/**/*.md")])]


def test_every_block_runs(reader: Path) -> None:
    shorter = {
        "--n-batches 500": "--n-batches 4",
        "--episodes 5": "--episodes 1",
        "--quick --workers 2": f"{QUICKER} --horizons 1 10 50",
    }
    names = run_page(ROOT / "README.md", shorter, skip=("make ", ". .venv"))
    assert names["batch"]["weights"].shape == (64, 20, 122)
    assert names["returns"].shape == (5, 20)
    before, after = (
        evaluate(policies, names["unseen"], episodes=5).returns.mean()
        for policies in (names["now"], names["now"].with_weights(names["jump"][None]))
    )
    assert after > before + 100
    assert (reader / "data/demo/report/report.html").exists()
    assert (reader / ".local/share/bash-completion/completions/tipl").stat().st_size > 1000


def test_the_makefile_runs_the_readmes_commands() -> None:
    makefile = (ROOT / "Makefile").read_text()
    makefile = makefile.replace("$(BIN)/", "").replace("$(DEMO)", "data/demo")
    commands = [
        line
        for kind, text in blocks(ROOT / "README.md")
        if kind == "bash"
        for line in text.splitlines()
    ]
    for name in ("weighttraj collect", "weighttraj returns", "tipl train", "tipl evaluate"):
        command = next(line for line in commands if line.startswith(name))
        assert command.split("  ")[0] in makefile


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_numbers_come_from_their_files(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every place of results whose file is here; a file that is not yet there has no numbers."""
    monkeypatch.chdir(ROOT)
    text = page.read_text()
    for source in {place.source for place in places(text) if place.what == "results"}:
        if not Path(source).exists():
            assert all(place.empty for place in places(text) if place.source == source), source
            continue
        results = read_results(Path(source))
        fresh = rewrite(text, "results", source, partial(render, results, Path(source)))
        assert fresh == text, f"run: tipl report {source} --into {page.relative_to(ROOT)}"
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text):
        assert (page.parent / picture).exists(), picture


def test_readme_shows_the_demo() -> None:
    shown = [(place.what, place.source, place.empty) for place in places(README)]
    assert shown == [("results", "datasets/demo/results.json", False)]


def test_the_benchmarks_come_from_the_file() -> None:
    file = ROOT / "tests/benchmarks/results.py"
    spec = importlib.util.spec_from_file_location("results", file)
    assert spec is not None
    assert spec.loader is not None
    results = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(results)
    page = results.PAGE.read_text()
    assert results.insert(page) == page, f"run: python {file.relative_to(ROOT)}"


def test_links_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", README):
        path = target.partition("#")[0]
        assert target.startswith("https://") or (ROOT / path).exists(), target
