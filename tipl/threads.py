"""How many threads a computation takes: torch's, and those of NumPy's linear algebra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits


@contextmanager
def threads(count: int = 1) -> Iterator[None]:
    """Let torch and NumPy use ``count`` threads.

    Threads of a small product wait for each other in a loop. Where other processes use the cores, a
    Temporal SVD with several threads takes up to thirty times as long.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with threadpool_limits(count, user_api="blas"):  # of all libraries that are loaded by now
            yield
    finally:
        torch.set_num_threads(before)
