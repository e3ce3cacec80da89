"""Our recipes can be collected; the page about them says what they say and runs as it stands."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import weighttraj as wt
from tests.pages import run_page
from tests.small import SMALL_RECIPE
from weighttraj.collect import read_recipe
from weighttraj.collect.population import check_config
from weighttraj.collect.recipe import SPLITS

ROOT = Path(__file__).parents[1]
RECIPES = sorted(ROOT.glob("datasets/*/recipe.toml"))
PAGE = (ROOT / "datasets/README.md").read_text()

# The page runs as it stands, on shorter trainings: a second each.
SHORT = "256\nn_steps = 64\nbatch_size = 16\nn_epochs = 8"
SHORTER = {" = 40_960": f" = {SHORT}", "=40_960": "=256"}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tests/benchmarks"))
    return importlib.import_module("bench_recipes")


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.parent.name)
def test_a_recipe_can_be_collected(path: Path) -> None:
    recipe = read_recipe(path)
    assert recipe.id == path.parent.name
    if recipe.collect.collector == "population":
        check_config(recipe.ppo)


def test_the_table_is_fresh(bench: ModuleType) -> None:
    assert bench.insert(PAGE) == PAGE, "run: python tests/benchmarks/bench_recipes.py --table"
    stale = PAGE.replace("| 71,948 |", "| 71,949 |")
    assert bench.insert(stale) == PAGE != stale


def test_sizes_of_a_recipe_are_those_of_its_runs(bench: ModuleType, small_dataset: Path) -> None:
    run = wt.open(small_dataset).runs[0]
    assert bench.snapshots_of(SMALL_RECIPE) == len(run)
    assert bench.parameters_of(SMALL_RECIPE) == run.layout.size


@pytest.mark.parametrize(
    ("name", "parameters", "snapshots"),
    [("inverted-pendulum-v4-ppo-v1", 122, 1951), ("half-cheetah-v4-ppo-v1", 71_948, 4881)],
)
def test_sizes_of_the_papers_recipes(
    bench: ModuleType, name: str, parameters: int, snapshots: int
) -> None:
    recipe = read_recipe(ROOT / "datasets" / name / "recipe.toml")
    assert (bench.parameters_of(recipe), bench.snapshots_of(recipe)) == (parameters, snapshots)


def test_every_block_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in RECIPES:
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True)
        copy.write_text(path.read_text().replace("1_000_000", SHORT).replace('"0:6"', '"0:2"'))
    run_page(ROOT / "datasets/README.md", SHORTER)
    for name, runs in (("swimmer-short", 6), ("reacher-v4-ppo-v1", 6), ("walker", 4)):
        assert len(wt.open(tmp_path / "data" / name).info.runs) == runs


# What lies in this repository

RELEASED = sorted(path.parent for path in ROOT.glob("datasets/*/data/dataset.json"))


@pytest.mark.parametrize("path", RELEASED, ids=lambda path: path.parent.name)
def test_a_released_data_set_is_whole(path: Path) -> None:
    dataset = wt.open(path.parent.name)
    recipe = read_recipe(path.parent / "recipe.toml")
    assert dataset.info.status == "complete"
    assert {run.info.seed: run.split for run in dataset} == recipe.splits()
    assert wt.verify(path, deep=True) == []
    assert wt.lint(path) == []
    assert sum(file.stat().st_size for file in path.rglob("*")) < 60e6


def test_the_released_pendulums_are_at_the_papers_scale() -> None:
    dataset = wt.open("inverted-pendulum-v4-ppo-v1")
    assert [len(dataset.split(name).runs) for name in SPLITS] == [30, 10, 10]
    evaluated = {*range(100), *range(0, 1951, 10), 1950}
    for run in dataset:
        assert run.weights.shape == (1951, 122)
        assert run["probe/observations"].shape[1:] == (32, 4)
        assert run.returns.shape == (1951, 20)
        for deterministic in (True, False):
            means = run.mean_return(deterministic=deterministic)
            assert set(np.flatnonzero(np.isfinite(means)).tolist()) == evaluated


@pytest.mark.parametrize("path", RELEASED, ids=lambda path: path.parent.name)
def test_the_facts_are_fresh(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tests/benchmarks"))
    facts = importlib.import_module("facts")
    page = (path.parent / "README.md").read_text()
    told = f"run: python tests/benchmarks/facts.py {path.parent.name}"
    assert facts.insert(page, wt.open(path)) == page, told
