"""Wrote the golden files of format version 1. They are never written again: readers must keep up.

python -m tests.golden.make FOLDER

Three runs of one data set: packed, packed as an archive, and a folder with shards; and the same as
one HDF5 file. Every value follows from its place, so tests need no copy of them.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import weighttraj as wt
from weighttraj.format import (
    Algorithm,
    Cadence,
    DatasetInfo,
    EnvInfo,
    ObsNorm,
    ParamLayout,
    PolicySpec,
    Provenance,
    RunEntry,
    RunInfo,
)
from weighttraj.store.catalog import write_dataset_info
from weighttraj.writer import RunWriter

ROWS = 20
SMALL = ParamLayout.of(
    {
        "log_std": ((1,), "log_std", ("action",)),
        "mlp_extractor.policy_net.0.weight": ((3, 2), "weight", ("hidden_0", "observation")),
        "mlp_extractor.policy_net.0.bias": ((3,), "bias", ("hidden_0",)),
        "action_net.weight": ((1, 3), "weight", ("action", "hidden_0")),
        "action_net.bias": ((1,), "bias", ("action",)),
    }
)
WIDE = ParamLayout.of({"w": ((16_400,), "other", ("fixed",))})  # just too wide for one chunk
POLICY = PolicySpec(
    kind="mlp",
    head="gaussian",
    activation="tanh",
    layers=(
        ("mlp_extractor.policy_net.0.weight", "mlp_extractor.policy_net.0.bias"),
        ("action_net.weight", "action_net.bias"),
    ),
    observation_shape=(2,),
    action_shape=(1,),
    action_low=(-1.0,),
    action_high=(1.0,),
)
INFO = RunInfo(
    run_id="default",
    layout=SMALL,
    policy=POLICY,
    env=EnvInfo(id="Golden-v0", kwargs={"a": 1.5}, max_episode_steps=7, wrappers=("TimeLimit",)),
    algorithm=Algorithm(name="PPO", library="none", hyperparameters={"lr_schedule": [[1.0, 3e-4]]}),
    seed=0,
    cadence=Cadence(every=2, gradient_steps_per_iteration=4),
    obs_norm=ObsNorm(source="golden", epsilon=1e-8, shape=(2,), clip_low=-10.0, clip_high=10.0),
    ret_norm=True,
    diagnostics=("approx_kl", "ep_rew_mean"),
    critic_layout=ParamLayout.of({"v": ((5,), "other", ("fixed",))}),
    optimizer_moments=True,
    probe_observations=3,
    provenance=Provenance(created="2026-11-22T00:00:00+00:00", packages={"zarr": "3.1.6"}),
    block=8,
)


def weights(t: int, size: int) -> np.ndarray:
    """float32 (size,): weights of snapshot t."""
    return ((np.arange(size) % 251 - 125) / 64 + t / 1024).astype(np.float32)


def snapshot(t: int, info: RunInfo) -> dict[str, object]:
    """What is appended for snapshot t."""
    size = info.layout.size
    values: dict[str, object] = {
        "weights": weights(t, size),
        "num_timesteps": 100 * ((t + 1) // 2),
        "iteration": (t + 1) // 2,
        "epoch": (t + 1) % 2 if t else -1,
        "gradient_step": 2 * t,
        "phase": (t + 1) % 2 if t else -1,
        "learning_rate": 3e-4 / (1 + t) if t else float("nan"),
    }
    if info.obs_norm is not None:
        values |= {
            "obs_norm": (np.array([t, -t]) / 3, np.array([1.0, 2.0]) + t, t + 1e-4),
            "ret_norm": (np.array(t / 7), np.array(1.0 + t), t + 1e-4),
            "train": {"approx_kl": t / 1000} if t % 2 == 0 else {},
            "critic": np.arange(5, dtype=np.float32) * t,
            "moments": (weights(t, size) / 8, weights(t, size) ** 2),
        }
    return values


def probes(i: int) -> np.ndarray:
    """float32 (3, 2): probe observations of iteration i."""
    return (np.arange(6).reshape(3, 2) + i).astype(np.float32) / 4


def write_run(path: Path, info: RunInfo) -> Path:
    with RunWriter(path, info) as writer:
        for t in range(ROWS):
            writer.append(**snapshot(t, info))
            if t % 2 and info.probe_observations:
                writer.append_iteration(probes(t // 2))
    return path


def main(folder: Path) -> None:
    runs = folder / "dataset" / "runs"
    for profile in ("default", "archive"):
        live = write_run(runs / f"{profile}.zarr", replace(INFO, run_id=profile))
        wt.pack(live, profile=profile)
        for file in sorted([live, *live.rglob("*")], reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
    write_run(runs / "folder.zarr", RunInfo(run_id="folder", layout=WIDE, block=8, seed=2))
    entries = (
        RunEntry(id="default", path="runs/default.zarr.zip", seed=0, split="train"),
        RunEntry(id="archive", path="runs/archive.zarr.zip", seed=0, split="validation"),
        RunEntry(id="folder", path="runs/folder.zarr", seed=2, split="test"),
    )
    info = DatasetInfo(id="golden", runs=entries, status="complete", recipe={"id": "golden"})
    write_dataset_info(folder / "dataset", info)
    wt.seal(folder / "dataset")
    wt.export_hdf5(folder / "dataset", folder / "dataset.h5")
    for lock in runs.glob("*.lock"):
        lock.unlink()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
