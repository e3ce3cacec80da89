"""Puts any forecaster to the five checks, with a fit of its kind to random walks for the null.

A forecaster that was fitted to real runs says nothing of what its kind finds in random walks. So a
new one, of the same kind and sizes, is fitted to walks. A kind that has a fit has a line in
``REFITS``; what has none is the same on walks as on runs.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import weighttraj as wt
from tipl.baselines import WNN, NinoMLP, Regression, TrainingConfig
from tipl.baselines.nowcaster import Nowcaster
from tipl.causal import Causal, CausalTrainConfig, train_causal
from tipl.checks import NULL, TOLERANCE, Fit, adam_of, check, run_like
from tipl.drift import Drift
from tipl.errors import ForecastError
from tipl.evaluation.parts import fingerprint
from tipl.forecast import TIPL, Forecaster
from tipl.gate import Gate, GateTrainConfig, train_gate
from tipl.settings import check_settings
from tipl.train import TrainConfig, train
from weighttraj import Run
from weighttraj.format import DatasetInfo, RunEntry
from weighttraj.format.catalog import write_dataset_info


@dataclass(frozen=True, kw_only=True)
class RefitConfig:
    """How much a refit may cost."""

    folder: Path
    """Data sets and models are written there."""
    horizons: tuple[int, ...]
    """How far the new forecaster must look, of those kinds that are fitted for some horizons."""
    batches: int = 2_000
    """Batches, or gradient steps, of a network's training."""
    seed: int = 0
    """Of samples and trainings."""


def refit_of(forecaster: Forecaster, config: RefitConfig) -> Fit | None:
    """What fits such a forecaster to other runs; None: there is nothing to fit."""
    refit = REFITS.get(type(forecaster))
    if refit is None:
        return None
    return lambda runs: refit(forecaster, runs, config)


def check_model(
    forecaster: Forecaster,
    data: str | Path,
    *,
    horizons: tuple[int, ...] = (1, 2, 5, 10),
    batches: int = 2_000,
    walks: int = 12,
    seed: int = 0,
) -> dict[str, Any]:
    """All five checks on the first test run of a data set, as ``tipl check`` writes them.

    Args:
        forecaster: what is checked.
        data: a data set: path or id.
        horizons: how far to look.
        batches: of the training on random walks.
        walks: random walks; two are forecast, the others are for the training.
        seed: of walks, symmetries and the training.

    Returns:
        JSON: what was measured, how, and what passed.

    Raises:
        ForecastError: it makes no such forecast, or a number is too small or too large.
    """
    numbers = {"horizons": horizons, "batches": batches, "walks": walks, "seed": seed}
    least = {"horizons": 1, "batches": 1, "walks": 3, "seed": 0}
    check_settings(numbers, least, ForecastError)
    dataset = wt.open_dataset(data)
    run = dataset.split("test").runs[0]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        config = RefitConfig(folder=folder, horizons=horizons, batches=batches, seed=seed)
        fit = refit_of(forecaster, config)
        found = check(forecaster, run, folder, fit=fit, horizons=horizons, count=walks, seed=seed)
    return {
        "forecaster": forecaster.name,
        "fingerprint": fingerprint(forecaster),
        "data": dataset.info.id,
        "version": dataset.info.version,
        "run": run.id,
        "fitted_to_walks": fit is not None,
        "batches": batches,
        "walks": walks,
        "seed": seed,
        "largest": {"null": NULL, "error": TOLERANCE},
        **asdict(found),
        "passed": found.passed,
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }


def as_dataset(runs: Sequence[Run], folder: Path, *, validation: int = 0) -> Path:
    """A data set on disk of copies of these runs, for what is trained on one.

    Args:
        runs: for its training split.
        folder: of the data set.
        validation: so many of them, the last ones, are for the validation split.
    """
    copies = [run_like(run, run.weights[:], folder / "runs", adam_of(run)) for run in runs]
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


def _regression(old: Regression, runs: Sequence[Run], config: RefitConfig) -> Regression:
    return Regression.fit(
        runs,
        old.features,
        by_phase=old.phases is not None,
        horizons=config.horizons,
        seed=config.seed,
    )


def _nowcaster(old: Nowcaster, runs: Sequence[Run], config: RefitConfig) -> Nowcaster:
    return type(old).fit(
        runs,
        horizons=config.horizons,
        seed=config.seed,
        training=TrainingConfig(steps=config.batches),
    )


def _tipl(old: TIPL, runs: Sequence[Run], config: RefitConfig) -> TIPL:
    """A Transformer of the same sizes; the warm-up is a tenth of the training."""
    sizes = asdict(old.config.gpt)
    del sizes["max_timestep"]  # that of the walks
    return train(
        TrainConfig(
            data=as_dataset(runs, config.folder / "walks"),
            out=config.folder / "refit",
            n_batches=config.batches,
            warmup=max(1, config.batches // 10),
            seed=config.seed,
            **sizes,
        )
    )


def _gate(old: Gate, runs: Sequence[Run], config: RefitConfig) -> Gate:
    """A network of the same sizes; a quarter of the walks choose when to stop."""
    sizes = old.config.network
    return train_gate(
        GateTrainConfig(
            data=(as_dataset(runs, config.folder / "walks", validation=len(runs) // 4),),
            out=config.folder / "refit",
            horizons=config.horizons,
            n_batches=config.batches,
            validate_every=max(1, config.batches // 20),
            seed=config.seed,
            lags=sizes.lags,
            width=sizes.width,
            experts=sizes.experts,
            adam=sizes.adam,
        )
    )


def _drift(old: Drift, runs: Sequence[Run], config: RefitConfig) -> Drift:
    """Another gate, and the same amplitudes: walks have no returns to choose others by."""
    horizons = tuple(h for h in config.horizons if h in old.amplitudes)
    gate = _gate(old.gate, runs, replace(config, horizons=horizons))
    return Drift(gate, {h: old.amplitudes[h] for h in horizons})


def _causal(old: Causal, runs: Sequence[Run], config: RefitConfig) -> Causal:
    """A Transformer of the same sizes; a quarter of the walks choose when to stop."""
    sizes = asdict(old.config.network)
    del sizes["phases"]  # those of the walks
    return train_causal(
        CausalTrainConfig(
            data=(as_dataset(runs, config.folder / "walks", validation=len(runs) // 4),),
            out=config.folder / "refit",
            n_batches=config.batches,
            validate_every=max(1, config.batches // 20),
            seed=config.seed,
            **sizes | {"horizons": config.horizons},
        )
    )


REFITS: dict[type, Callable[[Any, Sequence[Run], RefitConfig], Forecaster]] = {
    Regression: _regression,
    WNN: _nowcaster,
    NinoMLP: _nowcaster,
    TIPL: _tipl,
    Gate: _gate,
    Drift: _drift,
    Causal: _causal,
}
"""What fits each kind anew: the old forecaster, which says its sizes, the runs, and how much."""


__all__ = ["REFITS", "RefitConfig", "as_dataset", "check_model", "refit_of"]
