"""Does the PPO set-up learn? Mean return of the last 10 episodes after a short training.

python tests/benchmarks/bench_ppo_learns.py --timesteps 100000 --seeds 3
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor

import numpy as np


def train(timesteps: int, seed: int) -> float:
    import torch

    from weighttraj.collect import PPOConfig, make_ppo

    torch.set_num_threads(1)
    config = PPOConfig(total_timesteps=timesteps)
    model = make_ppo(config, seed=seed)
    model.learn(config.n_iterations * config.n_steps)
    return float(np.mean([episode["r"] for episode in list(model.ep_info_buffer)[-10:]]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--timesteps", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    with ProcessPoolExecutor(args.workers) as pool:
        returns = list(pool.map(train, [args.timesteps] * args.seeds, range(args.seeds)))
    print(json.dumps({"timesteps": args.timesteps, "return_of_last_10_episodes": returns}))


if __name__ == "__main__":
    main()
