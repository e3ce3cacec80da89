"""One pass over a run's weights: how far each step goes, and in how many directions.

Spectrum and path come from the Gram matrix of evenly spaced snapshots, so that memory stays small
whatever the size of the policy. A Gram matrix squares the condition number: singular values below
``FLOOR`` times the largest are rounding errors, and are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, Int64

from weighttraj.frames import distance
from weighttraj.publish.curves import thin
from weighttraj.run import Run

MAX_ROWS = 400
"""Snapshots of the Gram matrix, at most."""

MAX_BYTES = 1 << 28
"""Bytes of these snapshots, at most: fewer are taken of very large policies."""

FLOOR = 1e-8
"""Singular values below so much of the largest one are not shown."""

SHARE_FLOOR = 1e-13
"""Shares of the squared norm below this are rounding errors."""

_COLUMNS = 8192  # of a product in float64


@dataclass(frozen=True, kw_only=True)
class Walk:
    """The path of a run's weights."""

    steps: Float64[np.ndarray, " step"]
    """L2 norm of phi_{t+1} - phi_t."""
    rows: Int64[np.ndarray, " row"]
    """Snapshots that the following is about, at most ``MAX_ROWS``."""
    singular: Float64[np.ndarray, " rank"]
    """Singular values of these snapshots as rows, not centred, largest first."""
    beyond: Float64[np.ndarray, " rank"]
    """Share of the squared Frobenius norm beyond the first d = 1, 2, ... components."""
    path: Float64[np.ndarray, "row 2"]
    """Displacements phi_t - phi_0 in their first two principal directions."""
    path_share: Float64[np.ndarray, " 2"]
    """Share of the squared displacements in each direction."""
    broken: Int64[np.ndarray, " broken"] = field(default_factory=lambda: np.empty(0, np.int64))
    """Snapshots with NaN or infinite weights: left out above, where the steps to and from them are
    NaN."""

    @property
    def moved(self) -> bool:
        """Whether there are two snapshots that differ, as far as the Gram matrix can tell."""
        return len(self.singular) > 1 and bool((self.steps > 0).any())


def walk(run: Run, advance: Callable[[int], None] = lambda rows: None) -> Walk:
    """Read a run's weights once, some rows at a time.

    Args:
        run: at least one snapshot.
        advance: called with the number of snapshots that have been read.

    Raises:
        DamageError: a snapshot is damaged.
    """
    row = 4 * run.layout.size
    chosen = thin(len(run), max(2, min(MAX_ROWS, MAX_BYTES // row)))
    kept: Float32[np.ndarray, "row param"] = np.empty((len(chosen), run.layout.size), np.float32)
    steps: list[float] = []
    broken: list[int] = []
    last: Float32[np.ndarray, " param"] | None = None
    for start, block in run.weights.pieces():
        mine = (chosen >= start) & (chosen < start + len(block))
        kept[mine] = block[chosen[mine] - start]
        for t, row in enumerate(block, start):
            broken += [] if np.isfinite(row).all() else [t]
            steps += [] if last is None else [distance(row, last)]
            last = row
        last = block[-1].copy()  # the block need not stay in memory
        advance(len(block))
    whole = ~np.isin(chosen, broken)
    chosen, kept = chosen[whole], kept[whole]
    gram = _gram(kept)
    singular, beyond = spectrum(gram)
    path, share = _path(gram)
    return Walk(
        steps=np.array(steps, np.float64),
        rows=chosen,
        singular=singular,
        beyond=beyond,
        path=path,
        path_share=share,
        broken=np.array(broken, np.int64),
    )


def spectrum(
    gram: Float64[np.ndarray, "row row"],
) -> tuple[Float64[np.ndarray, " rank"], Float64[np.ndarray, " rank"]]:
    """Singular values above the floor, and the share of the squared norm beyond each rank."""
    if not len(gram):
        return np.empty(0), np.empty(0)
    squares = np.maximum(np.linalg.eigvalsh(gram)[::-1], 0)
    keep = squares > FLOOR**2 * squares[0]
    beyond = np.append(np.cumsum(squares[::-1])[::-1][1:], 0) / (squares.sum() or 1)
    return np.sqrt(squares[keep]), beyond[keep]


def rank_for(walk: Walk, share: float) -> int | None:
    """The fewest components beyond which at most such a share is left; None: not resolved."""
    enough = np.flatnonzero(walk.beyond <= share)
    return int(enough[0]) + 1 if len(enough) else None


def _gram(rows: Float32[np.ndarray, "row param"]) -> Float64[np.ndarray, "row row"]:
    gram = np.zeros((len(rows), len(rows)))
    for start in range(0, rows.shape[1], _COLUMNS):
        part = rows[:, start : start + _COLUMNS].astype(np.float64)
        gram += part @ part.T
    return gram


def _path(
    gram: Float64[np.ndarray, "row row"],
) -> tuple[Float64[np.ndarray, "row 2"], Float64[np.ndarray, " 2"]]:
    """Return coordinates of phi_t - phi_0; each direction points to where the path goes."""
    if not len(gram):
        return np.zeros((0, 2)), np.zeros(2)
    moved = gram - gram[:1] - gram[:, :1] + gram[0, 0]
    values, vectors = np.linalg.eigh((moved + moved.T) / 2)
    values = np.maximum(values[::-1], 0)
    path = np.zeros((len(gram), 2))
    some = min(2, len(gram))
    path[:, :some] = vectors[:, ::-1][:, :some] * np.sqrt(values[:some])
    farthest = path[np.abs(path).argmax(0), [0, 1]]
    path *= np.where(farthest < 0, -1, 1)
    share = np.zeros(2)
    share[:some] = values[:some] / (values.sum() or 1)
    return path, share
