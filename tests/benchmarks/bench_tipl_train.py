"""How fast is TIPL trained? One gradient step beside the same GPT-2 from `transformers`.

python tests/benchmarks/bench_tipl_train.py

The paper's batch, 64 windows, at Decision Transformer's sizes. Three take turns, because the
machine's speed moves: a step of ours; a step with the blocks of `transformers`, same batch, same
loss, dropout, clipping and fused AdamW; and the largest matrix product of the network alone, as
often as makes the floating point operations of a step: the limit of this machine. CPU time on one
thread, time of the clock on more, which means something on idle cores only; ratios are medians of
those within a turn. The row of `transformers`, which this project does not need, is left out where
it is not installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import save
from rich.console import Console
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from tipl.models.tipl.data import TokenRun, TokenSampler, Windows
from tipl.models.tipl.network import GPT, GPTConfig
from tipl.models.tipl.train import LOOP, weight_prediction_error
from tipl.training.loop import Learner, _Loop
from tipl.training.parallel import Ranks

SIZES = GPTConfig(rank=32, max_timestep=1950)
CONFIG = LOOP
Step = Callable[[int], object]


def sampler() -> TokenSampler:
    """Runs as long as InvertedPendulum's. What is in them does not matter for the speed."""
    rng = np.random.default_rng(0)
    runs = [
        TokenRun(
            coefficients=rng.normal(0, 0.02, (SIZES.max_timestep + 1, SIZES.rank)).astype("f4"),
            weights=np.ones(SIZES.rank, "f4"),
        )
        for _ in range(30)
    ]
    return TokenSampler(runs, window=SIZES.block_size, batch_size=CONFIG.batch_size, seed=0)


class Windowed(Learner[Windows]):
    """TIPL's network on these windows."""

    def __init__(self, batches: TokenSampler) -> None:
        self.network, self._batches = GPT(SIZES), batches

    def batch(self, n: int) -> Windows:
        return self._batches.batch(n)

    def loss(self, network: Callable[..., Tensor], batch: Windows) -> tuple[Tensor, Tensor]:
        predicted = network(batch.tokens, batch.timesteps, batch.mask)
        return weight_prediction_error(predicted, batch), batch.mask.sum()

    def save(self, out: Path) -> None:
        """Nothing is saved."""


def by_the_loop(batches: TokenSampler) -> Step:
    learner = Windowed(batches)
    loop = _Loop(learner, CONFIG, Path("nowhere"), Ranks(), Console(quiet=True))
    loop._network = learner.network.train()
    return loop.step


class Transformers(nn.Module):
    """The same network with the blocks of `transformers`."""

    def __init__(self) -> None:
        from transformers import GPT2Config, GPT2Model

        super().__init__()
        self.embed_token = nn.Linear(SIZES.rank, SIZES.n_embd)
        self.embed_timestep = nn.Embedding(SIZES.max_timestep, SIZES.n_embd)
        self.embed_norm = nn.LayerNorm(SIZES.n_embd)
        config = GPT2Config(
            vocab_size=1,
            bos_token_id=None,
            eos_token_id=None,
            n_positions=SIZES.block_size,
            n_embd=SIZES.n_embd,
            n_layer=SIZES.n_layer,
            n_head=SIZES.n_head,
            activation_function="relu",
            resid_pdrop=SIZES.dropout,
            embd_pdrop=SIZES.dropout,
            attn_pdrop=SIZES.dropout,
            use_cache=False,
        )
        self.blocks = GPT2Model(config)
        self.head = nn.Linear(SIZES.n_embd, SIZES.rank)

    def forward(self, tokens: Tensor, timesteps: Tensor, mask: Tensor) -> Tensor:
        x = self.embed_norm(self.embed_token(tokens) + self.embed_timestep(timesteps))
        return self.head(self.blocks(inputs_embeds=x, attention_mask=mask).last_hidden_state)


def by_transformers(batches: TokenSampler) -> Step:
    model = Transformers().train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, weight_decay=1e-4, fused=True)

    def step(n: int) -> None:
        batch = batches.batch(n)
        predicted = model(batch.tokens, batch.timesteps, batch.mask)
        loss = weight_prediction_error(predicted, batch) / batch.mask.sum()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), CONFIG.grad_clip)
        optimizer.step()
        loss.item()

    return step


def products(flop: float) -> Step:
    """The first product of the MLP, over and over."""
    rows, width = CONFIG.batch_size * SIZES.block_size, SIZES.n_embd
    x, w, out = (
        torch.randn(rows, width),
        torch.randn(width, 4 * width),
        torch.empty(rows, 4 * width),
    )
    times = round(flop / (2 * rows * width * 4 * width))

    def step(_: int) -> None:
        for _ in range(times):
            torch.mm(x, w, out=out)

    return step


def measure(steps: dict[str, Step], threads: int, turns: int) -> dict[str, list[float]]:
    """Milliseconds of a step by who makes it, one value a turn."""
    torch.set_num_threads(threads)
    clock = time.process_time if threads == 1 else time.perf_counter
    found: dict[str, list[float]] = {name: [] for name in steps}
    for turn in range(-1, turns):  # one turn to warm up
        for name, step in steps.items():
            start = clock()
            for i in range(5):
                step(5 * turn + i + 5)
            if turn >= 0:
                found[name].append((clock() - start) / 5 * 1e3)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=20)
    parser.add_argument("--threads", type=int, nargs="+", default=[1])
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    args = parser.parse_args()
    torch.manual_seed(0)
    batches = sampler()
    ours = by_the_loop(batches)
    with FlopCounterMode(display=False) as counter:
        ours(0)
    flop = float(counter.get_total_flops())
    steps: dict[str, Step] = {"ours": ours, "product": products(flop)}
    if importlib.util.find_spec("transformers"):
        steps["transformers"] = by_transformers(batches)
    else:
        print("transformers is not installed, its row is left out: pip install transformers")
    result: dict[str, Any] = {"gflop": round(flop / 1e9, 2), "turns": args.turns}
    for threads in args.threads:
        found = measure(steps, threads, args.turns)
        row: dict[str, Any] = {
            f"{name}_ms": round(statistics.median(ms), 1) for name, ms in found.items()
        }
        for name in found.keys() - {"ours"}:
            pairs = zip(found["ours"], found[name], strict=True)
            row[f"over_{name}"] = round(statistics.median(a / b for a, b in pairs), 3)
        row["hours_of_100k"] = round(row["ours_ms"] * 1e5 / 3.6e6, 2)
        row["gflop_per_s"] = round(flop / 1e6 / row["ours_ms"], 1)
        row["gflop_per_s_of_product"] = round(flop / 1e6 / row["product_ms"], 1)
        result[f"threads_{threads}"] = row
        print(threads, json.dumps(row), flush=True)
    print(json.dumps(result, indent=1))
    if args.save:
        save("tipl_train", result)


if __name__ == "__main__":
    main()
