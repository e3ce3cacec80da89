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
from pathlib import Path
from typing import Any

import pytest

from tipl.report import insert_markdown

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(python|bash)\n(.*?)```", README, re.DOTALL)

# The commands run as they stand, on a shorter recipe and with less of what only takes time.
SHORTER = {"--n-batches 500": "--n-batches 4", "--episodes 5": "--episodes 1"}
NOT_RUN = ("make ", ". .venv")  # they would run this test; the environment is active


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, small_dataset: Path) -> Path:
    """Where a reader stands after `make demo`, with shorter runs."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(small_dataset, folder / "data/demo/dataset")
    recipe = (ROOT / "datasets/demo/recipe.toml").read_text()
    recipe = recipe.replace('id = "demo"', 'id = "small"').replace('"0:3"', '"0:2"')
    recipe = recipe.replace('"3:4"', '"2:4"').replace(
        "every = 64", "every = 2\nblock = 8\nprobe_observations = 4"
    )
    recipe = recipe.replace(
        "51_200", "768\nn_steps = 64\nbatch_size = 16\nn_epochs = 2\ncritic_arch = [8, 8]"
    )
    (folder / "datasets/demo").mkdir(parents=True)
    (folder / "datasets/demo/recipe.toml").write_text(recipe)
    return folder


def test_every_block_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    used = set()
    for kind, text in BLOCKS:
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


def test_the_makefile_runs_the_readmes_commands() -> None:
    makefile = (ROOT / "Makefile").read_text()
    makefile = makefile.replace("$(BIN)/", "").replace("$(DEMO)", "data/demo")
    commands = [line for kind, text in BLOCKS if kind == "bash" for line in text.splitlines()]
    for name in ("weighttraj collect", "tipl train", "tipl evaluate"):
        command = next(line for line in commands if line.startswith(name))
        assert command in makefile


def test_the_numbers_come_from_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    page = tmp_path / "README.md"
    page.write_text(README)
    source = Path("datasets/demo/results.json")
    insert_markdown(json.loads(source.read_text()), source, page)
    assert page.read_text() == README, (
        "run: tipl report datasets/demo/results.json --into README.md"
    )


def test_the_benchmarks_come_from_the_file() -> None:
    file = ROOT / "tests/benchmarks/results.py"
    spec = importlib.util.spec_from_file_location("results", file)
    assert spec is not None
    assert spec.loader is not None
    results = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(results)
    assert results.insert(README) == README, f"run: python {file.relative_to(ROOT)}"


def test_links_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target
