from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tipl import TemporalSVD
from tipl.errors import RepresentationError


def path(n: int = 60, size: int = 30) -> np.ndarray:
    """A smooth path with noise, like a run's."""
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(n, size)) + np.linspace(2, 0, n)[:, None]
    return 1 + 0.1 * steps.cumsum(0)


def test_it_is_numpys_svd_but_for_signs() -> None:
    weights = path()
    svd = TemporalSVD.fit(weights, rank=8)
    u, s, vt = np.linalg.svd(weights, full_matrices=False)
    np.testing.assert_allclose(svd.singular_values, s[:8], rtol=1e-12)
    np.testing.assert_allclose(np.abs(svd.components), np.abs(vt[:8]), atol=1e-10)
    np.testing.assert_allclose(np.abs(svd.transform(weights)), np.abs(u[:, :8]), atol=1e-10)


def test_signs_follow_the_beginning_of_the_run() -> None:
    weights = path()
    svd = TemporalSVD.fit(weights, rank=8)
    assert (svd.transform(weights)[:6].sum(0) > 0).all()
    flipped = TemporalSVD.fit(-weights, rank=8)
    np.testing.assert_allclose(flipped.transform(-weights), svd.transform(weights), atol=1e-10)


@given(st.integers(1, 30))
def test_the_error_is_the_energy_left_out(rank: int) -> None:
    weights = path()
    svd = TemporalSVD.fit(weights, rank)
    left = (1 - svd.information[-1]) * svd.total_energy / weights.size
    assert svd.reconstruction_error(weights) == pytest.approx(left, abs=1e-12)
    assert (np.diff(svd.information) >= 0).all()
    assert svd.rank == rank


def test_full_rank_loses_nothing() -> None:
    weights = path()
    svd = TemporalSVD.fit(weights, rank=30)
    np.testing.assert_allclose(svd.inverse_transform(svd.transform(weights)), weights)
    assert svd.information[-1] == pytest.approx(1)


@pytest.mark.parametrize("rank", [0, 31])
def test_impossible_ranks_are_refused(rank: int) -> None:
    with pytest.raises(RepresentationError, match=r"1 to 30, the smaller side of \(60, 30\)"):
        TemporalSVD.fit(path(), rank)


def test_weights_that_are_not_finite_are_refused() -> None:
    weights = path()
    weights[3, 3] = np.nan
    with pytest.raises(RepresentationError, match="not finite"):
        TemporalSVD.fit(weights, 3)
