from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import dask.array
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import weighttraj as wt
from tipl import TemporalSVD
from tipl.errors import RepresentationError
from tipl.representation import PrefixBases, fit_run, rows, svd


def path(n: int = 60, size: int = 30, seed: int = 0) -> np.ndarray:
    """A smooth path with noise, like a run's."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(n, size)) + np.linspace(2, 0, n)[:, None]
    return 1 + 0.1 * steps.cumsum(0)


def large(n: int = 1000, size: int = 1500) -> np.ndarray:
    """Too large for the exact SVD to be quick."""
    return path(n, size).astype(np.float32)


def exact_values(weights: np.ndarray) -> np.ndarray:
    """Singular values from the Gram matrix in float64."""
    wide = weights.astype(np.float64)
    return np.sqrt(np.linalg.eigvalsh(wide @ wide.T)[::-1].clip(0))


def written(path: Path, weights: np.ndarray) -> wt.Run:
    """A run of these weights."""
    layout = wt.ParamLayout.of({"w": ((weights.shape[1],), "other", ("fixed",))})
    with wt.RunWriter(path, wt.RunInfo(run_id="r", layout=layout, block=64)) as writer:
        for t, row in enumerate(weights):
            writer.append(row, num_timesteps=t)
    return wt.open_run(path)


class Counted:
    """Rows that count how they are read."""

    def __init__(self, weights: np.ndarray) -> None:
        self._weights, self.shape, self.dtype = weights, weights.shape, weights.dtype
        self.read: list[int] = []

    def __getitem__(self, key: Any) -> np.ndarray:
        found = self._weights[key]
        self.read.append(len(found))
        return found


class Made:
    """A matrix that lies nowhere: its rows are made when they are read."""

    shape, dtype = (4000, 5000), np.dtype(np.float32)

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self._left = rng.normal(size=(4000, 40)).astype(np.float32)
        self._right = rng.normal(size=(40, 5000)).astype(np.float32)

    def __getitem__(self, key: Any) -> np.ndarray:
        return self._left[key[0] if isinstance(key, tuple) else key] @ self._right


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


def test_a_trajectory_is_transformed_and_compared_a_piece_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weights = path()
    svd = TemporalSVD.fit(weights, rank=5)
    whole = svd.transform(weights)
    error = np.mean((svd.inverse_transform(whole) - weights) ** 2)
    monkeypatch.setattr(rows, "PIECE_BYTES", 16 * 30 * 8)
    counted = Counted(weights)
    np.testing.assert_allclose(svd.coefficients(counted), whole, rtol=1e-12)
    assert svd.reconstruction_error(counted) == pytest.approx(error, rel=1e-12)
    assert counted.read == 2 * [16, 16, 16, 12]


def test_streamed_it_has_the_exact_singular_values() -> None:
    weights = large()
    svd = TemporalSVD.fit_streamed(weights, rank=64)
    exact = exact_values(weights)
    np.testing.assert_allclose(svd.singular_values[:32], exact[:32], rtol=1e-5)
    np.testing.assert_allclose(svd.singular_values, exact[:64], rtol=5e-3)
    assert (svd.singular_values <= exact[:64] * (1 + 1e-9)).all()
    assert svd.total_energy == pytest.approx(np.sum(exact**2), rel=1e-12)
    least = np.sum(exact[64:] ** 2) / weights.size
    assert 1 - 1e-9 < svd.reconstruction_error(weights) / least < 1.001
    np.testing.assert_allclose(svd.components @ svd.components.T, np.eye(64), atol=1e-10)


def test_streamed_it_agrees_with_dask() -> None:
    weights = large()
    svd = TemporalSVD.fit_streamed(weights, rank=32, power_iterations=3)
    matrix = dask.array.from_array(weights.astype(np.float64), chunks=(250, 1500))
    u, s, v = dask.array.linalg.svd_compressed(
        matrix, 32, n_power_iter=4, n_oversamples=48, iterator="QR", seed=0
    )
    _, s, v = dask.compute(u, s, v, scheduler="synchronous")
    np.testing.assert_allclose(svd.singular_values, s, rtol=1e-6)
    cosines = np.sum(svd.components * v, axis=1)
    np.testing.assert_allclose(np.abs(cosines[:8]), 1, atol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(60, 30), (30, 60), (40, 40)])
def test_streamed_small_matrices_come_out_whole(shape: tuple[int, int], dtype: Any) -> None:
    weights = path(*shape).astype(dtype)
    exact = TemporalSVD.fit(weights, rank=30)
    svd = TemporalSVD.fit_streamed(weights, rank=30)
    np.testing.assert_allclose(svd.singular_values, exact.singular_values, rtol=1e-9)
    np.testing.assert_allclose(svd.components, exact.components, atol=1e-9)  # signs too


def test_white_noise_is_the_worst_case_and_never_overstated() -> None:
    noise = np.random.default_rng(0).normal(size=(400, 500)).astype(np.float32)
    exact = exact_values(noise)
    svd = TemporalSVD.fit_streamed(noise, rank=10)
    assert (svd.singular_values <= exact[:10] * (1 + 1e-9)).all()
    np.testing.assert_allclose(svd.singular_values, exact[:10], rtol=0.05)


def test_streamed_the_seed_settles_every_bit_and_the_piece_hardly_any() -> None:
    weights = large(300, 400)
    one = TemporalSVD.fit_streamed(weights, rank=8, oversampling=8, piece=64)
    same = TemporalSVD.fit_streamed(weights, rank=8, oversampling=8, piece=64)
    assert one.components.tobytes() == same.components.tobytes()
    assert one.singular_values.tobytes() == same.singular_values.tobytes()
    for piece in (1, 7, 300):
        other = TemporalSVD.fit_streamed(weights, rank=8, oversampling=8, piece=piece)
        np.testing.assert_allclose(other.singular_values, one.singular_values, rtol=1e-9)
        np.testing.assert_allclose(other.components, one.components, atol=1e-7)
        assert other.total_energy == pytest.approx(one.total_energy, rel=1e-12)
    other = TemporalSVD.fit_streamed(weights, rank=8, oversampling=8, piece=64, seed=1)
    assert other.components.tobytes() != one.components.tobytes()


@pytest.mark.parametrize("power_iterations", [0, 1, 2])
def test_streamed_it_reads_each_row_once_more_than_it_iterates(power_iterations: int) -> None:
    counted = Counted(large(100, 200))
    TemporalSVD.fit_streamed(
        counted, rank=4, oversampling=4, power_iterations=power_iterations, piece=32
    )
    assert counted.read == (power_iterations + 1) * [32, 32, 32, 4]


def test_streamed_it_holds_little_in_memory() -> None:
    made = Made()
    tracemalloc.start()
    try:
        TemporalSVD.fit_streamed(made, rank=8, oversampling=24, piece=64)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 0.25 * 4 * 4000 * 5000


def test_of_a_run_it_is_what_it_is_of_its_weights(tmp_path: Path) -> None:
    weights = large(100, 1200)
    live = written(tmp_path / "r.zarr", weights)
    archive = wt.open_run(wt.pack(live.path, profile="archive", out=tmp_path / "a.zarr.zip"))
    for run in (live, archive):
        got = TemporalSVD.fit_streamed(run, rank=4, piece=48)
        want = TemporalSVD.fit_streamed(weights, rank=4, piece=48)
        assert got.components.tobytes() == want.components.tobytes()
        assert got.reconstruction_error(run) == got.reconstruction_error(weights)
        assert fit_run(run, rank=4).components.tobytes() == (
            TemporalSVD.fit(weights, rank=4).components.tobytes()
        )


def test_a_large_run_is_streamed_and_a_small_one_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = path()
    monkeypatch.setattr(svd, "EXACT_WORK", 30 * 30 * 60)
    exact, found = TemporalSVD.fit(weights, rank=3), fit_run(weights, rank=3)
    assert found.components.tobytes() == exact.components.tobytes()
    monkeypatch.setattr(svd, "EXACT_WORK", 30 * 30 * 60 - 1)
    streamed, found = TemporalSVD.fit_streamed(weights, rank=3, seed=5), fit_run(weights, 3, seed=5)
    assert found.components.tobytes() == streamed.components.tobytes()


@pytest.mark.parametrize("size", [12, 200], ids=["fewer parameters", "more parameters"])
@pytest.mark.parametrize("window", [None, 40])
def test_bases_of_prefixes_are_those_of_the_prefixes_alone(size: int, window: int | None) -> None:
    weights = path(150, size)
    bases = PrefixBases.fit(weights, rank=6, window=window)
    for t in (10, 11, 39, 40, 90, 149):
        first = 0 if window is None else max(0, t - window + 1)
        seen = weights[first : t + 1] - weights[t]
        direct, basis, tokens = TemporalSVD.fit(seen, rank=6), bases.basis(t), bases.tokens(t)
        assert tokens.first == first
        np.testing.assert_allclose(tokens.coefficients, direct.transform(seen), atol=1e-9)
        np.testing.assert_allclose(basis.components, direct.components, atol=1e-9)
        np.testing.assert_allclose(basis.singular_values, direct.singular_values, rtol=1e-9)
        assert basis.total_energy == pytest.approx(direct.total_energy, rel=1e-9)


@pytest.mark.parametrize("size", [12, 200])
def test_what_follows_a_start_is_given_in_its_basis(size: int) -> None:
    weights = path(150, size)
    bases = PrefixBases.fit(weights, rank=5, window=40, ahead=7)
    for t, count in ((20, 28), (100, 47), (145, 44), (149, 40)):
        tokens, basis = bases.tokens(t), bases.basis(t)
        around = weights[tokens.first : t + 8] - weights[t]
        assert len(tokens.coefficients) == len(around) == count
        np.testing.assert_allclose(tokens.coefficients, basis.transform(around), atol=1e-9)


@pytest.mark.parametrize("size", [12, 200])
def test_no_basis_sees_what_comes_after_its_start(size: int) -> None:
    weights = path(150, size)
    changed = weights.copy()
    changed[101:] += 5 * np.random.default_rng(1).normal(size=(49, size))
    one, other = (PrefixBases.fit(w, rank=5, window=40) for w in (weights, changed))
    for t in (50, 99, 100):
        assert one.tokens(t).coefficients.tobytes() == other.tokens(t).coefficients.tobytes()
        assert one.basis(t).components.tobytes() == other.basis(t).components.tobytes()
    assert one.tokens(101).coefficients.tobytes() != other.tokens(101).coefficients.tobytes()


def test_steps_that_are_tiny_beside_the_weights_keep_their_digits() -> None:
    """As at the end of a run, when the learning rate is almost 0."""
    weights = 10 + 1e-6 * path(100, 300)
    bases = PrefixBases.fit(weights, rank=10, window=50)
    direct = TemporalSVD.fit(weights[41:91] - weights[90], rank=10)
    np.testing.assert_allclose(bases.tokens(90).singular_values, direct.singular_values, rtol=1e-7)


@pytest.mark.parametrize("size", [12, 200])
def test_tokens_of_many_starts_take_one_reading(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows, "PIECE_BYTES", 64 * 8 * size)
    counted = Counted(path(150, size))
    bases = PrefixBases.fit(counted, rank=5, window=40)
    for t in range(10, 150):
        bases.tokens(t)
    assert counted.read == [64, 64, 22]
    bases.basis(100)
    assert counted.read[3:] == [40]


def test_a_run_has_bases_of_prefixes_too(tmp_path: Path) -> None:
    weights = large(100, 200)
    run = written(tmp_path / "r.zarr", weights)
    got, want = (PrefixBases.fit(w, rank=4, window=30).basis(70) for w in (run, weights))
    np.testing.assert_allclose(got.components, want.components, atol=1e-12)


@pytest.mark.parametrize("rank", [0, 31])
def test_impossible_ranks_are_refused(rank: int) -> None:
    for fit in (TemporalSVD.fit, TemporalSVD.fit_streamed, fit_run):
        with pytest.raises(RepresentationError, match=r"1 to 30, the smaller side of \(60, 30\)"):
            fit(path(), rank)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ranks_above_that_of_the_weights_are_refused(dtype: Any) -> None:
    rng = np.random.default_rng(0)
    weights = (rng.integers(-9, 9, (300, 5)) @ rng.integers(-9, 9, (5, 2000))).astype(dtype)
    assert TemporalSVD.fit_streamed(weights, rank=5).information[-1] == pytest.approx(1)
    with pytest.raises(RepresentationError, match=r"above that of the weights\n.*at most 5.*\n.*8"):
        TemporalSVD.fit_streamed(weights, rank=8)
    with pytest.raises(RepresentationError, match=r"at most 5: .*(.|\n)*choose a smaller rank"):
        TemporalSVD.fit(weights.astype(np.float64)[:, :5].repeat(2, axis=1), rank=6)
    with pytest.raises(RepresentationError, match="at most 0"):
        TemporalSVD.fit(np.zeros((6, 4)), rank=1)


def test_weights_that_are_not_finite_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = path()
    weights[33, 3] = np.nan
    fits: list[Any] = [TemporalSVD.fit, TemporalSVD.fit_streamed, fit_run, PrefixBases.fit]
    monkeypatch.setattr(rows, "PIECE_BYTES", 16 * 30 * 8)
    for fit in fits:
        with pytest.raises(RepresentationError, match=r"not finite(.|\n)*snapshot 33\n.*leave the"):
            fit(weights, 3)


@pytest.mark.parametrize("shape", [(60, 3, 10), (60,), (0, 30), (60, 0)])
def test_matrices_that_are_no_trajectories_are_refused(shape: tuple[int, ...]) -> None:
    message = r"matrix \(time, param\)(.|\n)*" + str(shape).replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(RepresentationError, match=message):
        fit_run(np.zeros(shape), rank=3)


@pytest.mark.parametrize("wrong", ["oversampling", "power_iterations", "seed", "piece"])
def test_negative_settings_are_refused(wrong: str) -> None:
    with pytest.raises(RepresentationError, match=r"piece from 1\n.*-1(.|\n)*leave them out"):
        TemporalSVD.fit_streamed(path(), 3, **{wrong: -1})


def test_errors_name_the_run(tmp_path: Path) -> None:
    run = written(tmp_path / "r.zarr", path().astype(np.float32))
    with pytest.raises(RepresentationError, match=r"where: .*r\.zarr"):
        fit_run(run, 31)
    with pytest.raises(RepresentationError, match=r"where: .*r\.zarr"):
        PrefixBases.fit(run, 31)


def test_starts_without_a_basis_are_refused() -> None:
    bases = PrefixBases.fit(path(), rank=5)
    with pytest.raises(
        RepresentationError, match=r"too few snapshots(.|\n)*from 5, for 5 .*\n.* 4"
    ):
        bases.tokens(4)
    assert bases.tokens(5).coefficients.shape == (6, 5)
    with pytest.raises(RepresentationError, match=r"0 to 59\n.*60"):
        bases.basis(60)
    with pytest.raises(RepresentationError, match=r"0 to 59\n.*-1"):
        bases.basis(-1)


@pytest.mark.parametrize("size", [12, 200])
def test_a_policy_that_stands_still_has_no_basis_of_displacements(size: int) -> None:
    weights = path(80, size)
    weights[40:] = weights[40]
    bases = PrefixBases.fit(weights, rank=5, window=20)
    assert bases.tokens(50).coefficients.shape == (20, 5)
    with pytest.raises(RepresentationError, match=r"at most 0: .*\n.*5\n.*snapshots 60 to 79"):
        bases.tokens(79)


@pytest.mark.parametrize(
    ("rank", "window", "ahead", "message"),
    [
        (31, None, 0, "from 1 to 30, for the displacements of 60 snapshots of 30 parameters"),
        (0, None, 0, "from 1 to 30"),
        (20, 20, 0, "from 1 to 19(.|\n)*longer window"),
        (5, None, -1, "ahead from 0\n.*ahead -1"),
    ],
)
def test_bases_that_no_prefix_has_are_refused(
    rank: int, window: int | None, ahead: int, message: str
) -> None:
    with pytest.raises(RepresentationError, match=message):
        PrefixBases.fit(path(), rank, window=window, ahead=ahead)
