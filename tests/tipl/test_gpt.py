from __future__ import annotations

import torch
from torch.nn import functional

from tipl.models.gpt import GPT, Block, GPTConfig

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


def test_dropout_multiplies_what_is_kept() -> None:
    tokens, timesteps, mask = inputs()
    whole = [torch.ones(3, size) for size in CONFIG.dropped]
    assert len(whole) == 1 + 3 * CONFIG.n_layer
    plain = model()(tokens, timesteps, mask)
    torch.testing.assert_close(model()(tokens, timesteps, mask, whole), plain)
    for site in range(len(whole)):
        keep = [factors.clone() for factors in whole]
        keep[site][1, -1] = 0.0  # in the second window: its last activation, or attention to it
        changed = (model()(tokens, timesteps, mask, keep) != plain).any(2)
        assert changed.any(1).tolist() == [False, True, False], site
    nothing = [whole[0], *(torch.zeros_like(factors) for factors in whole[1:])]
    network = model()
    x = network.embed_norm(network.embed_token(tokens) + network.embed_timestep(timesteps))
    expected = network.head(network.final_norm(x))
    torch.testing.assert_close(network(tokens, timesteps, mask, nothing), expected)


def test_heads_attend_as_in_torch() -> None:
    """A block beside ``scaled_dot_product_attention``."""
    block, config = Block(CONFIG), CONFIG
    x = torch.randn(3, 6, 16)
    hidden = torch.full((6, 6), -torch.inf).triu(1)
    q, k, v = (
        part.view(3, 6, config.n_head, -1).transpose(1, 2) for part in block.qkv(x).chunk(3, dim=2)
    )
    mixed = functional.scaled_dot_product_attention(q, k, v, is_causal=True)
    expected = mixed.transpose(1, 2).reshape(18, 16)
    ours = block._attend(x.flatten(0, 1), hidden.expand(6, 6, 6), None)
    torch.testing.assert_close(ours, expected)
