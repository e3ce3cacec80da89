"""How much faster does a population collect than SB3? Environment steps per CPU second.

python -W ignore tests/benchmarks/bench_population.py

Both are recorded as `weighttraj collect` records them, in one process and one thread, in turns. SB3
trains one seed, the population several; a first iteration of each warms up and is not counted.

python -W ignore tests/benchmarks/bench_population.py --fidelity

How far is a population's run from SB3's of the same seed, at full settings? Beside it, how far is
SB3's own run after one weight was moved by one unit in the last place: chaotic physics magnifies
any difference, and HalfCheetah is chaotic within a rollout.

python -W ignore tests/benchmarks/bench_population.py --processes

How much sooner is a data set there when two processes collect it instead of one? Wall time of
`collect` from the recipe to the sealed data set, start-up included, in turns.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import save
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import weighttraj as wt
from weighttraj.collect import PPOConfig, Recipe, WeightTrajectoryCallback, collect, make_ppo
from weighttraj.collect.learners import Learners
from weighttraj.collect.population import Population, origins_of
from weighttraj.collect.recorder import Recorder
from weighttraj.collect.rollouts import Environments
from weighttraj.collect.settings import Collect, Seeds, Store
from weighttraj.collect.tasks import open_recorder
from weighttraj.policies.simulators import Physics

PENDULUM = PPOConfig(total_timesteps=800_000)
CHEETAH = PPOConfig(env_id="HalfCheetah-v4", net_arch=(256, 256), total_timesteps=1_000_000)
CASES = {"InvertedPendulum-v4, 8x8": (PENDULUM, 32), "HalfCheetah-v4, 256x256": (CHEETAH, 8)}


class Clock(BaseCallback):
    """CPU seconds of each iteration but the first; ends the training after so many."""

    def __init__(self, iterations: int) -> None:
        super().__init__()
        self._iterations, self._left = iterations, iterations + 1
        self._start = 0.0
        self.seconds = 0.0

    def _on_step(self) -> bool:
        return self._left >= 0

    def _on_rollout_start(self) -> None:
        self._left -= 1
        if self._left == self._iterations - 1:
            self._start = time.process_time()
        elif self._left < 0:
            self.seconds = time.process_time() - self._start


def by_sb3(config: PPOConfig, iterations: int, folder: Path) -> float:
    """CPU seconds of an iteration of one seed."""
    clock = Clock(iterations)
    with WeightTrajectoryCallback(folder / "sb3.zarr") as callback:
        make_ppo(config, seed=0).learn(config.total_timesteps, callback=[callback, clock])
    return clock.seconds / iterations


def by_population(config: PPOConfig, iterations: int, folder: Path, learners: int) -> float:
    """CPU seconds of an iteration of one seed, among so many."""
    origins = origins_of(config, range(learners))
    with contextlib.ExitStack() as stack:
        population = stack.enter_context(contextlib.closing(Population(config, origins)))
        recorders: list[Recorder] = []
        for i, origin in enumerate(origins):
            path = folder / f"{i}.zarr"
            recorders.append(open_recorder(population, i, origin, path, Store()))
            stack.callback(recorders[-1].close)
        population.train(recorders, lambda: population.num_timesteps >= config.n_steps)
        start, stop = time.process_time(), (1 + iterations) * config.n_steps
        population.train(recorders, lambda: population.num_timesteps >= stop)
        seconds = time.process_time() - start
    return seconds / iterations / learners


def shares(config: PPOConfig, learners: int) -> dict[str, float]:
    """What an iteration spends its CPU time on; measuring costs a little too."""
    spent: dict[str, float] = {}
    places: list[tuple[Any, str, str]] = [
        (Physics, "step", "physics"),
        (Environments, "_restart", "resets"),
        (Population, "_roll_out", "rollout"),
        (torch, "bmm", "matrix products"),
        (torch, "baddbmm", "matrix products"),
        (torch.optim.Adam, "step", "Adam"),
        (Learners, "update", "update"),
    ]
    origins = origins_of(config, range(learners))
    with contextlib.ExitStack() as stack, contextlib.closing(Population(config, origins)) as many:
        many.train([], lambda: many.num_timesteps >= config.n_steps)
        for owner, name, label in places:
            before = getattr(owner, name)
            stack.callback(setattr, owner, name, before)
            setattr(owner, name, timed(before, label, spent))
        start = time.process_time()
        many.train([], lambda: many.num_timesteps >= 2 * config.n_steps)
        total = time.process_time() - start
    parts = ("physics", "resets", "matrix products", "Adam")
    spent["rest: elementwise, normalisers, Python"] = total - sum(spent[part] for part in parts)
    return {label: round(seconds / total, 3) for label, seconds in spent.items()}


def timed(function: Callable[..., Any], label: str, spent: dict[str, float]) -> Any:
    def wrapper(*arguments: Any, **options: Any) -> Any:
        start = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            spent[label] = spent.get(label, 0.0) + time.process_time() - start

    return wrapper


def speed(iterations: int, turns: int) -> dict[str, Any]:
    cases = {}
    for name, (config, learners) in CASES.items():
        sb3, population = [], []
        for _ in range(turns):
            with tempfile.TemporaryDirectory() as folder:
                sb3.append(by_sb3(config, iterations, Path(folder)))
                population.append(by_population(config, iterations, Path(folder), learners))
        theirs, ours = statistics.median(sb3), statistics.median(population)
        cases[name] = {
            "learners": learners,
            "sb3_steps_per_cpu_s": round(config.n_steps / theirs),
            "population_steps_per_cpu_s": round(config.n_steps / ours),
            "times_faster": round(theirs / ours, 1),
            "shares": shares(config, learners),
        }
        print_speed(name, cases[name])
    return cases


def print_speed(name: str, case: dict[str, Any]) -> None:
    print(
        f"{name}: SB3 {case['sb3_steps_per_cpu_s']:,} steps a CPU second, a population of "
        f"{case['learners']} {case['population_steps_per_cpu_s']:,}: {case['times_faster']}x"
    )
    rollout, update = case["shares"]["rollout"], case["shares"]["update"]
    print(f"  its CPU time: rollout {rollout:.0%}, update {update:.0%}; or, cut another way:")
    parts = {k: v for k, v in case["shares"].items() if k not in ("rollout", "update")}
    print("  " + ", ".join(f"{label} {share:.0%}" for label, share in parts.items()))


def fidelity(iterations: int) -> dict[str, Any]:
    """Distance of the weights after each iteration, relative to what training has moved them."""
    cases = {}
    for name, (whole, _) in CASES.items():
        length = iterations * whole.n_steps
        config = PPOConfig(env_id=whole.env_id, net_arch=whole.net_arch, total_timesteps=length)
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder) / f"{kind}.zarr" for kind in ("ours", "theirs", "nudged")]
            origins = origins_of(config, [0, 1])
            with contextlib.closing(Population(config, origins)) as population:
                recorder = open_recorder(population, 0, origins[0], paths[0], Store())
                population.train([recorder])
            for path in paths[1:]:
                model = make_ppo(config, seed=0)
                if path is paths[2]:
                    nudge(model)
                model.learn(length, callback=WeightTrajectoryCallback(path))
            ours, theirs, nudged = (wt.open_run(path).weights[:] for path in paths)
        rows = range(5, len(theirs), 5)  # the end of each iteration
        cases[name] = {
            "population": [distance(ours[t], theirs[t], theirs[0]) for t in rows],
            "sb3, one weight nudged": [distance(nudged[t], theirs[t], theirs[0]) for t in rows],
        }
        print(name, json.dumps(cases[name]))
    return cases


def processes(iterations: int, turns: int) -> dict[str, Any]:
    """Wall seconds of one process and of two."""
    ppo = replace(PENDULUM, total_timesteps=iterations * PENDULUM.n_steps)
    recipe = Recipe(
        id="processes",
        ppo=ppo,
        seeds=Seeds(train="0:32"),
        collect=Collect(collector="population", population=16),
    )
    wall: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(turns):
        for workers, seconds in wall.items():
            with tempfile.TemporaryDirectory() as folder:
                start = time.monotonic()
                collect(recipe, Path(folder) / "dataset", workers=workers)
                seconds.append(round(time.monotonic() - start, 1))
                print(f"{workers} processes: {seconds[-1]} s", flush=True)
    ratios = [round(one / two, 2) for one, two in zip(wall[1], wall[2], strict=True)]
    return {
        "case": "InvertedPendulum-v4, 8x8",
        "runs": 32,
        "iterations": iterations,
        "wall_s": {str(workers): seconds for workers, seconds in wall.items()},
        "ratios": ratios,
        "times_faster": round(statistics.median(ratios), 2),
    }


def nudge(model: PPO) -> None:
    with torch.no_grad():
        weight = model.policy.action_net.weight
        weight[0, 0] = torch.nextafter(weight[0, 0], torch.tensor(np.inf))


def distance(weights: np.ndarray, other: np.ndarray, start: np.ndarray) -> float:
    ratio = np.linalg.norm(weights - other) / np.linalg.norm(other - start)
    return float(f"{ratio:.1e}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=2)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--fidelity", action="store_true", help="measure that instead of speed")
    parser.add_argument("--processes", action="store_true", help="measure these instead")
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.processes:
        name, result = "processes", processes(max(30, args.iterations), args.turns)
    elif args.fidelity:
        name, result = "population_fidelity", {"cases": fidelity(max(3, args.iterations))}
    else:
        name, result = "population", {"cases": speed(args.iterations, args.turns)}
    if args.save:
        save(name, result)


if __name__ == "__main__":
    main()
