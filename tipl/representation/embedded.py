"""A run in coefficients, found once as long as the run is open."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float

from tipl.representation.svd import TemporalSVD, fit_run
from weighttraj import Run


@dataclass(frozen=True, kw_only=True)
class Embedded:
    """A run in the basis of its whole trajectory."""

    svd: TemporalSVD
    """The basis."""
    coefficients: Float[np.ndarray, "time rank"]
    """Row t stands for phi_t."""


def embed(run: Run, rank: int) -> Embedded:
    """The run in d coefficients, as the paper has it.

    A basis of a large run takes tens of seconds, and forecasts are asked for some starts at a time:
    so what was found is kept as long as the run is open.

    Raises:
        RepresentationError: as ``fit_run``.
    """
    known = _KNOWN.setdefault(run, {})
    if rank not in known:
        svd = fit_run(run, rank)
        known[rank] = Embedded(svd=svd, coefficients=svd.coefficients(run))
    return known[rank]


_KNOWN: WeakKeyDictionary[Run, dict[int, Embedded]] = WeakKeyDictionary()
