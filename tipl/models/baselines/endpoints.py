"""LFD-2: the first and the last weights of a window, and a line through them.

After "Less is More: Efficient Weight Farcasting with 1-Layer Neural Network" (Shou et al., 2025,
arXiv:2505.02714), which Knyazev et al. (ICLR 2025, arXiv:2409.04434) compare with as LFD-2.

The paper fixes: of all weights seen so far only the first and the last are looked at; one linear
layer with a bias, shared by all parameters, gives all future weights at once. Ours: the first is
that of a window of five snapshots, as long as the other networks' (measured on validation runs:
skill 0.19 at h = 1 with 5, 0.14 with 11, 0.04 with 51, 0.00 with phi_0 itself); squared errors
instead of absolute ones, as that is what the skill counts; no regulariser.

The bias adds the same to every parameter and the weights enter as they are, not as differences.
So it is neither equivariant to a flip of signs nor to the scale of the steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tipl.models.baselines.data import Trajectory
from tipl.models.baselines.features import Features, Inputs


@dataclass(frozen=True)
class EndPoints(Features):
    """The oldest weights of a window, the newest, and 1."""

    context: int = 5
    """Snapshots in the window."""
    kind = "end-points"
    name = "lfd-2"
    size = 3

    def __call__(self, trajectory: Trajectory, starts: Sequence[int]) -> Iterator[Inputs]:
        """The features of each start."""
        for place, window in trajectory.windows(starts, self.context - 1):
            last = window[-1]
            yield place, last, np.stack([window[0], last, np.ones_like(last)])
