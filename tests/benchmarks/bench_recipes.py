"""Does every recipe for a population work? Each is collected at a short length, all its seeds.

python -W ignore tests/benchmarks/bench_recipes.py [ID ...]

Without ids: all of datasets/*/recipe.toml that a population trains, but for the two whose scale is
the paper's. The learning rate is annealed over the short length. For each: environment steps a CPU
second from the seeds to the packed runs, size of a packed run, returns of the first and the last
training episodes, what `verify` and `lint` find; and from that, linear in steps and in snapshots,
what the whole recipe will take.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from results import save

import weighttraj as wt
from weighttraj.collect import Recipe, collect, read_recipe
from weighttraj.collect.rollouts import Environments

RECIPES = Path(__file__).parents[2] / "datasets"
PAPERS = ("half-cheetah-v4-ppo-v1", "inverted-pendulum-v4-ppo-v1")
EPISODES = 10

Returns = dict[tuple[Environments, int], list[float]]


@contextlib.contextmanager
def training_returns() -> Iterator[Returns]:
    """Returns of all training episodes of each learner; a run keeps means of the last 100 only."""
    found: Returns = defaultdict(list)
    before: Any = Environments._restart

    def restart(environments: Environments, learners: np.ndarray) -> None:
        for learner in learners.tolist():
            found[environments, learner].append(float(environments._return[learner]))
        before(environments, learners)

    setattr(Environments, "_restart", restart)  # noqa: B010
    try:
        yield found
    finally:
        setattr(Environments, "_restart", before)  # noqa: B010


def measure(whole: Recipe, iterations: int, folder: Path) -> dict[str, Any]:
    """All figures of one recipe."""
    config = replace(whole.ppo, total_timesteps=iterations * whole.ppo.n_steps)
    recipe = replace(whole, ppo=config)
    start = time.process_time()
    with training_returns() as returns:
        dataset = collect(recipe, folder)
    cpu_s = time.process_time() - start
    size = sum(file.stat().st_size for file in folder.glob("runs/*.zarr.zip"))
    problems = wt.verify(folder, deep=True)
    if problems:
        raise SystemExit("\n".join([f"{whole.id} is not whole:", *problems]))
    runs = dataset.runs
    assert {len(run) for run in runs} == {recipe.n_snapshots}
    steps_per_cpu_s = len(runs) * config.total_timesteps / cpu_s
    whole_steps = len(runs) * whole.ppo.n_iterations * whole.ppo.n_steps
    return {
        "env": config.env_id,
        "parameters": runs[0].layout.size,
        "seeds": len(runs),
        "steps": config.total_timesteps,
        "steps_per_cpu_s": round(steps_per_cpu_s),
        "mb_per_run": round(size / len(runs) / 1e6, 3),
        "first_returns": mean_return(returns, slice(EPISODES)),
        "last_returns": mean_return(returns, slice(-EPISODES, None)),
        "findings": Counter(f"{found.check}: {found.message}" for found in wt.lint(folder)),
        "whole_cpu_hours": round(whole_steps / steps_per_cpu_s / 3600, 2),
        "whole_gb": round(size * whole.n_snapshots / recipe.n_snapshots / 1e9, 3),
    }


def mean_return(returns: Returns, episodes: slice) -> float:
    """Mean over seeds of the mean return of some of a seed's episodes."""
    return round(float(np.mean([np.mean(each[episodes]) for each in returns.values()])), 1)


def recipe_files() -> list[Path]:
    return sorted(RECIPES.glob("*/recipe.toml"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ids", nargs="*", help="folders in datasets/")
    parser.add_argument("--iterations", type=int, default=20, help="rollouts of each seed")
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    args = parser.parse_args()
    ids = args.ids or [file.parent.name for file in recipe_files()]
    recipes = {name: read_recipe(RECIPES / name / "recipe.toml") for name in ids}
    cases = {}
    for name, recipe in recipes.items():
        if recipe.collect.collector == "population" and (args.ids or name not in PAPERS):
            with tempfile.TemporaryDirectory() as folder:
                cases[name] = measure(recipe, args.iterations, Path(folder) / name)
            print(name, json.dumps(cases[name], indent=1), flush=True)
    if args.save:
        save("recipes", {"iterations": args.iterations, "episodes": EPISODES, "cases": cases})


if __name__ == "__main__":
    main()
