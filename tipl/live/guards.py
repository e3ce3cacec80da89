"""Whether a jump is made, and whether it stands."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tipl.live.config import JumpConfig


def surrogate(
    log_ratio: Float[Tensor, " sample"], advantages: Float[Tensor, " sample"], clip: float
) -> float:
    """Return PPO's clipped surrogate of a policy on a rollout, in units of the advantages' spread.

    Args:
        log_ratio: log-probability of each action less that at the time of the rollout.
        advantages: of the actions.
        clip: clip of the probability ratio.
    """
    scaled = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    ratio = log_ratio.exp()
    return float(torch.minimum(ratio * scaled, ratio.clamp(1 - clip, 1 + clip) * scaled).mean())


def passes_batch(kl: float, before: float, after: float, config: JumpConfig) -> bool:
    """Say whether the guard ``batch`` lets a jump happen.

    Args:
        kl: mean KL divergence of the policies before and after the jump on the last rollout.
        before: surrogate of the policy before the jump.
        after: surrogate of the policy after the jump.
        config: the limits.
    """
    return bool(np.isfinite(after)) and kl <= config.max_kl and after >= before


class ReturnWatch:
    """Compares the returns after a jump with those before it, for the guard ``rollout``."""

    def __init__(self, config: JumpConfig) -> None:
        self._noise = config.noise
        self._before: deque[float] = deque(maxlen=config.episodes)

    def add(self, returns: Sequence[float]) -> None:
        """Take in the returns of the training episodes of a rollout that stands."""
        self._before.extend(returns)

    def has_fallen(self, returns: Sequence[float]) -> bool:
        """Say whether the mean return of a rollout is below the earlier ones by more than noise.

        The standard error of the difference of two means is taken from the spread of the earlier
        episodes. False where fewer than two episodes are known before, or none after.
        """
        if len(self._before) < 2 or not returns:
            return False
        spread = float(np.std(self._before, ddof=1))
        error = spread * (1 / len(self._before) + 1 / len(returns)) ** 0.5
        return bool(np.mean(returns) < np.mean(self._before) - self._noise * error)
