"""What does a data set at the paper's largest scale cost? Collects HalfCheetah runs, two at a time.

python -W ignore tests/benchmarks/bench_half_cheetah.py 0 1 30 40 2 3 4 41

Each pair of seeds is trained by one population in one thread, half an hour to an hour; the same
command goes on where it stopped, and several may run at the same time on other seeds. Then

python -W ignore tests/benchmarks/bench_half_cheetah.py --page

writes learning curves and cost into datasets/half-cheetah-v4-ppo-v1/.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from results import save
from rich.console import Console

import weighttraj as wt
from weighttraj.collect import collect, read_recipe
from weighttraj.text import between

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "datasets/half-cheetah-v4-ppo-v1"
DATA = ROOT / "data/half-cheetah-v4-ppo-v1"
COSTS = ROOT / "data/half-cheetah-v4-ppo-v1-costs"
START = "<!-- measured: rewrite with `python tests/benchmarks/bench_half_cheetah.py --page` -->"
END = "<!-- end of what was measured -->"
POINTS = 41
"""Of a learning curve: every 50,000 environment steps."""


def collect_pair(seeds: Sequence[int]) -> None:
    """Collect two runs, and note what they took if they were made from beginning to end."""
    recipe = read_recipe(FOLDER / "recipe.toml")
    start, start_wall = time.process_time(), time.monotonic()
    collect(recipe, DATA, seeds=list(seeds), console=Console())
    cpu_s, wall_s = time.process_time() - start, time.monotonic() - start_wall
    note = COSTS / f"{'-'.join(map(str, seeds))}.json"
    if not note.exists():  # else they were there, and nothing was done
        COSTS.mkdir(parents=True, exist_ok=True)
        note.write_text(json.dumps({"runs": len(seeds), "cpu_s": cpu_s, "wall_s": wall_s}))


def finished() -> list[wt.Run]:
    return [run for run in wt.open(DATA) if run.info.status == "complete"]


def measured(runs: Sequence[wt.Run]) -> dict[str, Any]:
    """Figures of the runs that are complete."""
    notes = [json.loads(note.read_text()) for note in sorted(COSTS.glob("*.json"))]
    return {
        "seeds": [run.info.seed for run in runs],
        "snapshots": len(runs[0]),
        "parameters": runs[0].layout.size,
        "mb_per_run": round(np.mean([run.path.stat().st_size for run in runs]) / 1e6, 1),
        "timed_runs": sum(note["runs"] for note in notes),
        "cpu_h_per_run": round(
            sum(note["cpu_s"] for note in notes) / sum(note["runs"] for note in notes) / 3600, 3
        ),
        "final": {f"{run.info.seed}": round(float(curve(run)[-1]), 1) for run in runs},
    }


def curve(run: wt.Run) -> np.ndarray:
    """Mean return of the last training episodes at evenly spaced snapshots, (point,)."""
    rows = np.linspace(0, len(run) - 1, POINTS).round().astype(int)
    return np.asarray(run["train/ep_rew_mean"][:][rows])


def write_curves(runs: Sequence[wt.Run], path: Path) -> None:
    """One line a point: what became of each run."""
    with path.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["seed", "split", "num_timesteps", "train_return"])
        for run in runs:
            rows = np.linspace(0, len(run) - 1, POINTS).round().astype(int)
            steps = run["index/num_timesteps"][:][rows]
            for step, value in zip(steps.tolist(), curve(run).tolist(), strict=True):
                if np.isfinite(value):
                    table.writerow([run.info.seed, run.split, step, round(value, 1)])


def render(figures: dict[str, Any]) -> str:
    """What it cost, and what the runs came to."""
    hours, size = figures["cpu_h_per_run"], figures["mb_per_run"] / 1000
    lines = [
        "| runs | CPU hours | GB |",
        "|---:|---:|---:|",
        *(f"| {n} | {n * hours:.1f} | {n * size:.1f} |" for n in (1, 8, 50)),
        "",
        f"From the {len(figures['seeds'])} runs of {figures['snapshots']:,} snapshots of "
        f"{figures['parameters']:,} parameters that were collected; CPU time is the mean over "
        f"{figures['timed_runs']} of them, two to a process of one thread.",
        "",
        "| seed | mean return of the last training episodes |",
        "|---:|---:|",
        *(f"| {seed} | {value:,.1f} |" for seed, value in figures["final"].items()),
    ]
    return "\n".join(lines)


def insert(page: str, figures: dict[str, Any]) -> str:
    """The page with these figures."""
    return between(page, START, END, render(figures))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("seeds", nargs="*", type=int, help="collected in pairs")
    parser.add_argument("--page", action="store_true", help="write curves and cost of what is done")
    args = parser.parse_args()
    for i in range(0, len(args.seeds), 2):
        collect_pair(args.seeds[i : i + 2])
    if args.page:
        runs = finished()
        figures = measured(runs)
        save("half_cheetah", figures)
        write_curves(runs, FOLDER / "curves.csv")
        page = FOLDER / "README.md"
        page.write_text(insert(page.read_text(), figures))


if __name__ == "__main__":
    main()
