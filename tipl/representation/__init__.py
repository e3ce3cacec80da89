"""Weights in few numbers: coefficients in the directions along which a policy moves most.

There are two bases of one type (``TemporalSVD``), which differ in what they have seen:

- *of the run*: ``TemporalSVD.fit``, ``fit_streamed`` for runs larger than memory, and ``fit_run``,
  which chooses; ``embed`` keeps what it found. The basis has seen the future of every start, so a
  forecast in it is not causal.
- *of the prefix*: ``PrefixBases``, for each start a basis that has seen nothing after it.
"""

from tipl.representation.prefix import PrefixBases, PrefixTokens
from tipl.representation.rows import RunOrRows
from tipl.representation.svd import Embedded, TemporalSVD, embed, fit_run

__all__ = [
    "Embedded",
    "PrefixBases",
    "PrefixTokens",
    "RunOrRows",
    "TemporalSVD",
    "embed",
    "fit_run",
]
