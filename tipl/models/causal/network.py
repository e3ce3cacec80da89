"""A causal Transformer on the path as seen from its end, in a basis that has seen no future.

The blocks are those of TIPL. Our choices: tokens are displacements from phi_t in directions of the
observed prefix, in units of the local step; time is relative; the phase of each snapshot, the
spectrum of the prefix and the learning rate are inputs; and each horizon has a head of its own,
which begins at 0: persistence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from tipl.horizons import HORIZONS
from tipl.models.tipl.network import Block, GPTConfig, attention_mask


@dataclass(frozen=True, kw_only=True)
class CausalConfig:
    """Sizes of the network, and of what it sees."""

    horizons: tuple[int, ...] = HORIZONS
    """Numbers of snapshots ahead: one head each."""
    rank: int = 16
    """Number of directions of the prefix."""
    window: int = 256
    """Largest number of snapshots that a basis sees."""
    block_size: int = 20
    """Number of tokens: the last snapshots."""
    phases: int = 0
    """Number of snapshots in an iteration of PPO. When a training begins, 0 stands for that of its
    runs."""
    n_layer: int = 3
    """Number of Transformer blocks."""
    n_head: int = 4
    """Number of attention heads."""
    n_embd: int = 64
    """Width of the residual stream."""
    unit: Literal["recent", "first"] = "recent"
    """Unit of length: the RMS norm of the last steps, or of the first steps of the run."""

    @property
    def states(self) -> int:
        """Number of inputs of a start: the spectrum, and three for its time."""
        return self.rank + 3


class CausalGPT(nn.Module):
    """Predicts displacements after the last token of a window."""

    root: Tensor

    def __init__(self, config: CausalConfig) -> None:
        super().__init__()
        self.config = config
        sizes = GPTConfig(
            rank=config.rank,
            max_timestep=config.block_size,
            block_size=config.block_size,
            n_layer=config.n_layer,
            n_head=config.n_head,
            n_embd=config.n_embd,
            dropout=0.0,
        )
        self.embed_token = nn.Linear(config.rank, config.n_embd)
        self.embed_phase = nn.Embedding(config.phases + 1, config.n_embd)
        self.embed_place = nn.Embedding(config.block_size, config.n_embd)
        self.embed_state = nn.Linear(config.states, config.n_embd)
        self.embed_norm = nn.LayerNorm(config.n_embd)
        self.blocks = nn.ModuleList([Block(sizes) for _ in range(config.n_layer)])
        self.final_norm = nn.LayerNorm(config.n_embd)
        self.head = nn.Linear(config.n_embd, config.rank * len(config.horizons))
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        roots = torch.tensor(config.horizons).float().sqrt()
        self.register_buffer("root", roots[:, None], persistent=False)

    def forward(
        self,
        tokens: Float[Tensor, "batch window rank"],
        phases: Int[Tensor, "batch window"],
        mask: Bool[Tensor, "batch window"],
        state: Float[Tensor, "batch state"],
    ) -> Float[Tensor, "batch horizon rank"]:
        """Return displacements in the basis of each window, in units of its local step.

        Args:
            tokens: displacements of the last snapshots from the last one of all.
            phases: phase of each, from 0, which is before training.
            mask: False in padding on the left.
            state: spectrum and time of the whole window.
        """
        x = self.embed_token(tokens) + self.embed_phase(phases) + self.embed_place.weight
        x = self.embed_norm(x + self.embed_state(state)[:, None])  # (batch, window, n_embd)
        attn_mask = attention_mask(mask)
        for block in self.blocks:
            x = block(x, attn_mask)
        last = self.final_norm(x[:, -1])  # (batch, n_embd)
        moved: Tensor = self.head(last).view(len(tokens), -1, self.config.rank)
        return moved * self.root
