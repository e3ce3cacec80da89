from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn import functional

from tipl.models.tipl.network import GPT, Block, GPTConfig, attention_mask

CONFIG = GPTConfig(rank=4, max_timestep=50, block_size=6, n_embd=16, n_head=2)


def inputs(batch: int = 3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    tokens = torch.randn(batch, 6, 4)
    timesteps = torch.arange(10, 16).expand(batch, 6)
    return tokens, timesteps, torch.ones(batch, 6, dtype=torch.bool)


def model() -> GPT:
    torch.manual_seed(1)
    return GPT(CONFIG).eval()


def test_later_tokens_do_not_move_earlier_outputs() -> None:
    tokens, timesteps, mask = inputs()
    before = model()(tokens, timesteps, mask)
    tokens[:, 4:] += 1
    after = model()(tokens, timesteps, mask)
    assert torch.equal(before[:, :4], after[:, :4])
    assert not torch.equal(before[:, 4:], after[:, 4:])


def test_padding_is_not_seen() -> None:
    tokens, timesteps, mask = inputs()
    mask[:, :2] = False
    before = model()(tokens, timesteps, mask)
    tokens[:, :2] = 1e3
    assert torch.equal(before[:, 2:], model()(tokens, timesteps, mask)[:, 2:])
    short = model()(tokens[:, 2:], timesteps[:, 2:], mask[:, 2:])
    torch.testing.assert_close(before[:, 2:], short)
    assert torch.isfinite(before).all()


def test_time_is_seen() -> None:
    tokens, timesteps, mask = inputs()
    assert not torch.equal(model()(tokens, timesteps, mask), model()(tokens, timesteps + 1, mask))


def test_inputs_are_standardised_by_saved_buffers() -> None:
    tokens, timesteps, mask = inputs()
    network = model()
    plain = network(tokens, timesteps, mask)
    network.input_mean.fill_(2.0)
    network.input_std.fill_(3.0)
    torch.testing.assert_close(network(tokens * 3 + 2, timesteps, mask), plain)
    assert {"input_mean", "input_std"} <= network.state_dict().keys()


def test_sizes_are_decision_transformers() -> None:
    network = GPT(GPTConfig(rank=32, max_timestep=1951))
    assert sum(p.numel() for p in network.blocks.parameters()) == 3 * 198_272
    assert (network.config.block_size, network.config.n_head, network.config.dropout) == (
        20,
        1,
        0.1,
    )


def test_dropout_is_drawn_in_training_from_the_seed() -> None:
    tokens, timesteps, mask = inputs()
    network = model()
    plain = network(tokens, timesteps, mask)
    network.train()
    drawn = []
    for seed in (5, 5, 6):
        torch.manual_seed(seed)
        drawn.append(network(tokens, timesteps, mask))
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    assert not torch.equal(drawn[0], plain)


def test_heads_attend_as_in_torch() -> None:
    """A block beside ``scaled_dot_product_attention``."""
    block = Block(CONFIG).eval()
    x = torch.randn(3, 6, 16)
    heads = (3, 6, CONFIG.n_head, -1)
    q, k, v = (part.view(heads).transpose(1, 2) for part in block.qkv(x).chunk(3, dim=2))
    mixed = functional.scaled_dot_product_attention(q, k, v, is_causal=True)
    expected = block.proj(mixed.transpose(1, 2).reshape(3, 6, 16))
    attn_mask = attention_mask(torch.ones(3, 6, dtype=torch.bool))
    torch.testing.assert_close(block._attend(x, attn_mask), expected)


def test_a_residual_network_begins_as_persistence_and_counts_in_steps() -> None:
    tokens, timesteps, mask = inputs()
    network = GPT(replace(CONFIG, residual=True)).eval()
    assert torch.equal(network(tokens, timesteps, mask), tokens)
    torch.nn.init.ones_(network.head.bias)
    network.step_std.copy_(torch.tensor([1.0, 2.0, 3.0, 4.0]))
    torch.testing.assert_close(
        network(tokens, timesteps, mask) - tokens, network.step_std.expand(tokens.shape)
    )
