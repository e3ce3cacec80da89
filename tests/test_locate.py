from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

import weighttraj as wt
from weighttraj.cli import main
from weighttraj.locate import folders, locate
from weighttraj.registry.local import local_datasets


def test_a_path_is_itself(small_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert locate(small_dataset) == small_dataset
    assert locate("no/such/path") == Path("no/such/path")
    monkeypatch.chdir(small_dataset.parent)
    assert locate("small") == Path("small")


@pytest.mark.parametrize("part", ["", "data"])
def test_an_id_is_found_where_data_sets_lie(
    part: str, small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(small_dataset, tmp_path / "mine" / "small" / part)
    (tmp_path / "empty").mkdir()
    monkeypatch.setenv(
        "WEIGHTTRAJ_DATASETS_PATH",
        os.pathsep.join(map(str, (tmp_path / "empty", tmp_path / "mine"))),
    )
    assert wt.open("small").path == tmp_path / "mine" / "small" / part
    assert len(wt.open("small")) == 4


def test_commands_take_an_id(
    small_dataset: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(small_dataset.parent))
    for command in ("show", "verify", "lint"):
        monkeypatch.setattr("sys.argv", ["weighttraj", command, "small"])
        main()
    said = capsys.readouterr().out
    assert "<Dataset small, version 1, complete>" in said
    assert "small: whole" in said


def test_an_unknown_id_says_where_it_was_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=rf"(?s)at none-v0.*{tmp_path}.*DATASETS_PATH"):
        wt.open("none-v0")


def test_the_clones_data_sets_are_looked_through(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WEIGHTTRAJ_DATASETS_PATH", raising=False)
    _, clone, _ = folders()
    assert (clone / "demo" / "recipe.toml").is_file()


def test_what_was_collected_here_has_an_id(
    small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(small_dataset, tmp_path / "data" / "small")
    monkeypatch.chdir(tmp_path)
    assert len(wt.open("small")) == 4
    assert "small" in {dataset.id for dataset in local_datasets()}
