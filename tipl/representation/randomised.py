"""The leading singular vectors of a matrix that is read a few times, a piece at a time.

Randomised subspace iteration (Halko, Martinsson and Tropp, "Finding structure with randomness",
SIAM Review 2011, algorithm 4.4) with two changes. One pass over the rows of A computes both ``A V``
and ``A^T (A V)``, so that each power iteration reads the matrix once. And the directions of all
passes are kept, not only the last ones (block Krylov; Musco and Musco, NeurIPS 2015), which makes
the error smaller by orders of magnitude at no cost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tipl.representation.rows import Snapshots, spans

NEW = 1e-3
"""Squared length of what a unit vector adds to a basis; below this it adds only rounding."""


@dataclass(frozen=True, kw_only=True)
class Leading:
    """The leading singular triplets of a matrix."""

    left: Float[np.ndarray, "time rank"]
    """Columns of U."""
    singular_values: Float[np.ndarray, " rank"]
    """Falling."""
    components: Float[np.ndarray, "rank param"]
    """Rows of V^T."""
    energy: float
    """Squared Frobenius norm of the whole matrix."""


def leading(
    snapshots: Snapshots, rank: int, *, oversampling: int, power_iterations: int, seed: int
) -> Leading:
    """Return the leading singular triplets; read the matrix ``power_iterations + 1`` times.

    All arithmetic is in float64: the first singular value of weights is hundreds of times the
    others, which float32 would lose in the first pass.
    """
    width = min(rank + oversampling, snapshots.shape[1])
    start = np.random.default_rng(seed).standard_normal((snapshots.shape[1], width))
    basis, images, energy = [_orthonormal(start)], [], 0.0
    for i in range(power_iterations + 1):
        image, back, found = _pass(snapshots, basis[-1], first=i == 0, last=i == power_iterations)
        images.append(image)
        energy += found
        if back is None:
            break
        _subtract(back, basis)
        directions = _orthonormal(back)
        if not directions.shape[1]:  # the basis holds every row
            break
        basis.append(directions)
    return _of_basis(basis, np.hstack(images), rank, energy)


def _pass(
    snapshots: Snapshots, directions: Float[np.ndarray, "param width"], *, first: bool, last: bool
) -> tuple[Float[np.ndarray, "time width"], Float[np.ndarray, "param width"] | None, float]:
    """Return A V; A^T A V unless it is the last pass; the squared norm of A if it is the first."""
    image = np.empty((snapshots.shape[0], directions.shape[1]))
    back = None if last else np.zeros(directions.shape)
    energy = 0.0
    for start, rows in snapshots.pieces():
        if first:
            energy += _squared_norm(rows)
        product = image[start : start + len(rows)]
        product[:] = 0
        for span in spans(rows.shape[1]):
            product += rows[:, span].astype(np.float64) @ directions[span]
        if back is not None:
            for span in spans(rows.shape[1]):
                back[span] += rows[:, span].astype(np.float64).T @ product
    return image, back, energy


def _of_basis(
    basis: Sequence[Float[np.ndarray, "param _"]],
    images: Float[np.ndarray, "time all"],
    rank: int,
    energy: float,
) -> Leading:
    """Return the best triplets within a basis V (Rayleigh-Ritz), from A V."""
    # V is orthonormal except for rounding, which its Gram matrix takes out.
    gram = np.zeros((images.shape[1],) * 2)
    for part in _blocks(basis):
        gram += part.T @ part
    lengths, turn = np.linalg.eigh(gram)
    turn = turn[:, lengths > NEW] / np.sqrt(lengths[lengths > NEW])
    left, values, right = np.linalg.svd(images @ turn, full_matrices=False)
    mix = turn @ right[:rank].T
    components = np.concatenate([part @ mix for part in _blocks(basis)]).T
    return Leading(
        left=left[:, :rank],
        singular_values=values[:rank],
        components=components,
        energy=energy,
    )


def _subtract(
    vectors: Float[np.ndarray, "param width"], basis: Sequence[Float[np.ndarray, "param _"]]
) -> None:
    """Subtract from vectors, in place, their part in an orthonormal basis."""
    size = len(vectors)
    overlap = np.zeros((sum(part.shape[1] for part in basis), vectors.shape[1]))
    for span, part in zip(spans(size), _blocks(basis), strict=True):
        overlap += part.T @ vectors[span]
    for span, part in zip(spans(size), _blocks(basis), strict=True):
        vectors[span] -= part @ overlap


def _orthonormal(vectors: Float[np.ndarray, "param width"]) -> Float[np.ndarray, "param kept"]:
    """Return an orthonormal basis of the span, in the memory of the vectors.

    It comes from Gram matrices, which are far cheaper than QR. A Gram matrix only resolves lengths
    within 1e8 of each other. So the longest directions are found first, then the longest ones of
    the rest, until only rounding is left.
    """
    lengths = np.sqrt(np.einsum("pw,pw->w", vectors, vectors))
    vectors /= np.where(lengths > 0, lengths, 1)
    left, rounding = vectors.shape[1], 0.0
    while left:
        rest = vectors[:, :left]
        squares, turn = np.linalg.eigh(rest.T @ rest)
        if squares[-1] <= rounding:
            break
        rounding = rounding or squares[-1] * (len(lengths) * np.finfo(np.float64).eps) ** 2
        for span in spans(len(vectors)):
            rest[span] = rest[span] @ turn
        left = int(np.sum(squares <= 1e-8 * squares[-1]))
        rest[:, left:] /= np.sqrt(squares[left:])
        _subtract(rest[:, :left], [rest[:, left:]])
    return vectors[:, left:]


def _squared_norm(rows: Float[np.ndarray, "row param"]) -> float:
    """Return the squared Frobenius norm, summed in float64."""
    wide = (row.astype(np.float64) for row in rows)
    return float(sum(row @ row for row in wide))


def _blocks(basis: Sequence[np.ndarray]) -> Iterator[Float[np.ndarray, "block all"]]:
    """Yield some parameters of all directions at a time."""
    for span in spans(len(basis[0])):
        yield np.concatenate([part[span] for part in basis], axis=1)
