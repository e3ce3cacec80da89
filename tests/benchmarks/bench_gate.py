"""How long is one forecast of tipl-gate for a large policy?

python tests/benchmarks/bench_gate.py

HalfCheetah's policy of 256x256 units, nine horizons, one thread, CPU time. Four take turns: one
more snapshot in the history; what the network sees of tensors; what it sees of parameters, and the
network; and the largest matrix product of the network alone, as often as makes the network's
floating point operations: the limit of this machine. What is in the weights does not matter for
the speed. `--save` keeps the figures.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from results import save
from torch.utils.flop_counter import FlopCounterMode

import tipl
import weighttraj as wt
from tipl.models.gate import Gate
from tipl.models.gate.features import features
from tipl.models.gate.history import History
from tipl.structure import Clock, Structure

MODEL = "tipl-gate-half-cheetah-v4"
FORECAST = ("history", "features", "network")
HORIZONS = (1, 2, 3, 5, 10, 20, 50, 100, 200)
LAYOUT = wt.ParamLayout.of(
    {
        "log_std": ((6,), "log_std", ("action",)),
        "0.weight": ((256, 17), "weight", ("hidden_0", "observation")),
        "0.bias": ((256,), "bias", ("hidden_0",)),
        "1.weight": ((256, 256), "weight", ("hidden_1", "hidden_0")),
        "1.bias": ((256,), "bias", ("hidden_1",)),
        "2.weight": ((6, 256), "weight", ("action", "hidden_1")),
        "2.bias": ((6,), "bias", ("action",)),
    }
)


def parts() -> tuple[dict[str, Callable[[], object]], float]:
    """What a forecast consists of, and the network's floating point operations."""
    gate = tipl.load(MODEL)
    assert isinstance(gate, Gate)
    sizes = gate.config.network
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.normal(0, 1e-3, (60, LAYOUT.size)), 0).astype(np.float32)
    history = History(path[0], sizes.lags, sizes.betas)
    for row in path[1:]:
        history.push(row)
    structure = Structure.of(LAYOUT)
    clock = Clock(phase=np.arange(10_000) % sizes.phases, rate=np.ones(10_000))
    seen = features(history, structure, clock, sizes)
    places = [sizes.horizons.index(h) for h in HORIZONS]

    def network() -> object:
        return gate.displacements(seen, structure, places)

    with FlopCounterMode(display=False) as counter:
        network()
    flop = float(counter.get_total_flops())
    x, w = torch.randn(4096, sizes.width), torch.randn(sizes.width, sizes.width)
    out = torch.empty(4096, sizes.width)
    times = round(flop / (2 * x.numel() * sizes.width))

    def products() -> None:
        for _ in range(times):
            torch.mm(x, w, out=out)

    return {
        "history": lambda: history.push(path[3]),
        "features": lambda: features(history, structure, clock, sizes),
        "network": network,
        "product": products,
    }, flop


def measure(turns: int) -> dict[str, Any]:
    """Milliseconds of each part, and of one forecast, which is the first three: medians."""
    torch.set_num_threads(1)
    with torch.no_grad():
        steps, flop = parts()
        found: dict[str, list[float]] = {name: [] for name in steps}
        for turn in range(-1, turns):  # one turn to warm up
            for name, step in steps.items():
                start = time.process_time()
                step()
                if turn >= 0:
                    found[name].append((time.process_time() - start) * 1e3)
    one = [sum(row) for row in zip(*(found[name] for name in FORECAST), strict=True)]
    return {
        "parameters": LAYOUT.size,
        "horizons": len(HORIZONS),
        "gflop": flop / 1e9,
        "ms": {name: statistics.median(values) for name, values in found.items()},
        "forecast_ms": statistics.median(one),
        "quartiles_ms": [float(q) for q in np.quantile(one, (0.25, 0.75))],
        "network_over_product": statistics.median(
            a / b for a, b in zip(found["network"], found["product"], strict=True)
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=40)
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    args = parser.parse_args()
    result = measure(args.turns)
    print(json.dumps(result, indent=1))
    if args.save:
        save("gate", result)


if __name__ == "__main__":
    main()
