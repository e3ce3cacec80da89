"""Weights in few numbers: the directions along which a policy moves most, and how far it is.

Three bases, of one kind (``TemporalSVD``). They differ in what they have seen:

- *of the run*: ``TemporalSVD.fit``, ``fit_streamed`` for runs larger than memory, and ``fit_run``,
  which chooses; ``embed`` keeps what it found. It has seen the future of every start, so what is
  forecast in it is not causal.
- *shared*: ``fit_shared``, one basis for several runs. It fails on runs of other seeds.
- *of the prefix*: ``PrefixBases``, for each start a basis that has seen nothing after it.
"""

from tipl.representation.embedded import Embedded, embed
from tipl.representation.prefix import PrefixBases, PrefixTokens
from tipl.representation.rows import RunOrRows
from tipl.representation.svd import TemporalSVD, fit_run, fit_shared

__all__ = [
    "Embedded",
    "PrefixBases",
    "PrefixTokens",
    "Rows",
    "RunOrRows",
    "TemporalSVD",
    "embed",
    "fit_run",
    "fit_shared",
]
