from __future__ import annotations

import numpy as np
import pytest
import torch

from tipl import TemporalSVD
from tipl.errors import TrainError
from tipl.models.tipl.data import TokenRun, TokenSampler, history
from tipl.models.tipl.train import weight_prediction_error
from tipl.representation import Embedded


def run(n: int, offset: float) -> TokenRun:
    rows = offset + np.arange(n, dtype=np.float32)[:, None] + np.zeros(3, np.float32)
    return TokenRun(coefficients=rows, weights=np.full(3, offset, np.float32))


def test_windows_pads_and_targets() -> None:
    sampler = TokenSampler([run(9, 100), run(30, 1000)], window=5, batch_size=200, seed=0)
    batch = sampler.batch(0)
    assert batch.tokens.shape == batch.targets.shape == (200, 5, 3)
    mask, offset = batch.mask, batch.weights[:, :1]  # the run of each window
    expected = offset + batch.timesteps
    assert torch.equal(batch.tokens[..., 0][mask], expected[mask].float())
    assert torch.equal(batch.targets[..., 0][mask], expected[mask] + 1)
    assert (batch.tokens[~mask] == 0).all()
    assert mask[:, -1].all()
    assert not mask.all()
    last = {(int(o), int(t)) for o, t in zip(offset, batch.timesteps[:, -1], strict=True)}
    assert last <= {(100, t) for t in range(8)} | {(1000, t) for t in range(29)}
    assert len(last) > 30


def test_shares_add_up_to_the_batch() -> None:
    sampler = TokenSampler([run(9, 100), run(30, 1000)], window=5, batch_size=11, seed=0)
    batch = sampler.batch(0)
    predicted = torch.randn(batch.targets.shape)
    shares = [slice(0, 3), slice(3, 4), slice(4, 11)]
    parts = [weight_prediction_error(predicted[s], batch[s]) for s in shares]
    torch.testing.assert_close(sum(parts), weight_prediction_error(predicted, batch))
    assert batch[shares[0]].tokens.shape == (3, 5, 3)


def test_tiles_predict_every_snapshot_once() -> None:
    sampler = TokenSampler([run(9, 100), run(32, 1000)], window=5, batch_size=3, seed=0)
    tiles = sampler.tiles(100)
    assert [len(tile.tokens) for tile in tiles] == [3, 3, 3]
    seen = torch.cat([tile.targets[tile.mask][:, 0] for tile in tiles])
    assert sorted(seen.tolist()) == [*range(101, 109), *range(1001, 1032)]
    assert sum(int(tile.mask.sum()) for tile in tiles) == 39
    few = sampler.tiles(4)
    assert sum(len(tile.tokens) for tile in few) == 4
    assert {int(tile.weights[0, 0]) for tile in few} == {100, 1000}  # of both runs


def test_a_batch_is_a_function_of_seed_and_number() -> None:
    a, b = (TokenSampler([run(30, 1)], window=4, batch_size=8, seed=3) for _ in range(2))
    a.batch(0)
    assert torch.equal(a.batch(5).tokens, b.batch(5).tokens)
    assert not torch.equal(a.batch(5).tokens, a.batch(6).tokens)
    other = TokenSampler([run(30, 1)], window=4, batch_size=8, seed=4)
    assert not torch.equal(a.batch(5).tokens, other.batch(5).tokens)


def test_moments_leave_padding_out() -> None:
    mean, std = TokenSampler([run(9, 1), run(3, 7)], window=5, batch_size=2, seed=0).moments()
    rows = np.array([*range(1, 10), 7, 8, 9])
    np.testing.assert_allclose(mean, rows.mean(), rtol=1e-6)
    np.testing.assert_allclose(std, rows.std(), rtol=1e-6)


def test_history_is_the_window_that_training_sees() -> None:
    coefficients = np.arange(12, dtype=np.float32).reshape(6, 2)
    tokens, index = history(coefficients, np.array([1, 4]), 3)
    assert index.tolist() == [[-1, 0, 1], [2, 3, 4]]
    assert tokens[0].tolist() == [[0, 0], [0, 1], [2, 3]]
    assert np.array_equal(tokens[1], coefficients[2:5])


def test_the_loss_is_the_mean_squared_error_of_the_weights() -> None:
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(40, 17)).astype(np.float32)
    svd = TemporalSVD.fit(weights, rank=6)
    embedded = Embedded(svd=svd, coefficients=svd.transform(weights))
    sampler = TokenSampler([TokenRun.of(embedded)], window=5, batch_size=16, seed=0)
    batch = sampler.batch(0)
    predicted = batch.targets + torch.randn(batch.targets.shape) * 0.1
    truth, guess = (
        svd.inverse_transform(x[batch.mask].numpy()) for x in (batch.targets, predicted)
    )
    loss = (weight_prediction_error(predicted, batch) / batch.mask.sum()).item()
    assert loss == pytest.approx(np.mean((truth - guess) ** 2), rel=1e-5)


@pytest.mark.parametrize("lengths", [[], [5, 1]])
def test_too_little_to_train_on_is_refused(lengths: list[int]) -> None:
    with pytest.raises(TrainError, match="at least two snapshots"):
        TokenSampler([run(n, 0) for n in lengths], window=3, batch_size=2, seed=0)
