"""Every script in ``examples`` runs, is short, and prints what it promises."""

from __future__ import annotations

import re
import runpy
import sys
import warnings
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.typecheck import unchecked

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
LONG = ("jump_ahead",)
"""Scripts that take minutes; tests of their pages run them in short."""
PRINTED = {
    "add_rival_to_leaderboard": r"skill, h = 10: half-step -?\d",
    "plot_path_and_returns": "",
    "predict_return_from_weights": r"explained variance on test runs: -?\d",
    "publish_and_load_back": r"came back: True \(20, 122\)",
    "record_sb3_training": r"weights: \(9, 4610\)",
}


@pytest.mark.parametrize(
    "script",
    [script for script in SCRIPTS if script.stem not in LONG],
    ids=lambda script: script.stem,
)
def test_it_runs(
    script: Path,
    tmp_path: Path,
    few_released: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = [few_released.parent, EXAMPLES.parent / "datasets"]
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", ":".join(map(str, folders)))
    monkeypatch.setattr(sys, "argv", [str(script)])
    with unchecked():
        runpy.run_path(str(script), run_name="__main__")
    assert re.search(PRINTED[script.stem], capsys.readouterr().out)
    if script.stem == "plot_path_and_returns":
        assert (tmp_path / "path-and-returns.png").stat().st_size > 10_000


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_it_is_short(script: Path) -> None:
    assert len(script.read_text().splitlines()) <= 40


def test_the_notebook_runs_and_shows_its_outputs(
    tmp_path: Path, few_released: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    notebook = nbformat.read(EXAMPLES / "quickstart.ipynb", as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    shown = [cell.outputs for cell in cells]
    assert all(shown), "run: make readme"
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(few_released.parent))
    here = {"metadata": {"path": str(tmp_path)}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Jupyter's own
        NotebookClient(notebook, timeout=300, resources=here).execute()
    assert cells[0].outputs == shown[0]
    assert "return at the start" in cells[4].outputs[0].text
    assert (tmp_path / "data/examples/notebook-report/report.html").exists()
