"""Runs and data sets for the checks: copies of a real run with other weights, on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Float32, Int

from tipl.runs import weights_of
from tipl.training import LoopConfig
from tipl.training.starts import StartsConfig
from weighttraj import ParamLayout, Run, RunWriter, open_run
from weighttraj.format import DatasetInfo, RunEntry
from weighttraj.store.catalog import write_dataset_info

Moments = tuple[Float32[np.ndarray, "time param"], Float32[np.ndarray, "time param"]]
"""First and second moments of Adam."""

C = TypeVar("C", bound=StartsConfig)

WALK = 300
"""Number of snapshots of a random walk."""


@dataclass(frozen=True, kw_only=True)
class RefitConfig:
    """How a forecaster is fitted to other runs."""

    folder: Path
    """Folder for data sets and models."""
    horizons: tuple[int, ...]
    """Numbers of snapshots ahead."""
    batches: int = 2_000
    """Number of batches, or gradient steps, of a network's training."""
    seed: int = 0
    """Seed of samples and trainings."""


def random_walks(
    run: Run, folder: Path, *, count: int = 4, length: int = WALK, seed: int = 0
) -> list[Run]:
    """Write runs whose steps are independent and normal: nothing in them can be forecast."""
    walks = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        steps = 1e-3 * rng.normal(size=(length, run.layout.size))
        steps[0] = weights_of(run)[0]
        walks.append(run_like(run, steps.cumsum(0), folder))
    return walks


def run_like(
    run: Run,
    weights: Float[np.ndarray, "time param"],
    folder: Path,
    moments: Moments | None = None,
) -> Run:
    """Write a run with other weights, of any length; if it is there, only open it.

    Args:
        run: its layout, cadence, counters and normalisers are copied. Beyond its end the phases go
            on, and the rest repeats the last snapshot.
        weights: weights of the new run; float32 is stored.
        folder: folder of the new run, which is named after its weights.
        moments: Adam's moments of the new run; None: noise, if the run has moments.
    """
    stored = np.ascontiguousarray(weights, np.float32)
    if moments is None and run.info.optimizer_moments:
        rng = np.random.default_rng(len(stored))
        mean, square = rng.normal(size=(2, *stored.shape)).astype(np.float32)
        moments = mean, square**2
    content = [stored, *(moments or ())]
    digest = hashlib.sha256(b"".join(array.tobytes() for array in content)).hexdigest()[:16]
    path = folder / f"{run.id[:100]}-{digest}.zarr"
    if path.exists():
        return open_run(path)
    info = replace(
        run.info,
        run_id=path.stem,
        diagnostics=(),
        critic_layout=None,
        optimizer_moments=moments is not None,
        probe_observations=0,
        block=128,
    )
    times, iterations, rates = run.num_timesteps, run.iteration, run.learning_rate
    steps, every = run["index/gradient_step"][:], info.cadence.every if info.cadence else 0
    phases = _phases(run.phase, len(stored))
    observations = _moments(run, "obs_norm") if info.obs_norm is not None else None
    rewards = _moments(run, "ret_norm") if info.ret_norm else None
    with RunWriter(path, info) as writer:
        for t, row in enumerate(stored):
            now = min(t, len(run) - 1)
            writer.append(
                row,
                num_timesteps=int(times[now]) + t - now,
                iteration=int(iterations[now]),
                phase=int(phases[t]),
                learning_rate=float(rates[now]),
                obs_norm=None if observations is None else observations[now],
                ret_norm=None if rewards is None else rewards[now],
                gradient_step=int(steps[now]) + (t - now) * every if steps[now] >= 0 else -1,
                moments=None if moments is None else (moments[0][t], moments[1][t]),
            )
    return open_run(path)


def adam_of(run: Run) -> Moments | None:
    """Return Adam's moments of a run, if it stores them."""
    if not run.info.optimizer_moments:
        return None
    return run["optimizer/exp_avg"][:], run["optimizer/exp_avg_sq"][:]


def as_dataset(runs: Sequence[Run], folder: Path, *, validation: int = 0) -> Path:
    """Write a data set of copies of these runs; the last ``validation`` ones are for validation."""
    copies = [run_like(run, weights_of(run), folder / "runs", adam_of(run)) for run in runs]
    train = len(copies) - validation
    entries = (
        RunEntry(
            id=run.id,
            path=f"runs/{run.path.name}",
            split="train" if number < train else "validation",
        )
        for number, run in enumerate(copies)
    )
    write_dataset_info(folder, DatasetInfo(id="walks", runs=tuple(entries), status="complete"))
    return folder


def refit_settings(
    kind: type[C], training: LoopConfig, network: Any, runs: Sequence[Run], config: RefitConfig
) -> C:
    """Return the settings of a training of a network of these sizes on starts of other runs.

    A quarter of the runs choose which state is kept.
    """
    training = replace(
        training,
        n_batches=config.batches,
        save_every=max(1, config.batches // 20),
        seed=config.seed,
    )
    return kind(
        data=(as_dataset(runs, config.folder / "walks", validation=len(runs) // 4),),
        out=config.folder / "refit",
        network=replace(network, horizons=config.horizons, phases=0),
        training=training,
    )


def random_symmetry(
    layout: ParamLayout, symmetry: str, rng: np.random.Generator
) -> tuple[Int[np.ndarray, " param"], Float32[np.ndarray, " param"]]:
    """Draw a symmetry of a policy's hidden units: ``weights[..., order] * signs`` acts as before.

    Axes with the same ``hidden_*`` label are altered together.
    """
    order = np.arange(layout.size)
    signs = np.ones(layout.size, np.float32)
    units: dict[str, np.ndarray] = {}
    for param in layout.params:
        places = order[param.slice].reshape(param.shape)
        flips = signs[param.slice].reshape(param.shape)  # a view
        for axis, (label, size) in enumerate(zip(param.axes, param.shape, strict=True)):
            if not label.startswith("hidden_"):
                continue
            if label not in units:
                flipped = rng.choice([-1.0, 1.0], size=size)
                units[label] = rng.permutation(size) if symmetry == "permutation" else flipped
            if symmetry == "permutation":
                places = places.take(units[label], axis)
            else:
                flips *= np.expand_dims(units[label], [i for i in range(flips.ndim) if i != axis])
        order[param.slice] = places.ravel()
    return order, signs


def _phases(known: Int[np.ndarray, " time"], length: int) -> Int[np.ndarray, " length"]:
    """Return the phases of so many snapshots: the known ones, then the same sequence on."""
    period = int(known.max()) + 1
    if period < 1 or length <= len(known):
        return np.resize(known, length)
    beyond = (known[-1] + 1 + np.arange(length - len(known))) % period
    return np.concatenate([known, beyond])


def _moments(run: Run, group: str) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Return the statistics of a normaliser at each snapshot."""
    mean, var, count = (run[f"{group}/{name}"][:] for name in ("mean", "var", "count"))
    rows = zip(mean, var, count.tolist(), strict=True)
    return [(np.asarray(m), np.asarray(v), n) for m, v, n in rows]
