"""How many threads a computation takes: torch's, and those of NumPy's linear algebra."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits

_LIMITS: list[int] = []
"""Numbers of threads of the blocks that are open, the innermost last."""


@contextmanager
def threads(count: int = 1) -> Iterator[None]:
    """Let torch and NumPy use ``count`` threads.

    Threads of a small product wait for each other in a loop. Where other processes use the cores, a
    Temporal SVD with several threads takes up to thirty times as long. Inside a block for as many
    threads this does nothing: to look for the libraries takes a millisecond or two.
    """
    before = torch.get_num_threads()
    if _LIMITS[-1:] == [count] and before == count:
        yield
        return
    torch.set_num_threads(count)
    _LIMITS.append(count)
    try:
        with threadpool_limits(count, user_api="blas"):  # of all libraries that are loaded by now
            yield
    finally:
        _LIMITS.pop()
        torch.set_num_threads(before)
