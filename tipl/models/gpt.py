"""The causal Transformer of TIPL, with the defaults of Decision Transformer's GPT.

After Chen et al., "Decision Transformer" (NeurIPS 2021): time is a learned embedding of the
absolute index and there is no other position; ReLU; LayerNorm on the embedded input; pre-LN blocks.
TIPL (Tang, 2025) puts one token of policy coefficients in the place of state, action and return.
Ours, where the paper is silent: one token a step, no tanh on the output, the output at t is the
token of t + 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn


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
    """Width of the stream."""
    dropout: float = 0.1
    """Dropout of embeddings, attention and residual branches."""

    @property
    def dropped(self) -> tuple[int, ...]:
        """Activations of one window that dropout sees: embedding, then three sites a block."""
        stream, attention = self.block_size * self.n_embd, self.n_head * self.block_size**2
        return (stream, *(attention, stream, stream) * self.n_layer)


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
        self.blocks = nn.ModuleList([Block(config) for _ in range(config.n_layer)])
        self.final_norm = nn.LayerNorm(config.n_embd)
        self.head = nn.Linear(config.n_embd, config.rank)
        self.blocks.apply(_init_gpt2)

    def forward(
        self,
        tokens: Float[Tensor, "batch window rank"],
        timesteps: Int[Tensor, "batch window"],
        mask: Bool[Tensor, "batch window"],
        keep: Sequence[Float[Tensor, "batch _"]] | None = None,
    ) -> Float[Tensor, "batch window rank"]:
        """Predicted next tokens. Rows where ``mask`` is False are padding on the left.

        Args:
            tokens: coefficients of consecutive snapshots.
            timesteps: index of each.
            mask: False in padding.
            keep: factors of dropout, a tensor a site of ``GPTConfig.dropped``; None drops nothing.
        """
        at_input, *at_blocks = keep or (None,) * len(self.config.dropped)
        x = self.embed_token((tokens - self.input_mean) / self.input_std)
        x = self.embed_norm(x + self.embed_timestep(timesteps))
        hidden = hidden_from(mask, self.config.n_head)
        # In the blocks all rows are one matrix: products take it as it is, forth and back.
        x = _drop(x.flatten(0, 1), at_input)  # (batch * window, n_embd)
        for i, block in enumerate(self.blocks):
            x = block(x, hidden, *at_blocks[3 * i : 3 * i + 3])
        predicted: Tensor = self.head(self.final_norm(x)).view(tokens.shape)
        return predicted


class Block(nn.Module):
    """Attention and MLP, each behind a LayerNorm, each added to the stream."""

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

    def forward(
        self,
        x: Float[Tensor, "row n_embd"],
        hidden: Float[Tensor, "batch_head window window"],
        keep_attention: Float[Tensor, "batch attention"] | None,
        keep_mixed: Float[Tensor, "batch stream"] | None,
        keep_mlp: Float[Tensor, "batch stream"] | None,
    ) -> Float[Tensor, "row n_embd"]:
        """The stream after this block.

        Args:
            x: the stream, all windows one below the other.
            hidden: 0 where a token may attend, minus infinity elsewhere.
            keep_attention: factors of dropout on the attention, or None.
            keep_mixed: the same on what attention adds.
            keep_mlp: the same on what the MLP adds.
        """
        mixed = self.proj(self._attend(self.norm_1(x), hidden, keep_attention))
        x = x + _drop(mixed, keep_mixed)
        return x + _drop(self.mlp(self.norm_2(x)), keep_mlp)

    def _attend(
        self,
        x: Float[Tensor, "row n_embd"],
        hidden: Float[Tensor, "batch_head window window"],
        keep: Float[Tensor, "batch attention"] | None,
    ) -> Float[Tensor, "row n_embd"]:
        # In a window as short as ours, plain products beat scaled_dot_product_attention.
        window = hidden.shape[1]
        q, k, v = (self._heads(part, window) for part in self.qkv(x).chunk(3, dim=1))
        scale = q.shape[2] ** -0.5
        scores = torch.add(hidden, torch.bmm(q, k.transpose(1, 2)), alpha=scale)
        attention = _drop(scores.softmax(-1), keep)
        mixed = torch.bmm(attention, v)  # (batch * n_head, window, n_embd / n_head)
        mixed = mixed.view(-1, self.n_head, *mixed.shape[1:]).transpose(1, 2)
        return mixed.reshape(x.shape)

    def _heads(
        self, x: Float[Tensor, "row n_embd"], window: int
    ) -> Float[Tensor, "batch_head window width"]:
        parts = x.view(x.shape[0] // window, window, self.n_head, -1)
        return parts.transpose(1, 2).flatten(0, 1)


def hidden_from(
    mask: Bool[Tensor, "batch window"], n_head: int
) -> Float[Tensor, "batch_head window window"]:
    """Minus infinity where a token must not look: at what comes later, and at padding."""
    window = mask.shape[1]
    causal = torch.ones(window, window, dtype=torch.bool, device=mask.device).tril()
    # A padding row attends to itself: a row with nothing to attend to would be NaN.
    itself = torch.eye(window, dtype=torch.bool, device=mask.device)
    visible = (causal & mask[:, None, :]) | itself  # (batch, window, window)
    hidden = torch.zeros(visible.shape, device=mask.device).masked_fill_(~visible, -torch.inf)
    return hidden.repeat_interleave(n_head, dim=0)


def _drop(x: Float[Tensor, "*any"], keep: Float[Tensor, "batch each"] | None) -> Tensor:
    return x if keep is None else x * keep.view(x.shape)


def _init_gpt2(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.02)
        nn.init.zeros_(module.bias)
