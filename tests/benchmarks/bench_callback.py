"""What does recording cost the training? CPU seconds of `learn()` with the callback and without.

python tests/benchmarks/bench_callback.py

HalfCheetah, 256x256, a snapshot every 64 gradient steps. Two figures: trainings with and without in
turns, each in a fresh process; and, free of the machine's noise, the CPU seconds inside the
callback itself beside those of the whole training it was part of.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from results import save

HOOKS = ("_on_training_start", "_on_rollout_end", "_on_gradient_step", "_on_training_end")


def train(iterations: int, record: bool) -> dict[str, float]:
    import torch

    from weighttraj.collect import PPOConfig, WeightTrajectoryCallback, make_ppo

    torch.set_num_threads(1)
    inside = 0.0

    def timed(function: Any) -> Any:
        def wrapper(*arguments: Any) -> Any:
            nonlocal inside
            start = time.process_time()
            try:
                return function(*arguments)
            finally:
                inside += time.process_time() - start

        return wrapper

    config = PPOConfig(
        env_id="HalfCheetah-v4", net_arch=(256, 256), total_timesteps=2048 * iterations
    )
    model = make_ppo(config, seed=0)
    with tempfile.TemporaryDirectory(dir="data") as folder:
        callback = WeightTrajectoryCallback(Path(folder) / "run.zarr") if record else None
        for name in HOOKS if callback else ():
            setattr(callback, name, timed(getattr(callback, name)))
        start = time.process_time()
        model.learn(config.total_timesteps, callback=callback)
        total = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"cpu_s": total, "inside_s": inside, "peak_rss_mib": peak}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=14)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    parser.add_argument("--one", choices=["with", "without"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(train(args.iterations, args.one == "with")))
        return
    runs: dict[str, list[dict[str, float]]] = {"with": [], "without": []}
    for _ in range(args.turns):
        for kind, results in runs.items():
            command = [sys.executable, "-W", "ignore", __file__, "--one", kind]
            command += ["--iterations", str(args.iterations)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            results.append(json.loads(done.stdout.splitlines()[-1]))
    pairs = list(zip(runs["with"], runs["without"], strict=True))
    shares = [r["cpu_s"] / (r["cpu_s"] - r["inside_s"]) for r in runs["with"]]
    extra = [a["peak_rss_mib"] - b["peak_rss_mib"] for a, b in pairs]
    result = {
        "iterations": args.iterations,
        "ratio_in_turns": [round(a["cpu_s"] / b["cpu_s"], 4) for a, b in pairs],
        "ratio_inside": round(statistics.median(shares), 4),
        "extra_peak_mib": round(statistics.median(extra), 1),
        "block_mib": round(64 * 71_948 * 4 / 2**20, 1),
    }
    print(json.dumps(result))
    if args.save:
        save("callback", result)


if __name__ == "__main__":
    main()
