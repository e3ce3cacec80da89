"""Forecasters by name and by folder, and the command that fits the baselines."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tipl import Reconstruction, baselines, cli, load
from tipl.errors import ForecastError, ModelError


@pytest.mark.parametrize("name", baselines.names())
def test_what_needs_no_fit_is_loaded_by_name(name: str) -> None:
    assert load(name).name == name


def test_fitted_baselines_are_loaded_by_folder(
    small_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["tipl", "fit", str(small_dataset), "--out", str(tmp_path), "--steps", "20"]
    command += ["--horizons", "1", "5", "20"]
    monkeypatch.setattr(sys, "argv", command)
    cli.main()
    said = capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    assert {"persistence", "ar-20-phase", "wnn"} < names
    assert all(load(tmp_path / name).name == name and name in said for name in names)


def test_a_name_that_nobody_has_is_refused() -> None:
    with pytest.raises(ForecastError, match=r"there is no such forecaster(.|\n)*tipl fit"):
        load("crystal-ball")


def test_a_folder_with_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"kind": "crystal ball"}')
    with pytest.raises(ModelError, match="crystal ball"):
        load(tmp_path)


def test_a_floor_is_saved_and_loaded(tmp_path: Path) -> None:
    Reconstruction(7).save(tmp_path)
    assert load(tmp_path) == Reconstruction(7)
