"""The causal Transformer of TIPL, with the defaults of Decision Transformer's GPT.

After Chen et al., "Decision Transformer" (NeurIPS 2021): time is a learned embedding of the
absolute index and there is no other position; ReLU; LayerNorm on the embedded input; pre-LN blocks.
TIPL (Tang, 2025) puts one token of policy coefficients in the place of state, action and return.
Our choices, where the paper is silent: one token for each snapshot, no tanh on the output, and the
output at t is the token of t + 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn


@dataclass(frozen=True, kw_only=True)
class GPTConfig:
    """Sizes of the network."""

    rank: int = 32
    """Number of coefficients in a token, d."""
    max_timestep: int = 0
    """Number of time indices that have an embedding: 0 to max_timestep - 1. When a training begins,
    0 stands for the length of its longest run."""
    block_size: int = 20
    """Number of tokens in the longest window, K."""
    n_layer: int = 3
    """Number of Transformer blocks."""
    n_head: int = 1
    """Number of attention heads."""
    n_embd: int = 128
    """Width of the residual stream."""
    dropout: float = 0.1
    """Dropout probability of embeddings, attention and residual branches."""
    residual: bool = False
    """Whether the network writes the step to the next token, not the token itself as in the paper.
    It then begins as persistence."""


class GPT(nn.Module):
    """Predicts each next token of a window from the tokens up to it."""

    input_mean: Tensor
    input_std: Tensor
    step_std: Tensor

    def __init__(self, config: GPTConfig) -> None:
        super().__init__()
        self.config = config
        # The constants of the normalisation are buffers, so they are saved with the parameters.
        self.register_buffer("input_mean", torch.zeros(config.rank))
        self.register_buffer("input_std", torch.ones(config.rank))
        if config.residual:
            self.register_buffer("step_std", torch.ones(config.rank))
        self.embed_token = nn.Linear(config.rank, config.n_embd)
        self.embed_timestep = nn.Embedding(config.max_timestep, config.n_embd)
        self.embed_norm = nn.LayerNorm(config.n_embd)
        self.drop = nn.Dropout(config.dropout)
        self.blocks = nn.ModuleList([Block(config) for _ in range(config.n_layer)])
        self.final_norm = nn.LayerNorm(config.n_embd)
        self.head = nn.Linear(config.n_embd, config.rank)
        self.blocks.apply(_init_gpt2)
        if config.residual:
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)

    def forward(
        self,
        tokens: Float[Tensor, "batch window rank"],
        timesteps: Int[Tensor, "batch window"],
        mask: Bool[Tensor, "batch window"],
    ) -> Float[Tensor, "batch window rank"]:
        """Return the predicted next token at each place of the window.

        Args:
            tokens: coefficients of consecutive snapshots.
            timesteps: index of each snapshot in its run.
            mask: False where a row is padding, on the left.
        """
        attn_mask = attention_mask(mask)  # (batch, 1, window, window)
        x = self.embed_token((tokens - self.input_mean) / self.input_std)
        x = self.embed_norm(x + self.embed_timestep(timesteps))  # (batch, window, n_embd)
        x = self.drop(x)
        for block in self.blocks:
            x = block(x, attn_mask)
        predicted: Tensor = self.head(self.final_norm(x))  # (batch, window, rank)
        return tokens + predicted * self.step_std if self.config.residual else predicted


class Block(nn.Module):
    """Attention and MLP, each behind a LayerNorm, each added to the residual stream."""

    def __init__(self, config: GPTConfig) -> None:
        super().__init__()
        self.n_head = config.n_head
        self.norm_1 = nn.LayerNorm(config.n_embd)
        self.qkv = nn.Linear(config.n_embd, 3 * config.n_embd)
        self.proj = nn.Linear(config.n_embd, config.n_embd)
        self.norm_2 = nn.LayerNorm(config.n_embd)
        self.mlp = nn.Sequential(
            nn.Linear(config.n_embd, 4 * config.n_embd),
            nn.ReLU(inplace=True),
            nn.Linear(4 * config.n_embd, config.n_embd),
        )
        self.drop_attention = nn.Dropout(config.dropout)
        self.drop = nn.Dropout(config.dropout)

    def forward(
        self,
        x: Float[Tensor, "batch window n_embd"],
        attn_mask: Float[Tensor, "batch 1 window window"],
    ) -> Float[Tensor, "batch window n_embd"]:
        """Return the residual stream after this block."""
        x = x + self.drop(self._attend(self.norm_1(x), attn_mask))
        more: Tensor = self.drop(self.mlp(self.norm_2(x)))
        return x + more

    def _attend(
        self,
        x: Float[Tensor, "batch window n_embd"],
        attn_mask: Float[Tensor, "batch 1 window window"],
    ) -> Float[Tensor, "batch window n_embd"]:
        batch, window, n_embd = x.shape
        heads = (batch, window, self.n_head, -1)
        parts = self.qkv(x).chunk(3, dim=2)
        q, k, v = (part.view(heads).transpose(1, 2) for part in parts)  # (batch, head, window, _)
        # In windows as short as ours, plain products are faster than scaled_dot_product_attention.
        scores: Tensor = q @ k.transpose(2, 3) * q.shape[3] ** -0.5 + attn_mask
        attention: Tensor = self.drop_attention(scores.softmax(-1))  # (batch, head, window, window)
        mixed = (attention @ v).transpose(1, 2)  # (batch, window, head, width)
        projected: Tensor = self.proj(mixed.reshape(batch, window, n_embd))
        return projected


def attention_mask(mask: Bool[Tensor, "batch window"]) -> Float[Tensor, "batch 1 window window"]:
    """Return what is added to attention scores: 0, or minus infinity where a token must not look.

    A token sees itself and earlier tokens, and no padding.
    """
    window = mask.shape[1]
    causal = torch.ones(window, window, dtype=torch.bool, device=mask.device).tril()
    # A padding row attends to itself: a row with nothing to attend to would be NaN.
    itself = torch.eye(window, dtype=torch.bool, device=mask.device)
    visible = (causal & mask[:, None, :]) | itself  # (batch, window, window)
    zeros = torch.zeros(visible.shape, device=mask.device)
    return zeros.masked_fill(~visible, -torch.inf)[:, None]


def _init_gpt2(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.02)
        nn.init.zeros_(module.bias)
