"""Trains with and without the collector, and says whether weights and random states are equal.

A script of its own: the type checker that runs under the tests draws random numbers itself.
"""

import json
import sys
from pathlib import Path

import torch

from tests.small import CONFIGS, learn, random_states
from weighttraj.collect import WeightTrajectoryCallback


def outcome(name: str, callback: WeightTrajectoryCallback | None) -> tuple[list[list[float]], str]:
    model = learn(CONFIGS[name], callback)
    weights = [p.detach().reshape(-1).tolist() for p in model.policy.parameters()]
    return weights, repr(random_states(model))


if __name__ == "__main__":
    torch.set_num_threads(1)
    result = {}
    for name in CONFIGS:
        watched = outcome(name, WeightTrajectoryCallback(Path(sys.argv[1]) / name, every=3))
        alone = outcome(name, None)
        result[name] = {"weights": watched[0] == alone[0], "random": watched[1] == alone[1]}
    print(json.dumps(result))
