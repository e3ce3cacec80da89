"""Dropout as a function of (seed, batch, window).

The paper and Decision Transformer draw dropout from the generator of the process, so that it
depends on how a batch is spread over devices. Ours is drawn for the whole batch at once, from its
number, by NumPy on every device; a process takes the rows of its windows. So one process, several,
and a training that was interrupted drop the same activations. Sixteen random bits an activation:
the probability is rounded to a multiple of 1/65536.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

LEVELS = 2**16


def keep_factors(
    p: float, sizes: Sequence[int], *, seed: int, n: int, batch: int, rows: slice = slice(None)
) -> tuple[Float[Tensor, "row _"], ...] | None:
    """What the activations of a batch are multiplied with: 0, or 1 / (1 - p).

    Args:
        p: probability of 0.
        sizes: activations of one window at each site of dropout.
        seed: seed of the training.
        n: number of the batch.
        batch: windows in the whole batch.
        rows: the windows that are wanted.

    Returns:
        float32, a tensor a site; None where nothing is dropped.
    """
    dropped = round(p * LEVELS)
    if dropped == 0:
        return None
    words = -(-sum(sizes) // 4)  # of 64 bits, enough for four activations
    bits = np.random.SFC64([seed, n, 1]).random_raw(batch * words)
    keep = bits.reshape(batch, words)[rows].view(np.uint16) >= dropped
    factor = np.float32(LEVELS / (LEVELS - dropped))
    ends = np.cumsum(sizes)
    return tuple(
        torch.from_numpy(np.multiply(keep[:, end - size : end], factor, dtype=np.float32))
        for size, end in zip(sizes, ends, strict=True)
    )
