"""What does the Temporal SVD of a run cost that is read a piece at a time?

python tests/benchmarks/bench_svd.py [--real RUN]

A run of the length and width of the paper's HalfCheetah is written once: a synthetic one, a random
walk with annealed steps, of which half goes in a few slow directions. Its basis is fitted by
``TemporalSVD.fit_streamed`` in a process of its own, which tells CPU seconds (how many of them
decode the run), passes over the run, and the peak of its memory above what imports take. Singular
values are compared with those of the whole matrix, from its Gram matrix in float64; and those of a
real, shorter run as well.

``numpy.linalg.svd`` of the whole matrix would take 20 minutes and 6 GB. It is measured on the first
snapshots, in float32 as they are stored, which suits it best, and on half of them (twice: the
smaller counts). Through both goes ``a n + b n^2``, which is extrapolated to all n. What grows with
``n^3`` is left out, to the good of numpy.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from results import save

import weighttraj as wt
from tipl import TemporalSVD

SNAPSHOTS, PARAMETERS = 4881, 71_948
SHARE = 32
"""Singular values that are compared."""


def synthetic(path: Path) -> wt.Run:
    """The run at the path, written if there is none."""
    if not path.exists():
        rng = np.random.default_rng(0)
        layout = wt.ParamLayout.of({"w": ((PARAMETERS,), "other", ("fixed",))})
        slow = rng.standard_normal((16, PARAMETERS), np.float32)
        phases = 2 * np.pi * rng.random(16)
        weights = rng.standard_normal(PARAMETERS, np.float32) / 16
        draft = path.with_name(f".{path.name}")
        with wt.RunWriter(draft, wt.RunInfo(run_id="synthetic", layout=layout)) as writer:
            for t in range(SNAPSHOTS):
                writer.append(weights, num_timesteps=t)
                pull = np.cos(phases + np.arange(1, 17) * np.pi * t / SNAPSHOTS).astype(np.float32)
                step = rng.standard_normal(PARAMETERS, np.float32) + pull @ slow / math.sqrt(8)
                weights += np.float32(6e-4 * (1 - t / SNAPSHOTS)) * step
        draft.rename(path)
    return wt.open_run(path)


class Timed:
    """The weights of a run, and what reading them takes."""

    def __init__(self, run: wt.Run) -> None:
        self._weights = run.weights
        self.shape, self.dtype = self._weights.shape, self._weights.dtype
        self.cpu, self.rows = 0.0, 0

    def __getitem__(self, key: Any) -> np.ndarray:
        before = time.process_time()
        rows = self._weights[key]
        self.cpu += time.process_time() - before
        self.rows += len(rows)
        return rows


def memory(what: str) -> int:
    """Bytes, by the system's name: VmRSS is now, VmHWM the most so far."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(what))


def fit(path: Path, rank: int) -> dict[str, Any]:
    """What is to be measured, in a process that did nothing else before."""
    timed = Timed(wt.open_run(path))
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    at_first, before = memory("VmRSS"), time.process_time()
    svd = TemporalSVD.fit_streamed(timed, rank)
    cpu = time.process_time() - before
    return {
        "shape": list(timed.shape),
        "cpu_s": cpu,
        "decode_cpu_s": timed.cpu,
        "passes": timed.rows / timed.shape[0],
        "peak_mb": (memory("VmHWM") - at_first) / 1e6,
        "energy": svd.total_energy,
        "values": svd.singular_values.tolist(),
    }


def fit_alone(path: Path, rank: int) -> dict[str, Any]:
    command = [sys.executable, "-W", "ignore", __file__, "--fit", str(path), "--rank", str(rank)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def exact_values(weights: np.ndarray) -> np.ndarray:
    """All singular values, from the Gram matrix in float64."""
    gram = np.zeros((len(weights),) * 2)
    for start in range(0, weights.shape[1], 4096):
        block = weights[:, start : start + 4096].astype(np.float64)
        gram += block @ block.T
    return np.sqrt(np.linalg.eigvalsh(gram)[::-1].clip(0))


def compare(found: dict[str, Any], weights: np.ndarray) -> dict[str, float]:
    exact = exact_values(weights)
    apart = np.abs(np.array(found["values"]) / exact[: len(found["values"])] - 1)
    return {
        "worst_of_first": float(apart[:SHARE].max()),
        "worst": float(apart.max()),
        "energy": float(abs(found["energy"] / np.sum(exact**2) - 1)),
    }


def numpy_seconds(weights: np.ndarray, rows: int) -> float:
    before = time.process_time()
    np.linalg.svd(weights[:rows], full_matrices=False)
    return time.process_time() - before


def extrapolate(rows: int, half: float, some: float, all_rows: int) -> float:
    """a n + b n^2 at all rows, from what it is at some rows and at half of them."""
    b = (some - 2 * half) / (rows**2 / 2)
    return (some / rows - b * rows) * all_rows + b * all_rows**2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--real", type=Path, help="a real run, to compare singular values on too")
    parser.add_argument("--out", type=Path, default=Path("data/bench/svd"))
    parser.add_argument("--rank", type=int, default=64)
    parser.add_argument("--numpy-rows", type=int, default=1400, help="about 200 s")
    parser.add_argument("--fit", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    args = parser.parse_args()
    if args.fit:
        print(json.dumps(fit(args.fit, args.rank)))
        return
    run = synthetic(args.out / "synthetic.zarr")
    found = fit_alone(run.path, args.rank)
    weights = run.weights[:]
    some = numpy_seconds(weights, args.numpy_rows)
    half = min(numpy_seconds(weights, args.numpy_rows // 2) for _ in range(2))
    whole = extrapolate(args.numpy_rows, half, some, len(weights))
    result = {
        **{k: v for k, v in found.items() if k not in ("values", "energy")},
        "rank": args.rank,
        "compared": SHARE,
        "numpy_rows": args.numpy_rows,
        "numpy_cpu_s": some,
        "numpy_half_cpu_s": half,
        "numpy_whole_cpu_s": whole,
        "times_faster": whole / found["cpu_s"],
        "times_faster_without_decoding": whole / (found["cpu_s"] - found["decode_cpu_s"]),
        "apart": {"synthetic": compare(found, weights)},
    }
    if args.real:
        real = wt.open_run(args.real)
        found = fit_alone(args.real, args.rank)
        name = real.info.env.id if real.info.env else real.id
        result["apart"][name] = compare(found, real.weights[:])
        result["real"] = {k: found[k] for k in ("shape", "cpu_s", "decode_cpu_s", "peak_mb")}
    print(json.dumps(result, indent=1))
    if args.save:
        save("svd", result)


if __name__ == "__main__":
    main()
