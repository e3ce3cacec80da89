"""Fits the baselines, in one pass over the training runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

import weighttraj as wt
from tipl.checks.copies import RefitConfig
from tipl.errors import TrainError
from tipl.forecaster import Forecaster
from tipl.horizons import HORIZONS, fitted
from tipl.models.baselines.data import samples
from tipl.models.baselines.features import Ema, EndPoints, Features, Steps
from tipl.models.baselines.modes import ModeSteps
from tipl.models.baselines.naive import BETAS, UNFITTED
from tipl.models.baselines.nowcaster import LOOP, Nowcaster, NowcasterConfig, NowcasterFit
from tipl.models.baselines.nowcasters import WNN, NinoMLP
from tipl.models.baselines.regression import Regression, RegressionFit
from tipl.models.baselines.subspace import ProjectedSteps
from tipl.runs import checksum_of
from tipl.settings import check_settings
from tipl.training import LoopConfig
from weighttraj import Run

FEATURES: tuple[tuple[Features, bool], ...] = (
    (Steps(1), False),
    *((Ema(beta), False) for beta in BETAS),
    (Steps(20), False),
    (Steps(20), True),
    (ProjectedSteps(), False),
    (ModeSteps(), False),
    (EndPoints(), False),
)
"""Features of each regression, and whether it has coefficients for each part of the iteration."""


@dataclass(frozen=True, kw_only=True)
class BaselinesConfig:
    """What the baselines are fitted to, and where they go."""

    data: str | Path
    """Data set; its training split is used. Of each small network the state that is best on its
    validation split is kept."""
    out: Path
    """Folder; each baseline gets a folder of its own in it."""
    seed: int = 0
    """Seed of samples and of the small networks."""
    horizons: tuple[int, ...] = HORIZONS
    """Numbers of snapshots ahead."""
    steps: int = 2000
    """Number of gradient steps of each small network."""


def train_baselines(config: BaselinesConfig, *, console: Console | None = None) -> list[Forecaster]:
    """Fit the baselines to the training runs of a data set, and write each into a folder.

    Minutes on one core.

    Example: tipl train baselines --data hopper-v4-ppo-16x16-v1 --out data/baselines

    Then: tipl evaluate data/baselines/ar-20-phase persistence --data hopper-v4-ppo-16x16-v1

    Raises:
        TrainError: the runs are too short, or a number is too small.
    """
    dataset = wt.open_dataset(config.data)
    train = dataset.split("train").runs
    with (console or Console(quiet=True)).status("reading") as status:
        baselines = fit_baselines(
            train,
            [run for run in dataset if run.split == "validation"],
            horizons=config.horizons,
            seed=config.seed,
            progress=status.update,
            training=replace(LOOP, n_batches=config.steps, save_every=max(1, config.steps // 10)),
        )
    runs = {run.id: checksum_of(run) for run in train}
    settings = asdict(config) | {"data": str(config.data), "runs": runs}
    del settings["out"]
    save_baselines(baselines, config.out, settings)
    return baselines


def fit_baselines(
    runs: Sequence[Run],
    validation_runs: Sequence[Run] | None = None,
    *,
    horizons: Sequence[int] = HORIZONS,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    training: LoopConfig | None = None,
) -> list[Forecaster]:
    """Return all baselines, from persistence to the small networks.

    Each run is read once. A fit looks at a sample of the parameters and starts of large runs.

    Args:
        runs: training runs.
        validation_runs: other runs; of each small network the state that does best on them is
            kept.
        horizons: numbers of snapshots ahead of the fitted ones.
        seed: seed of samples and trainings.
        progress: progress callback, called with a line of text.
        training: how the small networks are trained; None: as they are by default.

    Raises:
        TrainError: the runs are too short, or a number is too small.
    """
    loop = training or LOOP
    numbers = {"horizons": tuple(horizons), "seed": seed, "steps": loop.n_batches}
    check_settings(numbers, {"horizons": 1, "seed": 0, "steps": 1}, TrainError)
    say = progress or (lambda _: None)
    config = NowcasterConfig(horizons=fitted(horizons))
    linear = [
        RegressionFit(features, by_phase=by_phase, horizons=horizons, seed=seed)
        for features, by_phase in FEATURES
    ]
    kinds: list[type[Nowcaster]] = [WNN, NinoMLP]
    networks = [NowcasterFit(kind, config, seed=seed, training=loop) for kind in kinds]
    fittings: list[RegressionFit | NowcasterFit[Nowcaster]] = [*linear, *networks]
    for run, trajectory in samples(runs, seed):
        for fitting in fittings:
            fitting.add(trajectory)
        say(f"read {run.id}")
    for run, trajectory in samples(validation_runs or [], seed + 1):
        for network in networks:
            network.add(trajectory, validation=True)
        say(f"read {run.id}, for validation")
    baselines = list(UNFITTED)
    for fitting in fittings:
        baselines.append(fitting.finish())
        say(f"fitted {baselines[-1].name}")
    return baselines


def save_baselines(
    forecasters: Iterable[Forecaster],
    folder: str | Path,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write each forecaster into a folder of its name.

    Args:
        forecasters: fitted ones.
        folder: folder of all.
        settings: how they were fitted, and to what, for ``train.json``; None: not recorded.
    """
    for forecaster in forecasters:
        out = Path(folder) / forecaster.name
        forecaster.save(out)
        if settings is not None:
            (out / "train.json").write_text(json.dumps(settings, indent=1), encoding="utf-8")


def refit_regression(old: Regression, runs: Sequence[Run], config: RefitConfig) -> Regression:
    """Fit a regression on the same features to other runs, for the null check."""
    return Regression.fit(
        runs,
        old.features,
        by_phase=old.phases is not None,
        horizons=config.horizons,
        seed=config.seed,
    )


def refit_nowcaster(old: Nowcaster, runs: Sequence[Run], config: RefitConfig) -> Nowcaster:
    """Train a small network of the same kind on other runs, for the null check."""
    return type(old).fit(
        runs,
        horizons=config.horizons,
        seed=config.seed,
        training=replace(LOOP, n_batches=config.batches, save_every=max(1, config.batches // 10)),
    )
