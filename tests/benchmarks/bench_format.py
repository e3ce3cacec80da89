"""Size and speed of the format beside what people do today, on real runs, in one go.

weighttraj collect tests/benchmarks/inverted-pendulum.toml --out data/bench/inverted-pendulum
weighttraj collect tests/benchmarks/half-cheetah.toml --out data/bench/half-cheetah
python tests/benchmarks/bench_format.py data/bench/*/runs/*.zarr.zip

Every way of keeping a run is written once, opened, and read in turns; CPU seconds of reading are
medians over the turns. The physical limit is reading the raw bytes from a warm file, which `memmap`
does.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from results import save

import weighttraj as wt
from weighttraj.format import DatasetInfo, RunEntry
from weighttraj.store.catalog import write_dataset_info
from weighttraj.store.live import LiveStore

Reader = Callable[[], np.ndarray]


def live_copy(run: wt.Run, path: Path, run_id: str) -> Path:
    """The run as it lay while it was collected."""
    empty = replace(run.info, run_id=run_id, profile="default", **dict.fromkeys(COUNTS, 0))
    store = LiveStore.create(path, empty)
    for spec in store.specs.values():
        rows = run[spec.name][:]
        for start in range(0, len(rows), run.info.block):
            store.write(spec.name, start, rows[start : start + run.info.block])
    store.commit(replace(run.info, run_id=run_id, profile="default"))
    return path


COUNTS = ("n_committed", "n_committed_iterations")


def files_of(path: Path) -> list[Path]:
    return [p for p in [path, *path.rglob("*")] if p.is_file()]


def write_all(run: wt.Run, folder: Path) -> dict[str, tuple[Reader, int]]:
    """Each way of keeping the weights: how they are read, and bytes on disk of the weights."""
    weights = run.weights[:]
    live = live_copy(run, folder / "live.zarr", run.id)
    ways: dict[str, tuple[Reader, int]] = {}

    def of_store(path: Path) -> tuple[Reader, int]:
        opened = wt.open_run(path)
        names = [n for n in names_of(opened) if n.startswith("policy/weights/c/")]
        size = sum(len(opened._store.objects.read(name) or b"") for name in names)
        return (lambda: opened.weights[:]), size

    ways["zarr, while collected"] = of_store(live)
    for profile in ("default", "archive"):
        path = wt.pack(live, profile=profile, out=folder / f"{profile}.zarr.zip")
        ways[f"zarr, packed, {profile}"] = of_store(path)
    lzf = folder / "lzf.h5"
    with h5py.File(lzf, "w") as file:
        chunks = (64, min(weights.shape[1], 16_384))
        file.create_dataset("w", data=weights, chunks=chunks, compression="lzf", shuffle=True)
    opened_h5 = h5py.File(lzf)
    ways["h5py, lzf"] = (lambda: opened_h5["w"][:]), lzf.stat().st_size
    saved = folder / "snapshots"
    saved.mkdir()
    for t, row in enumerate(weights):
        torch.save(torch.from_numpy(row.copy()), saved / f"{t:06d}.pt")
    size = sum(f.stat().st_size for f in files_of(saved))
    ways["torch.save, a file a snapshot"] = (lambda: read_saved(saved)), size
    raw = folder / "raw.f32"
    weights.tofile(raw)
    ways["memmap (the limit)"] = (
        (lambda: np.array(np.memmap(raw, np.float32, "r", shape=weights.shape))),
        raw.stat().st_size,
    )
    return ways


def names_of(run: wt.Run) -> list[str]:
    store = run._store
    if hasattr(store.objects, "names"):
        return store.objects.names
    return [p.relative_to(store.path).as_posix() for p in files_of(store.path)]


def read_saved(folder: Path) -> np.ndarray:
    rows = [torch.load(path, weights_only=True).numpy() for path in sorted(folder.iterdir())]
    return np.stack(rows)


def measure(run: wt.Run, turns: int) -> dict[str, dict[str, float]]:
    with tempfile.TemporaryDirectory(dir="data") as folder:
        ways = write_all(run, Path(folder))
        raw = len(run) * run.layout.size * 4
        expected = run.weights[:]
        seconds: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(turns):
            for name, (read, _) in ways.items():
                start = time.process_time()
                got = read()
                seconds[name].append(time.process_time() - start)
                assert np.array_equal(got, expected), name
        return {
            name: {
                "size_of_raw": size / raw,
                "cpu_s": statistics.median(seconds[name]),
                "MB_per_cpu_s": raw / 1e6 / statistics.median(seconds[name]),
            }
            for name, (_, size) in ways.items()
        }


OPENING = """
import sys, time
import weighttraj as wt
import weighttraj.load
start, cpu = time.perf_counter(), time.process_time()
windows = wt.open(sys.argv[1]).to_torch(window=20)
opened = time.perf_counter() - start
windows[len(windows) // 2]
print(time.perf_counter() - start, time.process_time() - cpu, opened)
"""


def measure_opening(run: wt.Run, n_runs: int = 50) -> dict[str, float]:
    """A data set of so many runs: from the path to the first window, cache cold and warm."""
    with tempfile.TemporaryDirectory(dir="data") as folder:
        root = Path(folder) / "dataset"
        entries = []
        for i in range(n_runs):
            live = live_copy(run, root / f"runs/run{i:02d}.zarr", f"run{i:02d}")
            path = wt.pack(live).relative_to(root).as_posix()
            entries.append(RunEntry(id=f"run{i:02d}", path=path, seed=i))
            for file in sorted([live, *live.rglob("*")], reverse=True):
                file.rmdir() if file.is_dir() else file.unlink()
        info = DatasetInfo(id="opening", runs=tuple(entries), status="complete")
        write_dataset_info(root, info)
        objects = len(files_of(root))
        command = [sys.executable, "-c", OPENING, str(root)]
        environment = {"WEIGHTTRAJ_CACHE": str(Path(folder) / "cache"), "PATH": "/usr/bin"}
        times = []
        for _ in range(4):
            done = subprocess.run(
                command, capture_output=True, text=True, check=True, env=environment
            )
            times.append([float(x) for x in done.stdout.split()])
    return {
        "runs": n_runs,
        "objects": objects,
        "first_window_cold_s": times[0][0],
        "first_window_s": min(t[0] for t in times[1:]),
        "first_window_cpu_s": min(t[1] for t in times[1:]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--save", action="store_true", help="keep the table in results.json")
    args = parser.parse_args()
    results: dict[str, Any] = {"runs": {}, "opening": {}}
    for path in args.runs:
        run = wt.open_run(path)
        env = run.info.env.id if run.info.env else run.id
        results["runs"][env] = measure(run, args.turns)
        print(f"\n{env}: {len(run)} snapshots of {run.layout.size} parameters")
        print(f"{'':32} {'size/raw':>9} {'CPU ms':>9} {'MB/CPU s':>9}")
        for name, row in results["runs"][env].items():
            print(
                f"{name:32} {row['size_of_raw']:9.3f} {1e3 * row['cpu_s']:9.1f} "
                f"{row['MB_per_cpu_s']:9.0f}"
            )
        if run.layout.size < 1000:
            results["opening"] = measure_opening(run)
            print("a data set of 50 runs:", results["opening"])
    print(json.dumps(results))
    if args.save:
        save("format", results)


if __name__ == "__main__":
    main()
