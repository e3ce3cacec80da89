"""README is true: its Python and its commands run as they stand, its numbers come from a file."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import weighttraj as wt
from tipl.report.markdown import places, render, rewrite

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted([*ROOT.glob("docs/*.md"), *ROOT.glob("cards/**/*.md")])]
BLOCKS = re.findall(r"```(python|bash)\n(.*?)```", README, re.DOTALL)

# The commands run as they stand, on a shorter recipe and with less of what only takes time.
SHORTER = {
    "--n-batches 500": "--n-batches 4",
    "--n-batches 400": "--n-batches 4",
    "--steps 500": "--steps 4",
    "--episodes 5": "--episodes 1",
}
SHORT_RECIPE = {
    "51_200": "768\nn_steps = 64\nbatch_size = 16\nn_epochs = 2\ncritic_arch = [8, 8]",
    "every = 64": "every = 2\nblock = 8\nprobe_observations = 4",
}
OF_THE_ZOO = "tipl.load("
"""In a block that needs runs of the cadence that released models are for."""
NOT_RUN = ("make ", ". .venv")  # they would run this test; the environment is active


@pytest.fixture
def folder(tmp_path: Path, small_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a reader stands; the released data set and the recipe are short ones."""
    released = tmp_path / "datasets/inverted-pendulum-v4-ppo-v1"
    shutil.copytree(small_dataset, released)
    wt.policies.fill_returns(released, wt.policies.ReturnsConfig(episodes=1, every=24))
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(released.parent))
    recipe = (ROOT / "datasets/demo/recipe.toml").read_text()
    for long, short in SHORT_RECIPE.items():
        assert long in recipe
        recipe = recipe.replace(long, short)
    (tmp_path / "datasets/demo").mkdir()
    (tmp_path / "datasets/demo/recipe.toml").write_text(recipe)
    return tmp_path


@pytest.mark.timeout(500)  # each command starts a process
def test_every_block_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    used = set()
    for kind, text in BLOCKS:
        if OF_THE_ZOO in text:
            continue
        if kind == "python":
            exec(compile(text, "README.md", "exec"), names)  # noqa: S102
            continue
        for line in text.splitlines():
            command = line.split("#")[0].strip()
            if not command or command.startswith(NOT_RUN):
                continue
            for long, short in SHORTER.items():
                used |= {long} if long in command else set()
                command = command.replace(long, short)
            program, *rest = shlex.split(command)
            module = [sys.executable, "-m", f"{program}.cli"]
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            done = subprocess.run(
                [*module, *rest], capture_output=True, text=True, check=False, env=environment
            )
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    assert used == set(SHORTER)
    assert names["weights"].shape == (49, 122)
    assert names["second"]["weights"].shape == (4, 20, 122)
    assert names["batch"]["weights"].shape[1:] == (20, 122)
    assert (folder / "data/demo/report/report.html").exists()


def test_a_released_model_raises_the_return() -> None:
    (block,) = (text for _, text in BLOCKS if OF_THE_ZOO in text)
    *lines, before, after = block.splitlines()
    unseen = wt.open("inverted-pendulum-v4-ppo-v1").split("test").runs[0]
    names = {"unseen": unseen, "load_policies": wt.policies.load_policies}
    names["evaluate"] = wt.policies.evaluate
    exec("\n".join(lines), names)  # noqa: S102
    assert eval(after, names) > eval(before, names) + 100  # noqa: S307


def test_the_makefile_runs_the_readmes_commands() -> None:
    makefile = (ROOT / "Makefile").read_text()
    makefile = makefile.replace("$(BIN)/", "").replace("$(DEMO)", "data/demo")
    commands = [line for kind, text in BLOCKS if kind == "bash" for line in text.splitlines()]
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
        results = json.loads(Path(source).read_text())
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
        assert target.startswith("https://") or (ROOT / target).exists(), target
