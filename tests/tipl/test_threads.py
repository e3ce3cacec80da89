from __future__ import annotations

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from tipl.threads import threads


def of_numpy() -> set[int]:
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


def test_torch_and_numpy_have_so_many_threads_and_then_as_before() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with threadpool_limits(2, user_api="blas"):
            with pytest.raises(KeyError), threads():
                assert (torch.get_num_threads(), of_numpy()) == (1, {1})
                raise KeyError
            assert (torch.get_num_threads(), of_numpy()) == (2, {2})
    finally:
        torch.set_num_threads(before)
