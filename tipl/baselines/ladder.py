"""The whole ladder of baselines, fitted in one pass over the training runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tipl.baselines.endpoints import EndPoints
from tipl.baselines.features import Features
from tipl.baselines.horizons import HORIZONS, fitted
from tipl.baselines.modes import ModeSteps
from tipl.baselines.naive import Extrapolation, Persistence
from tipl.baselines.networks import TrainingConfig
from tipl.baselines.nowcaster import Nowcaster, NowcasterConfig, NowcasterFit
from tipl.baselines.nowcasters import WNN, NinoMLP
from tipl.baselines.regression import RegressionFit
from tipl.baselines.steps import Ema, Slope, Steps
from tipl.baselines.subspace import DMD, ProjectedSteps
from tipl.baselines.trajectory import samples
from tipl.errors import ForecastError, TrainError
from tipl.forecast import Forecaster
from tipl.settings import check_settings
from weighttraj import Run

_BETAS = (0.9, 0.95, 0.98)
_WITHOUT_FIT: tuple[Forecaster, ...] = (
    Persistence(),
    Extrapolation(Steps(1)),
    *(Extrapolation(Slope(window)) for window in (5, 20, 50, 200)),
    *(Extrapolation(Ema(beta)) for beta in _BETAS),
    DMD(),
)


def names() -> list[str]:
    """The baselines that need no fit, in the order of the ladder."""
    return [forecaster.name for forecaster in _WITHOUT_FIT]


def by_name(name: str) -> Forecaster:
    """A baseline that needs no fit.

    Raises:
        ForecastError: there is none of this name.
    """
    for forecaster in _WITHOUT_FIT:
        if forecaster.name == name:
            return forecaster
    raise ForecastError(
        "there is no such forecaster",
        expected=f"a folder with config.json, or one of {', '.join(names())}",
        got=name,
        do="name the folder that `tipl train` or `tipl fit` made",
    )


def fit_ladder(
    runs: Sequence[Run],
    validation_runs: Sequence[Run] | None = None,
    *,
    horizons: Sequence[int] = HORIZONS,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    training: TrainingConfig | None = None,
) -> list[Forecaster]:
    """All baselines, from persistence to the small networks.

    Each run is read once. A fit looks at a sample of the parameters and starts of large runs.

    Args:
        runs: training runs.
        validation_runs: other runs; of each small network the state that does best on them is
            kept. Nothing else looks at them.
        horizons: how far the fitted ones look.
        seed: of samples and trainings.
        progress: called with a line for each thing done.
        training: how the small networks are trained; None: as they are by default.

    Raises:
        TrainError: the runs are too short, or a number is too small.
    """
    numbers = {"horizons": tuple(horizons), "seed": seed, **vars(training or TrainingConfig())}
    least = {"horizons": 1, "seed": 0, "steps": 1, "batch_size": 1}
    check_settings(numbers, least, TrainError)
    say = progress or (lambda _: None)
    config = NowcasterConfig(horizons=fitted(horizons))
    rungs: list[tuple[Features, bool]] = [
        (Steps(1), False),
        *((Ema(beta), False) for beta in _BETAS),
        (Steps(20), False),
        (Steps(20), True),
        (ProjectedSteps(), False),
        (ModeSteps(), False),
        (EndPoints(), False),
    ]
    linear = [
        RegressionFit(features, by_phase=by_phase, horizons=horizons, seed=seed)
        for features, by_phase in rungs
    ]
    kinds: list[type[Nowcaster]] = [WNN, NinoMLP]
    networks = [NowcasterFit(kind, config, seed=seed, training=training) for kind in kinds]
    fittings: list[RegressionFit | NowcasterFit[Nowcaster]] = [*linear, *networks]
    for run, trajectory in samples(runs, seed):
        for fitting in fittings:
            fitting.add(trajectory)
        say(f"read {run.id}")
    for run, trajectory in samples(validation_runs or [], seed + 1):
        for network in networks:
            network.add(trajectory, validation=True)
        say(f"read {run.id}, for validation")
    ladder = list(_WITHOUT_FIT)
    for fitting in fittings:
        ladder.append(fitting.finish())
        say(f"fitted {fitting.name}")
    return ladder


def save_ladder(
    forecasters: Iterable[Forecaster],
    folder: str | Path,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write each forecaster into a folder of its name.

    Args:
        forecasters: fitted ones.
        folder: of all.
        settings: how they were fitted, and to what, for ``train.json``; None: not told.
    """
    for forecaster in forecasters:
        out = Path(folder) / forecaster.name
        forecaster.save(out)
        if settings is not None:
            (out / "train.json").write_text(json.dumps(settings, indent=1), encoding="utf-8")


__all__ = ["by_name", "fit_ladder", "names", "save_ladder"]
