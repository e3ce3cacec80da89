"""The causal Transformer of TIPL, with the defaults of Decision Transformer's GPT.

After Chen et al., "Decision Transformer" (NeurIPS 2021): time is a learned embedding of the
absolute index and there is no other position; ReLU; LayerNorm on the embedded input; pre-LN blocks.
TIPL (Tang, 2025) puts one token of policy coefficients in the place of state, action and return.
Ours, where the paper is silent: one token a step, no tanh on the output, the output at t is the
token of t + 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True, kw_only=True)
class GPTConfig:
    """Sizes of the network."""

    rank: int
    """Coefficients in a token, d."""
    max_timestep: int
    """Time indices that have an embedding: 0 to max_timestep - 1."""
    block_size: int = 20
    """Tokens in the longest window, K."""
    n_layer: int = 3
    """Transformer blocks."""
    n_head: int = 1
    """Attention heads."""
    n_embd: int = 128
    """Width."""
    dropout: float = 0.1
    """Dropout of embeddings, attention and residual branches."""


class GPT(nn.Module):
    """Predicts each next token of a window from the tokens up to it."""

    input_mean: Tensor
    input_std: Tensor

    def __init__(self, config: GPTConfig) -> None:
        super().__init__()
        self.config = config
        # Constants of normalisation are buffers, so they are saved with the parameters.
        self.register_buffer("input_mean", torch.zeros(config.rank))
        self.register_buffer("input_std", torch.ones(config.rank))
        self.embed_token = nn.Linear(config.rank, config.n_embd)
        self.embed_timestep = nn.Embedding(config.max_timestep, config.n_embd)
        self.embed_norm = nn.LayerNorm(config.n_embd)
        self.dropout = nn.Dropout(config.dropout)
        self.blocks = nn.ModuleList([Block(config) for _ in range(config.n_layer)])
        self.final_norm = nn.LayerNorm(config.n_embd)
        self.head = nn.Linear(config.n_embd, config.rank)
        self.blocks.apply(_init_gpt2)

    def forward(
        self,
        tokens: Float[Tensor, "batch window rank"],
        timesteps: Int[Tensor, "batch window"],
        mask: Bool[Tensor, "batch window"],
    ) -> Float[Tensor, "batch window rank"]:
        """Predicted next tokens. Rows where ``mask`` is False are padding on the left."""
        x = self.embed_token((tokens - self.input_mean) / self.input_std)
        x = self.embed_norm(x + self.embed_timestep(timesteps))
        x = self.dropout(x)  # (batch, window, n_embd)
        window = tokens.shape[1]
        causal = torch.ones(window, window, dtype=torch.bool, device=tokens.device).tril()
        # A padding row attends to itself: a row with nothing to attend to would be NaN.
        itself = torch.eye(window, dtype=torch.bool, device=tokens.device)
        visible = (causal & mask[:, None, :]) | itself  # (batch, window, window)
        for block in self.blocks:
            x = block(x, visible[:, None])
        predicted: Tensor = self.head(self.final_norm(x))
        return predicted


class Block(nn.Module):
    """Attention and MLP, each behind a LayerNorm, each added to the stream."""

    def __init__(self, config: GPTConfig) -> None:
        super().__init__()
        self.n_head, self.p = config.n_head, config.dropout
        self.norm_1 = nn.LayerNorm(config.n_embd)
        self.qkv = nn.Linear(config.n_embd, 3 * config.n_embd)
        self.proj = nn.Linear(config.n_embd, config.n_embd)
        self.norm_2 = nn.LayerNorm(config.n_embd)
        self.mlp = nn.Sequential(
            nn.Linear(config.n_embd, 4 * config.n_embd),
            nn.ReLU(),
            nn.Linear(4 * config.n_embd, config.n_embd),
            nn.Dropout(config.dropout),
        )
        self.dropout = nn.Dropout(config.dropout)

    def forward(
        self,
        x: Float[Tensor, "batch window n_embd"],
        visible: Bool[Tensor, "batch 1 window window"],
    ) -> Float[Tensor, "batch window n_embd"]:
        """The stream after this block."""
        batch, window, width = x.shape
        heads = self.qkv(self.norm_1(x)).view(batch, window, 3, self.n_head, -1)
        q, k, v = heads.permute(2, 0, 3, 1, 4)  # each (batch, n_head, window, n_embd / n_head)
        p = self.p if self.training else 0.0
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=visible, dropout_p=p)
        mixed = mixed.transpose(1, 2).reshape(batch, window, width)
        x = x + self.dropout(self.proj(mixed))
        return x + self.mlp(self.norm_2(x))  # type: ignore[no-any-return]


def _init_gpt2(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.02)
        nn.init.zeros_(module.bias)
