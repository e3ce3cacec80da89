"""A stranger's data set with links in it: no command writes to where they lead."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import weighttraj as wt
from tests.benchmarks.stress_format import live_copy
from tests.small import SMALL_RECIPE
from weighttraj import registry
from weighttraj.collect import collect
from weighttraj.collect.settings import Seeds
from weighttraj.errors import WeightTrajError
from weighttraj.load.cache import CachedWeights
from weighttraj.policies import ReturnsConfig, fill_returns
from weighttraj.store.catalog import read_dataset_info, write_dataset_info

FEW = ReturnsConfig(episodes=1, every=1000, modes=("deterministic",))
RECIPE = replace(SMALL_RECIPE, seeds=Seeds(train=[0, 1]))


@pytest.fixture
def dataset(small_dataset: Path, tmp_path: Path) -> Path:
    """A data set of two runs, one packed and one being collected, as a stranger might send it."""
    path = tmp_path / "theirs"
    (path / "runs").mkdir(parents=True)
    first, second = wt.open(small_dataset).runs[:2]
    shutil.copy(first.path, path / "runs")
    live_copy(second, path / f"runs/{second.id}.zarr", 24, 6, "crashed")
    for lock in path.rglob("*.lock"):
        lock.unlink()
    info = read_dataset_info(small_dataset)
    entries = (info.runs[0], replace(info.runs[1], path=f"runs/{second.id}.zarr"))
    write_dataset_info(path, replace(info, runs=entries, status="collecting"))
    return path


@pytest.fixture
def complete(small_dataset: Path, tmp_path: Path) -> Path:
    path = tmp_path / "theirs"
    shutil.copytree(small_dataset, path)
    registry.write_card(path)
    return path


def commands(path: Path) -> dict[str, Callable[[], object]]:
    return {
        "returns": lambda: fill_returns(path, FEW),
        "repair": lambda: wt.repair(path),
        "repair --cut": lambda: wt.repair(path, cut=True),
        "card": lambda: registry.write_card(path),
        "collect": lambda: collect(RECIPE, path),
        "seal": lambda: wt.seal(path),
        "resume": lambda: wt.RunWriter(
            path / "runs/seed0001.zarr",
            wt.open_run(path / "runs/seed0001.zarr").info,
            resume=True,
        ).close("crashed"),
    }


def divert(path: Path, name: str, how: str) -> Path:
    """Put a link in the place of a part of a data set: to it, moved away, or to nothing."""
    part, outside = path / name, path.parent / "mine" / name
    outside.parent.mkdir(parents=True, exist_ok=True)
    if part.exists():
        part.rename(outside)
    elif name.startswith((".returns", "runs")) and "." not in name[1:]:
        outside.mkdir(parents=True)
    else:
        outside.write_text("mine")
    if how == "dangling":
        shutil.rmtree(path.parent / "mine")
    part.parent.mkdir(parents=True, exist_ok=True)
    part.symlink_to(outside)
    return path.parent / "mine"


def state(folder: Path) -> dict[str, bytes | None]:
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None
        for p in sorted(folder.rglob("*"))
    }


PARTS = [
    "tables",
    "tables/runs.parquet",
    "runs",
    "runs/seed0000.zarr.zip",
    "runs/seed0001.zarr",
    "runs/seed0001.zarr/zarr.json",
    "runs/seed0001.zarr/policy",
    "runs/seed0001.zarr/policy/weights/c",
    "runs/seed0001.zarr.lock",
    "dataset.json",
    "README.md",
    "croissant.json",
    "MANIFEST.sha256",
    ".returns",
    ".returns/seed0000.jsonl",
]


def tried(path: Path, part: str, how: str, names: tuple[str, ...]) -> None:
    """No command, whether it goes on or refuses, changes what lies outside."""
    mine = divert(path, part, how)
    before = state(mine)
    for name in names:
        with contextlib.suppress(WeightTrajError, FileNotFoundError):
            commands(path)[name]()
        assert state(mine) == before, name
        assert mine.exists() == (how == "moved"), name


@pytest.mark.parametrize("part", PARTS)
def test_nothing_outside_of_a_data_set_is_written(dataset: Path, part: str) -> None:
    # A run that is named by its own path may be reached through links, as a data set may.
    resume = () if part in ("runs", "runs/seed0001.zarr") else ("resume",)
    tried(dataset, part, "moved", ("repair", "repair --cut", *resume, "card", "seal"))


@pytest.mark.parametrize("part", ["tables", "runs", "runs/seed0001.zarr", "dataset.json"])
def test_nothing_is_made_where_a_dangling_link_leads(dataset: Path, part: str) -> None:
    tried(dataset, part, "dangling", ("repair", "card", "seal"))


@pytest.mark.parametrize(
    "part", ["runs", "runs/seed0001.zarr/policy", "runs/seed0001.zarr/policy/weights/c"]
)
def test_collecting_writes_through_no_link(dataset: Path, part: str) -> None:
    tried(dataset, part, "moved", ("collect",))


@pytest.mark.parametrize(
    "part", ["tables", ".returns", ".returns/seed0000.jsonl", "MANIFEST.sha256"]
)
def test_evaluating_writes_through_no_link(complete: Path, part: str) -> None:
    tried(complete, part, "moved", ("returns",))


@pytest.mark.parametrize("part", [p for p in PARTS if "seed0001" not in p])
def test_nothing_outside_of_a_complete_data_set_is_written(complete: Path, part: str) -> None:
    tried(complete, part, "moved", ("repair", "card", "seal"))


@pytest.mark.parametrize("part", [p for p in PARTS if "seed0001" not in p])
def test_verify_names_each_link(complete: Path, part: str) -> None:
    mine = divert(complete, part, "moved")
    problems = "\n".join(wt.verify(complete))
    assert "link" in problems
    assert str(complete / part) in problems
    assert str(mine) in problems


def test_the_text_behind_a_link_is_not_made_part_of_a_card(complete: Path) -> None:
    (complete / "README.md").unlink()
    (complete.parent / "secret").write_text("my secret")
    (complete / "README.md").symlink_to(complete.parent / "secret")
    with pytest.raises(WeightTrajError, match="link"):
        registry.write_card(complete)
    assert (complete.parent / "secret").read_text() == "my secret"


def test_a_data_set_that_is_reached_through_a_link_is_ours_to_write(
    complete: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = complete.parent / "link"
    link.symlink_to(complete)
    registry.write_card(link)
    fill_returns(link, FEW)
    (complete / "tables/runs.parquet").unlink()
    wt.repair(link)
    assert wt.verify(link) == []
    assert all(run.evaluation for run in wt.open(link))


def test_a_cache_on_a_linked_disk_works(
    complete: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "cache").symlink_to(tmp_path / "disk")
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", str(tmp_path / "cache"))
    weights = CachedWeights(wt.open(complete).runs[0])
    assert weights.map().shape == weights.shape
    assert len(list((tmp_path / "disk").glob("*.npy"))) == 1


def test_a_journal_of_a_stranger_says_nothing_about_other_snapshots(complete: Path) -> None:
    """A line with a right checksum, of a snapshot or of episodes that the run does not have."""
    from weighttraj.policies.returns import _line, _Work

    work = _Work(wt.open(complete).runs[0], complete, FEW, replace=False)
    work._journal.begin()
    file = complete / ".returns" / f"{work.run.id}.jsonl"
    head = file.read_bytes()
    good = {"t": 0, "returns": [1.0], "lengths": [5]}
    for bad in (
        {"t": 10**6},
        {"t": -1},
        {"t": "0"},
        {"returns": [1.0] * 2},
        {"returns": ["x"]},
        {"lengths": [2**70]},
        {"lengths": [[]]},
        {"lengths": None},
    ):
        file.write_bytes(head + _line(good) + _line(good | bad))
        again = _Work(work.run, complete, FEW, replace=False)
        assert list(again._journal.rows) == [0]
