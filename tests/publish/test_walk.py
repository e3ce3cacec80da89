"""Steps, spectrum and path of weights, against plain numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from weighttraj.publish import walk as walks
from weighttraj.publish.curves import Curve, band, filled, thin
from weighttraj.publish.figures import phase_groups
from weighttraj.publish.walk import rank_for, walk

ROWS = 40


@pytest.fixture(autouse=True)
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(walks, "MAX_ROWS", ROWS)


@pytest.fixture(scope="module")
def run(small_dataset: Path) -> wt.Run:
    return wt.open(small_dataset).runs[0]


@pytest.fixture(scope="module")
def wide_run(tmp_path_factory: pytest.TempPathFactory) -> wt.Run:
    """More snapshots than a Gram matrix has rows, and more columns than one product."""
    layout = wt.ParamLayout.of({"w": ((9000,), "other", ("fixed",))})
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("wide") / "r.zarr"
    weights = rng.standard_normal(9000)
    with wt.RunWriter(path, wt.RunInfo(run_id="r", layout=layout)) as writer:
        for t in range(ROWS + 20):
            writer.append(layout.flatten({"w": weights}), num_timesteps=t)
            weights = weights + rng.standard_normal(9000) / (10 + t)
    return wt.open_run(path)


def test_the_spectrum_is_numpys(wide_run: wt.Run) -> None:
    found = walk(wide_run)
    assert len(found.rows) == ROWS
    assert (found.rows[0], found.rows[-1]) == (0, len(wide_run) - 1)
    rows = wide_run.weights[:][found.rows].astype(np.float64)
    expected = np.linalg.svd(rows, compute_uv=False)
    np.testing.assert_allclose(found.singular[:30], expected[:30], rtol=1e-6)
    shares = 1 - np.cumsum(expected**2) / (expected**2).sum()
    np.testing.assert_allclose(found.beyond[:30], shares[:30], rtol=1e-6)
    assert rank_for(found, 1.001 * shares[4]) == 5
    assert rank_for(found, 0.999 * shares[4]) == 6


def test_the_steps_are_numpys(wide_run: wt.Run) -> None:
    read: list[int] = []
    found = walk(wide_run, read.append)
    expected = np.linalg.norm(np.diff(wide_run.weights[:].astype(np.float64), axis=0), axis=1)
    np.testing.assert_allclose(found.steps, expected, rtol=1e-5)
    assert sum(read) == len(wide_run)


def test_the_path_is_the_principal_one_from_the_start(run: wt.Run) -> None:
    found = walk(run)
    moved = run.weights[:][found.rows].astype(np.float64)
    moved -= moved[0]
    u, s, _ = np.linalg.svd(moved, full_matrices=False)
    np.testing.assert_allclose(np.abs(found.path), np.abs(u[:, :2] * s[:2]), atol=1e-6)
    np.testing.assert_allclose(found.path_share, s[:2] ** 2 / (s**2).sum(), rtol=1e-6)
    assert found.path[0].tolist() == pytest.approx([0, 0], abs=1e-6)
    assert found.path[-1, 0] > 0


def test_a_real_run_has_no_singular_values_that_are_rounding(run: wt.Run) -> None:
    found = walk(run)
    assert found.singular[-1] > 1e-8 * found.singular[0]
    assert (np.diff(found.singular) <= 0).all()
    assert (np.diff(found.beyond) <= 0).all()


def test_quartiles_are_over_the_runs_that_are_there() -> None:
    steps = np.array([0.0, 10.0, 20.0])
    lines = [
        Curve(run=str(k), steps=steps[: 3 - (k == 3)], returns=np.full(3 - (k == 3), float(k)))
        for k in range(4)
    ]
    found = band(lines)
    assert (found.steps[0], found.steps[-1]) == (0, 20)
    assert (found.low[0], found.median[0], found.high[0]) == (0.75, 1.5, 2.25)
    assert found.median[-1] == 1  # the fourth run ends before


def test_values_are_filled_in_between_only() -> None:
    nan = np.nan
    found = filled(np.array([nan, 1, nan, nan, 4, nan]))
    np.testing.assert_array_equal(found, [nan, 1, 2, 3, 4, nan])


def test_thinning_keeps_the_ends() -> None:
    assert thin(3, 5).tolist() == [0, 1, 2]
    some = thin(1000, 7)
    assert (len(some), some[0], some[-1]) == (7, 0, 999)


def test_phases_are_grouped_if_there_are_many() -> None:
    assert [name for name, _ in phase_groups([np.array([-1, 0, 1, 0, 1])])] == ["0", "1"]
    assert [name for name, _ in phase_groups([np.array([-1, -1, -1])])] == ["all steps"]
    names = [name for name, _ in phase_groups([np.arange(-1, 12)])]
    assert names == ["0 to 1", "2 to 3", "4 to 5", "6 to 7", "8 to 9", "10 to 11"]
