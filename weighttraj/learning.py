"""When a training has learned: the end of its learning phase, read off its returns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

LEARNED = 0.95
"""Share of the way from the first to the final return at which the learning phase ends."""


def learning_phase(returns: Float[np.ndarray, " time"], share: float = LEARNED) -> int:
    """Return the first snapshot whose return has come most of the way to the final return.

    The final return is the median of the snapshots in the last quarter of the run, so that it does
    not depend on how densely the learning phase was evaluated.

    >>> learning_phase(np.array([0.0, 5.0, np.nan, 9.0, 10.0, 10.0, 10.0, 10.0]))
    4

    Args:
        returns: mean return of each snapshot, NaN where it was not evaluated.
        share: of the way from the first to the final return.

    Returns:
        Index of a snapshot; 0 if no snapshot was evaluated, or the return does not rise.
    """
    rows = np.flatnonzero(np.isfinite(returns))
    if not len(rows):
        return 0
    first = returns[rows[0]]
    late = rows[rows >= 0.75 * (len(returns) - 1)]
    final = np.median(returns[late if len(late) else rows[-1:]])
    if final <= first:
        return 0
    return int(rows[np.argmax(returns[rows] - first >= share * (final - first))])
