"""What do windows from the cache cost beside windows from a bare memory map?

WEIGHTTRAJ_CACHE=data/bench/cache python tests/benchmarks/bench_load.py RUN [RUN ...]

The same windows in the same order, by worker processes, from an array that np.memmap opens and
from the cache: through torch's DataLoader and through ResumableLoader. All are measured in turns in
one process, because the machine's speed moves; medians over the turns, and ratios within a turn.
The limit is what one core copies from the map into a warm buffer, a window at a time.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import save
from torch.utils.data import DataLoader, Dataset

import weighttraj as wt
from weighttraj.load import CachedWeights, ResumableLoader, WindowDataset, cache_folder
from weighttraj.load.loader import epoch_order

BARE = {
    "bare": "bare",
    "to_torch": "bare",
    "loader": "bare",
    "bare, no workers": "bare, no workers",
    "loader, no workers": "bare, no workers",
}
"""Each way to load, and what it is compared with."""

KEPT = {"dataloader_over_memmap": "to_torch", "resumable_over_memmap": "loader"}
"""Ratios that ``--save`` keeps."""

TICK = os.sysconf("SC_CLK_TCK")


class BareWindows(Dataset[dict[str, Any]]):
    """What one writes by hand: an array, and a copy of each window of it."""

    def __init__(self, path: Path, shape: tuple[int, int], window: int, run: str) -> None:
        self.path, self.shape, self.window, self.run = path, shape, window, run
        self.rows = np.memmap(path, np.float32, mode="r", shape=shape)

    def __len__(self) -> int:
        return self.shape[0] - self.window + 1

    def __getitem__(self, i: int) -> dict[str, Any]:
        rows = torch.from_numpy(np.array(self.rows[i : i + self.window]))
        return {"weights": rows, "t": i + self.window - 1, "run": self.run}


class SomeEpochs:
    """A sampler over as many batches as a turn takes, in ResumableLoader's order."""

    def __init__(self, n: int, batch_size: int, epochs: int) -> None:
        self.n, self.batch_size, self.epochs = n, batch_size, epochs

    def __len__(self) -> int:
        return self.epochs * (self.n // self.batch_size)

    def __iter__(self) -> Iterator[list[int]]:
        for epoch in range(self.epochs):
            order = epoch_order(self.n, 0, epoch)
            for i in range(self.n // self.batch_size):
                yield order[i * self.batch_size : (i + 1) * self.batch_size].tolist()


@dataclass(frozen=True, kw_only=True)
class Turn:
    """One loader's turn."""

    wall: float
    """Seconds."""
    cpu: float
    """Seconds of this process and of its workers."""


def cpu_seconds() -> float:
    """Of this process and its living children."""
    pids = [os.getpid()]
    for children in Path("/proc/self/task").glob("*/children"):
        pids += [int(pid) for pid in children.read_text().split()]
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / TICK


def take_turn(batches: Iterable[Any], epochs: int, whole: bool) -> Turn:
    wall, cpu = time.perf_counter(), cpu_seconds()
    for _ in range(1 if whole else epochs):
        for batch in batches:
            float(batch["weights"][:, -1, 0].sum())
    return Turn(wall=time.perf_counter() - wall, cpu=cpu_seconds() - cpu)


def copy_rate(rows: np.ndarray, window: int) -> float:
    """Bytes a second that one core copies from the map, a window at a time; the best of five."""
    out = np.empty((window, rows.shape[1]), np.float32)
    starts = np.random.default_rng(0).integers(0, len(rows) - window, 2000)
    starts = starts[: max(50, int(2e9 / out.nbytes))].tolist()
    best = float("inf")
    for _ in range(5):
        before = time.perf_counter()
        for start in starts:
            np.copyto(out, rows[start : start + window])
        best = min(best, time.perf_counter() - before)
    return len(starts) * out.nbytes / best


def measure(path: Path, args: argparse.Namespace) -> dict[str, Any]:
    run = wt.open_run(path)
    before = time.perf_counter()
    rows = CachedWeights(run).map()
    opened = time.perf_counter() - before
    window_bytes = 4 * args.window * rows.shape[1]
    batch_size = max(8, min(256, int(64e6 / window_bytes)))
    windows = WindowDataset([run], args.window)
    per_epoch = len(windows) // batch_size * batch_size * window_bytes
    epochs = max(1, round(args.bytes / per_epoch))
    options: dict[str, Any] = {"num_workers": args.workers, "persistent_workers": True}
    with tempfile.TemporaryDirectory(dir=cache_folder().parent) as folder:
        bare_file = Path(folder, "rows.bin")
        bare_file.write_bytes(rows.tobytes())
        bare = BareWindows(bare_file, rows.shape, args.window, run.id)
        plan: Any = SomeEpochs(len(windows), batch_size, epochs)
        loaders: dict[str, Any] = {
            "bare": DataLoader(bare, batch_sampler=plan, **options),
            "to_torch": DataLoader(windows, batch_sampler=plan, **options),
            "loader": ResumableLoader(windows, batch_size, drop_last=True, **options),
            "bare, no workers": DataLoader(bare, batch_sampler=plan),
            "loader, no workers": ResumableLoader(windows, batch_size, drop_last=True),
        }
        firsts = [next(iter(loader)) for loader in loaders.values()]
        for first in firsts:  # the same batch content
            assert torch.equal(first["weights"], firsts[0]["weights"])
            assert torch.equal(first["t"], firsts[0]["t"])
            assert first["run"] == firsts[0]["run"]
        for loader in loaders.values():  # starts the workers
            take_turn(loader, 1, whole=True)
        turns: dict[str, list[Turn]] = {name: [] for name in loaders}
        names = list(loaders)
        for turn in range(args.turns):
            for name in names[turn % len(names) :] + names[: turn % len(names)]:
                turns[name].append(take_turn(loaders[name], epochs, whole="loader" not in name))
    given = epochs * per_epoch
    return {
        "run": path.name,
        "env": run.info.env.id if run.info.env else run.id,
        "shape": list(rows.shape),
        "first_open_s": round(opened, 3),
        "batch_size": batch_size,
        "bytes_a_turn": given,
        "copy_gb_s": round(copy_rate(rows, args.window) / 1e9, 2),
        **{n: summary(turns[n], turns[BARE[n]], given) for n in names},
    }


def summary(turns: list[Turn], bare: list[Turn], given: int) -> dict[str, float]:
    wall = float(np.median([turn.wall for turn in turns]))
    cpu = float(np.median([turn.cpu for turn in turns]))
    pairs = list(zip(turns, bare, strict=True))
    return {
        "gb_s": round(given / wall / 1e9, 2),
        "gb_per_cpu_s": round(given / cpu / 1e9, 2),
        "wall_ratio": round(float(np.median([b.wall / t.wall for t, b in pairs])), 3),
        "cpu_ratio": round(float(np.median([b.cpu / t.cpu for t, b in pairs])), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--window", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--bytes", type=float, default=4e9, help="in a turn, about")
    parser.add_argument("--save", action="store_true", help="keep the ratios in results.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    kept: dict[str, dict[str, float]] = {key: {} for key in KEPT}
    for path in args.runs:
        result = measure(path, args)
        for key, name in KEPT.items():
            kept[key][result["env"]] = result[name]["wall_ratio"]
        print(json.dumps(result), flush=True)
        print(f"\n{result['run']} {result['shape']}: one core copies {result['copy_gb_s']} GB/s")
        print("| from | GB/s | GB per CPU s | throughput / bare | CPU: bare / this | of the copy |")
        print("|---|---:|---:|---:|---:|---:|")
        for name in BARE:
            r = result[name]
            share = r["gb_per_cpu_s"] / result["copy_gb_s"]
            print(
                f"| {name} | {r['gb_s']} | {r['gb_per_cpu_s']} | {r['wall_ratio']} | "
                f"{r['cpu_ratio']} | {share:.2f} |"
            )
        print(flush=True)
    if args.save:
        save("load", kept)


if __name__ == "__main__":
    main()
