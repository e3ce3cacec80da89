"""What it costs to read the runs that a model is trained on: TIPL's 30 runs, the gate's examples.

python tests/benchmarks/bench_prepare.py --beside PATH    # another, older tree of this package

Each measurement is a process of its own. Prints CPU seconds and peak memory of both trees and
their ratio; with an empty cache of decoded runs, and with a filled one.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

DATA = "inverted-pendulum-v4-ppo-v1"
HERE = Path(__file__).parents[2]
TIPL = f"""
try:
    from tipl.models.tipl.data import prepare
except ImportError:
    from tipl.prepare import prepare
prepare("{DATA}", rank=32, window=20)
"""
GATE = f"""
import weighttraj as wt
groups, starts = [wt.open("{DATA}").split("train").runs[:RUNS]], 200
try:
    from tipl.models.gate.data import GateExamples, examples_of
    from tipl.models.gate.network import GateConfig
    from tipl.training.starts import gather
    sizes = GateConfig(phases=5)
    found = gather(groups, lambda run, rng: examples_of(run, sizes, starts, rng), seed=0)
    GateExamples.of(found)
except ImportError:
    from tipl.baselines.horizons import HORIZONS
    from tipl.gate.examples import gather
    from tipl.models.gate import GateConfig
    gather(groups, GateConfig(horizons=HORIZONS, phases=5), starts=starts, seed=0)
"""


def measure(code: str, tree: Path, cache: Path) -> tuple[float, float]:
    """CPU seconds, and peak memory in MB, of some code with the package of a tree."""
    told = "import resource\n" + code
    told += "\nu = resource.getrusage(resource.RUSAGE_SELF)\n"
    told += "print(u.ru_utime + u.ru_stime, u.ru_maxrss / 1024)"
    env = {**os.environ, "PYTHONPATH": str(tree), "WEIGHTTRAJ_CACHE": str(cache)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", told],
        capture_output=True,
        text=True,
        check=True,
        env=env,
        cwd=tree,
    )
    seconds, memory = done.stdout.split()[-2:]
    return float(seconds), float(memory)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--beside", type=Path, default=HERE, help="another tree of the package")
    parser.add_argument("--turns", type=int, default=1, help="measurements of each, in turn")
    parser.add_argument("--runs", type=int, default=30, help="runs of the gate")
    args = parser.parse_args()
    trees = {"this": HERE, "other": args.beside.resolve()}
    with tempfile.TemporaryDirectory() as folder:
        for what, code in (("TIPL", TIPL), ("gate", GATE.replace("RUNS", str(args.runs)))):
            for state in ("empty cache", "filled cache"):
                best: dict[str, tuple[float, float]] = {}
                for turn in range(args.turns):
                    for name, tree in trees.items():
                        cache = Path(folder, name, what + str(turn if state[0] == "e" else 0))
                        found = measure(code, tree, cache)
                        best[name] = min(best.get(name, found), found)
                seconds, memory = (best["this"][i] / best["other"][i] for i in (0, 1))
                print(
                    f"{what}, {state}: {best['this'][0]:.1f} s, {best['this'][1]:.0f} MB; other "
                    f"{best['other'][0]:.1f} s, {best['other'][1]:.0f} MB; "
                    f"ratio {seconds:.2f} in time, {memory:.2f} in memory",
                    flush=True,
                )


if __name__ == "__main__":
    main()
