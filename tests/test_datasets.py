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
from weighttraj.collect.agents import actor_parameters
from weighttraj.collect.population import Origin, check_config
from weighttraj.collect.settings import SPLITS
from weighttraj.learning import learning_phase

ROOT = Path(__file__).parents[1]
RECIPES = sorted(ROOT.glob("datasets/*/recipe.toml"))
PAGE = (ROOT / "datasets/README.md").read_text()

# The page runs as it stands, on shorter trainings: a second each.
SHORT = "256\nn_steps = 64\nbatch_size = 16\nn_epochs = 8"
SHORTER = {" = 40_960": f" = {SHORT}", "=40_960": "=256"}


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "datasets"))
    return importlib.import_module("pages")


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.parent.name)
def test_a_recipe_can_be_collected(path: Path) -> None:
    recipe = read_recipe(path)
    assert recipe.id == path.parent.name
    if recipe.collect.collector == "population":
        check_config(recipe.ppo)


def test_the_table_is_fresh(pages: ModuleType) -> None:
    assert pages.insert(PAGE) == PAGE, "run: python datasets/pages.py"
    stale = PAGE.replace("| 71,948 |", "| 71,949 |")
    assert pages.insert(stale) == PAGE != stale
    front = (ROOT / "README.md").read_text()
    assert pages.insert_short(front) == front, "run: python datasets/pages.py"


def test_sizes_of_a_recipe_are_those_of_its_runs(pages: ModuleType, small_dataset: Path) -> None:
    run = wt.open(small_dataset).runs[0]
    assert SMALL_RECIPE.n_snapshots == len(run)
    assert pages.parameters_of(SMALL_RECIPE) == run.layout.size


@pytest.mark.parametrize(
    ("name", "parameters", "snapshots"),
    [("inverted-pendulum-v4-ppo-v1", 122, 1951), ("half-cheetah-v4-ppo-v1", 71_948, 4881)],
)
def test_sizes_of_the_papers_recipes(
    pages: ModuleType, name: str, parameters: int, snapshots: int
) -> None:
    recipe = read_recipe(ROOT / "datasets" / name / "recipe.toml")
    assert (pages.parameters_of(recipe), recipe.n_snapshots) == (parameters, snapshots)


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
SUITE = [path for path in RELEASED if "16x16" in path.parent.name]
WITH_FACTS = sorted(path.parent for path in ROOT.glob("datasets/*/facts.json"))


@pytest.mark.parametrize("path", RELEASED, ids=lambda path: path.parent.name)
def test_a_released_data_set_is_whole(path: Path) -> None:
    dataset = wt.open(path.parent.name)
    recipe = read_recipe(path.parent / "recipe.toml")
    assert dataset.info.status == "complete"
    splits = {run.info.seed: run.split for run in dataset}
    assert splits.items() <= recipe.splits().items()
    part = f"{len(splits)} of {len(recipe.splits())}"
    assert dataset.info.part == (part if len(splits) < len(recipe.splits()) else "")
    assert wt.verify(path) == []
    assert wt.lint(path) == []
    assert sum(file.stat().st_size for file in path.rglob("*")) < 60e6


def test_the_suite_fits_into_a_clone() -> None:
    assert len(SUITE) == 6
    files = [file for path in SUITE for file in path.rglob("*")]
    assert sum(file.stat().st_size for file in files) < 110e6


@pytest.mark.parametrize("path", SUITE, ids=lambda path: path.parent.name)
def test_every_task_can_be_trained_and_evaluated_from_a_clone(path: Path) -> None:
    dataset = wt.open(path.parent.name)
    counts = {name: len(dataset.split(name)) for name in SPLITS}
    assert (counts["train"] >= 4, counts["validation"] >= 1, counts["test"] >= 4) == (True,) * 3
    for run in dataset:
        assert run.weights.shape[0] == read_recipe(path.parent / "recipe.toml").n_snapshots
        deterministic, sampled = (run.mean_return(deterministic=mode) for mode in (True, False))
        assert run.returns.shape == (len(run), 20)
        for means in (deterministic, sampled):
            rows = np.flatnonzero(np.isfinite(means))
            assert {0, len(run) - 1} <= set(rows.tolist())
            assert {*range(0, learning_phase(sampled) + 1, 10)} <= set(rows.tolist())


@pytest.mark.parametrize("path", SUITE, ids=lambda path: path.parent.name)
def test_a_run_of_every_task_begins_with_the_weights_that_its_seed_makes(path: Path) -> None:
    run = wt.open(path.parent.name).split("test").runs[0]
    origin = Origin(read_recipe(path.parent / "recipe.toml").ppo, seed=run.info.seed or 0)
    weights = np.concatenate(
        [p.detach().numpy().ravel() for p in actor_parameters(origin.model.policy).values()]
    )
    np.testing.assert_array_equal(run.weights[0], weights)


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


@pytest.mark.parametrize("path", WITH_FACTS, ids=lambda path: path.name)
def test_the_page_says_what_was_measured(path: Path, pages: ModuleType) -> None:
    recipe, facts = read_recipe(path / "recipe.toml"), pages.facts_of(path.name)
    assert (path / "README.md").read_text() == pages.render(recipe, facts), (
        "run: python datasets/pages.py"
    )
    assert (path / "curves.svg").is_file()


@pytest.mark.parametrize("path", RELEASED, ids=lambda path: path.parent.name)
def test_the_facts_are_those_of_the_runs_in_the_repository(path: Path, pages: ModuleType) -> None:
    facts, dataset = pages.facts_of(path.parent.name), wt.open(path)
    assert facts.here.runs == {name: len(dataset.split(name)) for name in SPLITS}
    assert facts.steps == dataset.runs[0].num_timesteps[-1]
    if facts.collected is None:  # then the means are those of the runs here
        last = np.mean([run.mean_return(deterministic=True)[-1] for run in dataset])
        assert facts.final["deterministic"].mean == pytest.approx(last, abs=0.06)
