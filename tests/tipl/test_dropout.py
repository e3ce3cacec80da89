from __future__ import annotations

import pytest
import torch

from tipl.models.dropout import keep_factors

SIZES = (300, 7, 50)


def draw(n: int = 5, seed: int = 3, rows: slice = slice(None)) -> tuple[torch.Tensor, ...]:
    keep = keep_factors(0.1, SIZES, seed=seed, n=n, batch=40, rows=rows)
    assert keep is not None
    return keep


def test_factors_keep_the_mean() -> None:
    keep = torch.cat(draw(), dim=1)
    assert keep.shape == (40, 357)
    dropped = round(0.1 * 2**16) / 2**16
    assert keep.unique().tolist() == pytest.approx([0, 1 / (1 - dropped)], rel=1e-6)
    assert (keep == 0).float().mean().item() == pytest.approx(0.1, abs=0.01)


def test_a_share_of_the_windows_is_a_share_of_the_factors() -> None:
    for whole, part in zip(draw(), draw(rows=slice(10, 25)), strict=True):
        assert torch.equal(whole[10:25], part)


def test_factors_are_a_function_of_seed_and_batch() -> None:
    (first, *_), (again, *_) = draw(), draw()
    assert torch.equal(first, again)
    assert not torch.equal(first, draw(n=6)[0])
    assert not torch.equal(first, draw(seed=4)[0])


@pytest.mark.parametrize("p", [0.0, 1e-6])
def test_nothing_is_drawn_where_nothing_is_dropped(p: float) -> None:
    assert keep_factors(p, SIZES, seed=0, n=0, batch=2) is None
