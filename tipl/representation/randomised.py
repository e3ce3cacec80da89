"""The leading singular vectors of a matrix that is read a few times, a piece at a time.

Randomised subspace iteration (Halko, Martinsson and Tropp, "Finding structure with randomness",
SIAM Review 2011, algorithm 4.4) with two changes. A pass over the rows of A takes ``V`` to both
``A V`` and ``A^T (A V)``, so that each power iteration reads the matrix once. And the directions
of all passes are kept, not those of the last alone (block Krylov; Musco and Musco, NeurIPS 2015):
what has been computed anyhow then makes the error smaller by orders of magnitude.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tipl.representation.rows import Stack, spans

NEW = 1e-3
"""Squared length of what a unit vector adds to a basis, below which it adds nothing but rounding.
Directions are made orthogonal to the earlier ones, so that most add all their length."""


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
    stack: Stack, rank: int, *, oversampling: int, power_iterations: int, seed: int
) -> Leading:
    """The leading singular triplets; reads the matrix ``power_iterations + 1`` times.

    All arithmetic is in float64. In float32, the first singular value of weights, hundreds of times
    the others, would drown them in the first pass.

    Args:
        stack: the matrix.
        rank: singular triplets.
        oversampling: directions beyond the rank that are followed.
        power_iterations: passes before the last one.
        seed: seed of the random directions at the start.
    """
    width = min(rank + oversampling, stack.shape[1])
    start = np.random.default_rng(seed).standard_normal((stack.shape[1], width))
    directions = _orthonormal(start)
    basis, images, energy = [directions], [], 0.0
    for i in range(power_iterations + 1):
        image, back, found = _pass(stack, basis[-1], first=i == 0, last=i == power_iterations)
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
    stack: Stack, directions: Float[np.ndarray, "param width"], *, first: bool, last: bool
) -> tuple[Float[np.ndarray, "time width"], Float[np.ndarray, "param width"] | None, float]:
    """A V, A^T A V but in the last pass, and the squared norm of A in the first."""
    image = np.empty((stack.shape[0], directions.shape[1]))
    back = None if last else np.zeros(directions.shape)
    energy = 0.0
    for start, rows in stack.pieces():
        if first:
            energy += squared_norm(rows)
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
    """The best triplets that a basis V has (Rayleigh-Ritz), from A V."""
    # V is orthonormal but for rounding. Its Gram matrix tells how much, and takes that out.
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
    """Take out of vectors, in place, what lies in an orthonormal basis."""
    size = len(vectors)
    overlap = np.zeros((sum(part.shape[1] for part in basis), vectors.shape[1]))
    for span, part in zip(spans(size), _blocks(basis), strict=True):
        overlap += part.T @ vectors[span]
    for span, part in zip(spans(size), _blocks(basis), strict=True):
        vectors[span] -= part @ overlap


def _orthonormal(vectors: Float[np.ndarray, "param width"]) -> Float[np.ndarray, "param kept"]:
    """An orthonormal basis of the span, in the place of the vectors; all but rounding is kept.

    From Gram matrices, which is cheaper than QR by far. But a Gram matrix tells only lengths apart
    that are within 1e8 of each other. So the longest directions are found first, and then, in what
    they leave, the longest again.
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


def squared_norm(rows: Float[np.ndarray, "row param"]) -> float:
    """Squared Frobenius norm, summed in float64."""
    wide = (row.astype(np.float64) for row in rows)
    return float(sum(row @ row for row in wide))


def _blocks(basis: Sequence[np.ndarray]) -> Iterator[Float[np.ndarray, "block all"]]:
    """Some parameters of all directions at a time."""
    for span in spans(len(basis[0])):
        yield np.concatenate([part[span] for part in basis], axis=1)
