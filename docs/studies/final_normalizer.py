"""How wrong is J(pi_t) when it is measured with the final normaliser instead of that of t?

python docs/studies/final_normalizer.py DATASET [DATASET ...]    # measure, then render
python docs/studies/final_normalizer.py                          # render what was measured

Writes final_normalizer.json, draws final_normalizer.svg, and writes the table into
final_normalizer.md, all beside this file.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.progress import track
from study import Study, parser

import weighttraj as wt
from weighttraj.policies import Evaluator, env_of, load_policies

PICTURE = Path(__file__).with_suffix(".svg")
MODES = {"deterministic": True, "sampled": False}
STAGES = ((0.0, 0.02), (0.02, 0.1), (0.1, 0.3), (0.3, 1.0))
"""Parts of the recorded training, as shares of its environment steps."""


def measure(path: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Returns of the first run's snapshots with either normaliser, the same episodes for both."""
    run = wt.open(path).runs[0]
    rows = sorted({*range(min(args.first, len(run))), *range(0, len(run), args.every)})
    returns: dict[str, Any] = {mode: {"own": [], "final": [], "error": []} for mode in MODES}
    with Evaluator(env_of(run), episodes=args.episodes) as evaluator:
        for start in track(range(0, len(rows), 32), path.name):
            part = rows[start : start + 32]
            for mode, deterministic in MODES.items():
                own, final = (
                    evaluator(
                        load_policies(run, part, final_normalizer=last), deterministic=deterministic
                    ).returns
                    for last in (False, True)
                )
                error = (final - own).std(1, ddof=1) / np.sqrt(args.episodes)
                for name, values in (("own", own.mean(1)), ("final", final.mean(1))):
                    returns[mode][name] += values.round(4).tolist()
                returns[mode]["error"] += error.round(4).tolist()
    return {
        "env": env_of(run).id,
        "run": run.id,
        "param": run.layout.size,
        "episodes": args.episodes,
        "t": rows,
        "num_timesteps": run.num_timesteps[rows].tolist(),
        "returns": returns,
    }


@dataclass(frozen=True, kw_only=True)
class _Part:
    """Returns in one part of one training, by one kind of actions."""

    env: str
    mode: str
    stage: str
    snapshots: int
    own: float
    final: float
    gap: float
    """Mean over snapshots of the difference without its sign."""
    apart: float
    """Share of snapshots whose difference is above two standard errors."""


def parts(result: dict[str, Any]) -> list[_Part]:
    """The parts of one run."""
    share = np.array(result["num_timesteps"]) / result["num_timesteps"][-1]
    found = []
    for mode, values in result["returns"].items():
        own, final, error = (np.array(values[name]) for name in ("own", "final", "error"))
        for low, high in STAGES:
            inside = (share >= low) & ((share < high) | (high == 1.0))
            gap = np.abs(final - own)[inside]
            part = _Part(
                env=result["env"],
                mode=mode,
                stage=f"{low:.0%} to {high:.0%}",
                snapshots=int(inside.sum()),
                own=float(own[inside].mean()),
                final=float(final[inside].mean()),
                gap=float(gap.mean()),
                apart=float((gap > np.maximum(2 * error[inside], 1e-9)).mean()),
            )
            found.append(part)
    return found


def table(results: dict[str, Any]) -> str:
    """How far the two returns lie apart, by part of the training."""
    lines = []
    for result in results.values():
        most = max(parts(result), key=lambda part: part.gap)
        lines.append(
            f"Furthest apart, {most.env}: {most.stage} of the training, {most.mode} actions, mean "
            f"return {most.own:.0f} with the snapshot's own normaliser, {most.final:.0f} with the "
            "final one.\n"
        )
    lines += [
        "| environment | actions | part of the training | snapshots | J, own normaliser | "
        "J, final normaliser | mean difference | apart by over 2 standard errors |",
        "|---|---|---|---:|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {p.env} | {p.mode} | {p.stage} | {p.snapshots} | {p.own:.1f} | {p.final:.1f} | "
        f"{p.gap:.1f} | {p.apart:.0%} |"
        for result in results.values()
        for p in parts(result)
    ]
    told = [
        f"{r['env']}: one run, {r['param']:,} parameters, {r['num_timesteps'][-1]:,} environment "
        f"steps, {r['episodes']} episodes for each return, the same ones for both normalisers."
        for r in results.values()
    ]
    return "\n".join([*lines, "", *told])


def draw(results: dict[str, Any]) -> None:
    """Both returns against environment steps."""
    with rc_context({"svg.hashsalt": "normalizer", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(figsize=(9, 3.2 * len(results)), layout="constrained")
        grid = figure.subplots(len(results), 2, squeeze=False)
        for axes, result in zip(grid, results.values(), strict=True):
            steps = np.array(result["num_timesteps"]) / 1000
            for ax, (mode, found) in zip(axes, result["returns"].items(), strict=True):
                ax.plot(steps, found["own"], color="#1f77b4", label="normaliser of t")
                ax.plot(steps, found["final"], color="#d62728", lw=1, label="final normaliser")
                ax.set(
                    title=f"{result['env']}, {mode}", ylabel="J", xlabel="1000 environment steps"
                )
                ax.set_xscale("symlog", linthresh=10)
        grid[0][0].legend(frameon=False)
        figure.savefig(PICTURE, metadata={"Date": None})


STUDY = Study(__file__, table)


def main() -> None:
    """Measure, if data sets are given, and render."""
    options = parser(__doc__)
    options.add_argument("datasets", type=Path, nargs="*")
    options.add_argument("--episodes", type=int, default=20)
    options.add_argument("--every", type=int, default=20)
    options.add_argument("--first", type=int, default=100, help="all of the first so many too")
    args = options.parse_args()
    if args.datasets:
        results = {path.name: measure(path, args) for path in args.datasets}
        STUDY.keep(results)
    draw(STUDY.measured())
    STUDY.render()


if __name__ == "__main__":
    main()
