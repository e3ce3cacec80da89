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
from tipl.zoo.table import models_table
from weighttraj.policies import evaluate

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("cards/**/*.md")])]


def test_every_block_runs(reader: Path) -> None:
    shorter = {
        "--quick --horizons 1 10 50 --return-horizons 10 50 --starts 100 --workers 2": (
            f"{QUICKER} --horizons 1 10 --return-horizons 10"
        ),
    }
    names = run_page(ROOT / "README.md", shorter, skip=("make ", "pip install"))
    assert names["run"].id == "seed0040"
    before, after = (
        evaluate(policies, names["run"], episodes=5).returns.mean()
        for policies in (names["now"], names["ahead"])
    )
    assert after > before + 100
    assert (reader / "data/demo/report/report.html").exists()


@pytest.mark.usefixtures("reader")
def test_reading_prints_what_the_page_says(capsys: pytest.CaptureFixture[str]) -> None:
    first = next(text for kind, text in blocks(ROOT / "README.md") if kind == "python")
    said = [line.partition("  # ")[2] for line in first.splitlines() if line.startswith("print(")]
    exec(compile(first, "README.md", "exec"), {})  # noqa: S102
    assert capsys.readouterr().out.splitlines() == said


def test_it_is_short() -> None:
    assert sum(any(map(str.isalnum, word)) for word in README.split()) <= 900


def test_the_makefile_runs_the_readmes_commands() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for name in ("RELEASED", "TIPL", "GATE"):
        (value,) = re.findall(rf"^{name} := (.+)$", makefile, re.MULTILINE)
        makefile = makefile.replace(f"$({name})", value)
    makefile = makefile.replace("$(BIN)/", "").replace("$(DEMO)", "data/demo")
    for page, names in {
        "README.md": ["tipl evaluate"],
        "docs/quickstart.md": ["weighttraj collect", "weighttraj returns", "tipl train"],
    }.items():
        commands = [
            line
            for kind, text in blocks(ROOT / page)
            if kind == "bash"
            for line in text.splitlines()
        ]
        for name in names:
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


def test_readme_shows_the_demo_the_results_and_the_models() -> None:
    shown = [(place.what, place.source, place.section, place.empty) for place in places(README)]
    assert shown == [
        ("results", "datasets/demo/results.json", "table", False),
        ("models", "zoo", "overview", False),
        ("live", "docs/studies/live/test/results.json", "summary", False),
    ]


def test_the_table_of_models_is_that_of_the_zoo() -> None:
    table = models_table(ROOT / "cards/models")
    assert rewrite(README, "models", "zoo", lambda _: table) == README, "run: make readme"


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
