"""Data sets by id on this machine: found, searched, combined, split, deleted."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import weighttraj as wt
from tests.shell import shell
from tests.small import SMALL_RECIPE
from weighttraj.collect import collect, replay
from weighttraj.collect.settings import Seeds
from weighttraj.errors import (
    CollectError,
    FormatError,
    RegistryError,
    StoreExistsError,
    WeightTrajError,
)
from weighttraj.locate import VARIABLE, clone, locate
from weighttraj.registry import combine, create, delete, local_datasets, search, select, split
from weighttraj.registry.derive import SPLITS, _parts
from weighttraj.store.catalog import read_dataset_info, write_dataset_info


@pytest.fixture
def store(small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of data sets: one of its own name, one below ``data``, one with a namespace."""
    folder = tmp_path / "store"
    shutil.copytree(small_dataset, folder / "small")
    shutil.copytree(small_dataset, folder / "below" / "data")
    shutil.copytree(small_dataset, folder / "team" / "theirs")
    (folder / "notes").mkdir()
    monkeypatch.setenv(VARIABLE, str(folder))
    return folder


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of the same seeds as the small ones, and of another environment."""
    path = tmp_path_factory.mktemp("other") / "other"
    ppo = replace(SMALL_RECIPE.ppo, env_id="CartPole-v1", total_timesteps=128)
    recipe = replace(SMALL_RECIPE, id="other", ppo=ppo, seeds=Seeds(train=[0], test=[1]))
    collect(recipe, path)
    return path


# What is here


def test_data_sets_are_found_as_they_are_named(store: Path) -> None:
    found = {dataset.id: dataset for dataset in local_datasets()}
    assert {"small", "below", "team/theirs", "inverted-pendulum-v4-ppo-v1"} <= found.keys()
    assert "notes" not in found
    for name, dataset in found.items():
        assert locate(name) == dataset.path
    assert found["small"].size == sum(
        file.stat().st_size for file in (store / "small").rglob("*") if file.is_file()
    )
    assert [run.id for run in found["below"].info.runs] == [
        run.id for run in wt.open("team/theirs")
    ]


def test_the_first_folder_wins(
    store: Path, other: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(other, tmp_path / "first" / "small")
    monkeypatch.setenv(VARIABLE, f"{tmp_path / 'first'}:{store}")
    (found,) = (dataset for dataset in local_datasets() if dataset.id == "small")
    assert found.info.id == "other"
    assert wt.open("small").info.id == "other"


def test_without_the_variable_home_is_looked_in(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    shutil.copytree(store / "small", tmp_path / "home/.weighttraj/datasets/mine")
    assert wt.open("mine").info.id == "small"
    with pytest.raises(FileNotFoundError, match="none of that id in"):
        wt.open("team/nobody")


def test_a_damaged_data_set_does_not_hide_the_others(store: Path) -> None:
    file = store / "small/dataset.json"
    file.write_text(file.read_text().replace("seed0001", "seed0009"))
    done = shell("weighttraj", "list")
    assert done.returncode == 0
    assert "damaged" in done.stdout
    assert "team/theirs" in done.stdout


# Search


def test_a_search_finds_runs_by_what_they_are(store: Path, other: Path) -> None:
    shutil.copytree(other, store / "other")
    everything = search()
    assert Counter(everything["dataset"])["other"] == 2
    assert len(search("env == 'CartPole-v1'")) == 2
    found = search("dataset == 'small' and seed >= 1 and `hyperparameters.batch_size` == 16")
    assert found["run_id"].tolist() == ["seed0001", "seed0002", "seed0003"]
    assert search("final_return > 1e9").empty
    returns = [run.final_return for run in wt.open("small")]
    lowest = search(f"dataset == 'small' and final_return <= {min(returns)}")
    assert lowest["final_return"].tolist() == [min(returns)]


def test_data_sets_without_a_table_are_searched_too(store: Path) -> None:
    shutil.rmtree(store / "small/tables")
    kept = search("dataset == 'below'").drop(columns="dataset")
    built = search("dataset == 'small'").drop(columns="dataset")
    for column in kept.columns:
        assert kept[column].tolist() == built[column].tolist() or kept[column].isna().all()


@pytest.mark.parametrize("query", ["env ==", "colour == 'red'", "import os", "seed + 1"])
def test_queries_that_mean_nothing_are_refused(query: str, store: Path) -> None:
    with pytest.raises(RegistryError, match=r"cannot be understood(.|\n)*final_return"):
        search(query)


@pytest.mark.parametrize("name", ["tables/runs.parquet", "dataset.json"])
def test_a_damaged_data_set_is_named_and_the_others_are_searched(name: str, store: Path) -> None:
    if name == "dataset.json":  # which is read where there is no table
        shutil.rmtree(store / "small/tables")
    (store / "small" / name).write_bytes(b"damaged")
    with pytest.raises(FormatError, match=name):
        search("seed == 2")
    errors: list[WeightTrajError] = []
    found = search("seed == 2", damaged=errors.append)
    assert {"below", "team/theirs"} <= set(found["dataset"])
    assert "small" not in set(found["dataset"])
    (error,) = errors
    assert name in str(error)
    done = shell("weighttraj", "search", "seed == 2", "--columns", "dataset")
    assert done.returncode == 0
    assert "team/theirs" in done.stdout
    assert name in done.stderr.replace("\n", "")


def test_what_pandas_would_read_in_a_table_besides_its_columns_does_not_matter(store: Path) -> None:
    file = store / "small/tables/runs.parquet"
    table = pq.read_table(file)
    pq.write_table(table.replace_schema_metadata({"pandas": "{}"}), file)  # pandas: KeyError
    assert len(search("dataset == 'small' and seed == 1")) == 1


# New ones of old ones


def test_combined_runs_keep_their_bytes_and_splits(
    store: Path, other: Path, tmp_path: Path
) -> None:
    both = combine([store / "small", other], tmp_path / "both")
    assert wt.verify(both.path, deep=True) == []
    assert [run.id for run in both][-2:] == ["other.seed0000", "other.seed0001"]
    assert both.info.id == "both"
    assert both.info.recipe == {
        "combined": [{"id": "small", "version": "1"}, {"id": "other", "version": "1"}]
    }
    old = [*wt.open(store / "small"), *wt.open(other)]
    for ours, theirs in zip(both, old, strict=True):
        assert (ours.split, ours.info.seed) == (theirs.split, theirs.info.seed)
        assert ours.info.run_id == ours.id
        assert replace(ours.info, run_id=theirs.id) == theirs.info
        for name in theirs.arrays:
            assert np.array_equal(ours[name][:], theirs[name][:], equal_nan=True)
    with pytest.raises(CollectError, match="not collected from a recipe"):
        replay(both.path, 3)


def test_runs_of_other_ids_keep_them(store: Path, tmp_path: Path) -> None:
    seeds = Seeds(train=[7])
    collect(replace(SMALL_RECIPE, id="more", seeds=seeds), tmp_path / "more")
    both = combine(["small", tmp_path / "more"], tmp_path / "both", name="both-v1")
    assert both.info.id == "both-v1"
    assert [run.id for run in both] == [f"seed000{n}" for n in (0, 1, 2, 3, 7)]
    packed = [store / "small/runs/seed0000.zarr.zip", both.path / "runs/seed0000.zarr.zip"]
    assert packed[0].read_bytes() == packed[1].read_bytes()


def test_what_cannot_be_one_is_refused(store: Path, tmp_path: Path) -> None:
    for paths in (["small"], ["small", "below"]):
        with pytest.raises(RegistryError, match="of different ids"):
            combine(paths, tmp_path / "out")
    info = read_dataset_info(store / "team/theirs")
    write_dataset_info(store / "team/theirs", replace(info, id="theirs", licence="CC-BY-NC-4.0"))
    with pytest.raises(RegistryError, match=r"same licence(.|\n)*NC"):
        combine(["small", "team/theirs"], tmp_path / "out")
    write_dataset_info(store / "team/theirs", replace(info, id="theirs", status="collecting"))
    with pytest.raises(RegistryError, match="only a complete data set"):
        combine(["small", "team/theirs"], tmp_path / "out")
    (tmp_path / "out").mkdir()
    with pytest.raises(StoreExistsError):
        split("small", tmp_path / "out")


def test_runs_become_a_data_set(store: Path, other: Path, tmp_path: Path) -> None:
    runs = [store / "small/runs/seed0002.zarr.zip", other / "runs/seed0001.zarr.zip"]
    made = create(runs, tmp_path / "made", splits={"seed0001": "test"}, licence="MIT")
    assert wt.verify(made.path, deep=True) == []
    assert [(run.id, run.split) for run in made] == [("seed0002", ""), ("seed0001", "test")]
    assert (made.info.licence, made.info.status) == ("MIT", "complete")
    for clash in ([runs[0], store / "below/data/runs/seed0002.zarr.zip"], []):
        with pytest.raises(RegistryError, match="each of its own id"):
            create(clash, tmp_path / "out")
    for splits in ({"seed0007": "test"}, {"seed0001": "exam"}):
        with pytest.raises(RegistryError, match="not those of these runs"):
            create(runs, tmp_path / "out", splits=splits)
    with pytest.raises(FileNotFoundError):
        create([tmp_path / "nothing.zarr"], tmp_path / "out")


def test_a_split_is_by_run_and_by_seed(store: Path, tmp_path: Path) -> None:
    one = split("small", tmp_path / "one", fractions=(0.5, 0.25, 0.25), seed=1)
    assert wt.verify(one.path, deep=True) == []
    assert Counter(run.split for run in one) == {"train": 2, "validation": 1, "test": 1}
    again = split("small", tmp_path / "again", fractions=(0.5, 0.25, 0.25), seed=1, name="one")
    assert {p.name: p.read_bytes() for p in (again.path / "runs").iterdir()} == {
        p.name: p.read_bytes() for p in (one.path / "runs").iterdir()
    }
    assert [run.split for run in again] == [run.split for run in one]
    splits = {
        tuple(_parts(4, (0.5, 0.25, 0.25))[i] for i in np.random.default_rng(seed).permutation(4))
        for seed in range(9)
    }
    assert len(splits) > 3


@pytest.mark.parametrize(
    ("count", "fractions", "sizes"),
    [
        (50, (0.6, 0.2, 0.2), (30, 10, 10)),
        (10, (0.6, 0.2, 0.2), (6, 2, 2)),
        (3, (0.98, 0.01, 0.01), (1, 1, 1)),
        (7, (0.5, 0.5, 0.0), (4, 3, 0)),
        (8, (0.6, 0.2, 0.2), (5, 2, 1)),
        (5, (1.0, 0.0, 0.0), (5, 0, 0)),
    ],
)
def test_parts_are_as_large_as_their_fractions(
    count: int, fractions: tuple[float, float, float], sizes: tuple[int, int, int]
) -> None:
    got = Counter(_parts(count, fractions))
    assert tuple(got[name] for name in SPLITS) == sizes


@pytest.mark.parametrize("fractions", [(0.5, 0.2, 0.2), (1.2, -0.2, 0.0)])
def test_fractions_that_are_none_are_refused(
    fractions: tuple[float, float, float], store: Path, tmp_path: Path
) -> None:
    with pytest.raises(RegistryError, match="sum to 1"):
        split("small", tmp_path / "out", fractions=fractions)
    assert not (tmp_path / "out").exists()


def test_a_full_disk_leaves_nothing_behind(store: Path, disk: Path) -> None:
    with pytest.raises(FormatError, match=r"could not be written(.|\n)*make room"):
        split("small", disk / "out")
    assert list(disk.iterdir()) == []


# Delete


def test_a_deleted_data_set_is_gone(store: Path) -> None:
    (store / "below/thesis.tex").touch()
    assert delete("below") == store / "below/data"
    assert [path.name for path in (store / "below").iterdir()] == ["thesis.tex"]
    assert delete("team/theirs") == store / "team/theirs"
    assert {"small", "notes", "team", "below"} == {path.name for path in store.iterdir()}


def test_what_lies_beside_a_data_set_called_data_stays(
    small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = tmp_path / "project"
    shutil.copytree(small_dataset, project / "data")
    (project / "thesis.tex").touch()
    monkeypatch.setenv(VARIABLE, str(project))
    assert delete("data") == project / "data"
    assert [path.name for path in project.iterdir()] == ["thesis.tex"]
    # Where `data` is a folder of data sets too, it is not one that is deleted.
    shutil.copytree(small_dataset, project / "data")
    shutil.copytree(small_dataset, project / "data/other")
    monkeypatch.chdir(project)
    with pytest.raises(RegistryError, match="other data sets have their ids"):
        delete("data")
    assert (project / "data/other").is_dir()


def test_what_must_stay_is_not_deleted(store: Path) -> None:
    with pytest.raises(RegistryError, match="of a clone"):
        delete("inverted-pendulum-v4-ppo-v1")
    with pytest.raises(FileNotFoundError, match="none of that id"):
        delete("nobody")
    with pytest.raises(RegistryError, match="only what has an id"):
        delete(str(store / "small"))
    own = clone()
    assert own is not None
    assert (own / "inverted-pendulum-v4-ppo-v1").is_dir()
    assert (store / "small").is_dir()


def test_nothing_is_deleted_through_a_link(
    store: Path, small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(small_dataset, tmp_path / "clone/own")
    monkeypatch.setattr("weighttraj.registry.local.clone", lambda: tmp_path / "clone")
    (store / "ours").symlink_to(tmp_path / "clone")
    with pytest.raises(RegistryError, match="of a clone"):
        delete("ours/own")
    assert (tmp_path / "clone/own/dataset.json").is_file()
    (store / "link").symlink_to(store / "small")
    with pytest.raises(RegistryError, match="is a link"):
        delete("link")
    assert (store / "link/dataset.json").is_file()


def test_the_commands(store: Path, tmp_path: Path) -> None:
    listed = shell("weighttraj", "list").stdout
    assert all(name in listed for name in ("small", "below", "team/theirs"))
    found = shell("weighttraj", "search", "seed == 2", "--columns", "dataset", "run_id").stdout
    assert found.count("seed0002") >= 3
    refused = shell("weighttraj", "search", "colour == 1")
    assert refused.returncode == 1
    assert "Traceback" not in refused.stderr + refused.stdout
    unknown = shell("weighttraj", "search", "seed == 2", "--columns", "bogus")
    assert unknown.returncode == 1
    assert "no such columns" in unknown.stderr
    assert unknown.stdout == ""
    done = shell("weighttraj", "split", "small", "--out", tmp_path / "new", "--seed", 3)
    assert done.returncode == 0
    assert len(wt.open(tmp_path / "new")) == 4
    unasked = shell("weighttraj", "delete", "small", answers="")
    assert unasked.returncode == 1
    assert "give --yes" in unasked.stdout
    assert str(store / "small") in unasked.stdout.replace("\n", "")
    assert shell("weighttraj", "delete", "small", "--yes").returncode == 0
    assert not (store / "small").exists()


# A part of a recipe


def test_a_part_says_what_it_is_of_and_keeps_recipe_splits_and_bytes(
    small_dataset: Path, tmp_path: Path
) -> None:
    whole = wt.open(small_dataset)
    kept = [run for run in whole if run.split != "validation"]
    part = select(small_dataset, tmp_path / "part", seeds=[run.info.seed or 0 for run in kept])
    assert part.info.id == whole.info.id
    assert part.info.part == f"{len(kept)} of {len(whole)}"
    assert not whole.info.part
    assert f"{len(kept)} of {len(whole)} runs of the whole" in repr(part)
    assert wt.verify(tmp_path / "part", deep=True) == []
    assert wt.lint(tmp_path / "part") == wt.lint(small_dataset)
    for run, original in zip(part, kept, strict=True):
        assert run.split == original.split
        assert run["digest"][:].tobytes() == original["digest"][:].tobytes()
    assert part.info.recipe["ppo"] == whole.info.recipe["ppo"]
    assert replay(tmp_path / "part", 3) == []


def test_a_part_without_runs_of_a_split_says_so(small_dataset: Path, tmp_path: Path) -> None:
    seed = wt.open(small_dataset).split("train").runs[0].info.seed
    part = select(small_dataset, tmp_path / "part", seeds=[seed or 0])
    with pytest.raises(FormatError, match="holds no run of this split") as caught:
        part.split("test")
    assert "1 of 4 runs" in str(caught.value)
    assert "weighttraj collect" in str(caught.value)


def test_seeds_without_complete_runs_are_refused(small_dataset: Path, tmp_path: Path) -> None:
    for seeds in ([0, 99], []):
        with pytest.raises(RegistryError, match="no complete runs of these seeds"):
            select(small_dataset, tmp_path / "part", seeds=seeds)
    assert not (tmp_path / "part").exists()
    done = shell("weighttraj", "select", small_dataset, "--seeds", "0", "--out", tmp_path / "part")
    assert "1 of 4 runs of the whole" in done.stdout


def test_create_with_a_string_instead_of_a_list_says_so() -> None:
    with pytest.raises(RegistryError, match=r"(?s)wrong order.*expected: create\("):
        create("out", "run0.zarr")
