"""Chooses how far a forecast is followed, by returns of forecast policies on validation runs."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

import weighttraj as wt
from tipl.baselines.horizons import fitted, rows_of
from tipl.drift.forecaster import Drift, Further
from tipl.errors import TrainError
from tipl.evaluation import EvaluateConfig
from tipl.evaluation.parts import Arrays, Parts, fingerprint, run_source
from tipl.evaluation.returns import Player, forecast_returns, true_returns
from tipl.evaluation.starts import starts_of
from tipl.forecast import Forecaster
from tipl.gate import Gate
from tipl.prepare import digest_of
from tipl.settings import check_settings
from tipl.state import keep_settings
from tipl.threads import threads
from weighttraj.progress import LoggedProgress

MODE = "held"
"""How policies act while amplitudes are chosen: samples, with the noise of the start."""


@dataclass(frozen=True, kw_only=True)
class DriftConfig:
    """One choice of amplitudes."""

    along: str | Path
    """What is followed: folder of a trained tipl-gate. Or another forecaster, by folder or name."""
    data: str | Path
    """Data set: a path or an id. Its validation runs, which need returns, choose."""
    out: Path
    """Folder of the model. What was measured before an interruption is kept there."""
    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 50, 100)
    """Snapshots ahead to choose for; other horizons take what lies between."""
    amplitudes: tuple[float, ...] = (1, 1.5, 2, 3, 4, 6, 8)
    """Factors to choose from."""
    starts: int = 6
    """Starts in the learning phase of each run."""
    episodes: int = 10
    """Of each policy, the same seeds for all."""
    seed: int = 0
    """Of the first episode."""


def train_drift(config: DriftConfig, *, console: Console | None = None) -> Drift | Further:
    """Choose an amplitude for each horizon: the one with the highest inference gain.

    The gain is that of ``tipl evaluate``: how much the forecast adds to the return, as a share of
    what training adds until then, summed over starts and runs. At equal gain the shorter one.

    Args:
        config: along which forecast, on what, and how much.
        console: where progress is shown; None: nowhere.

    Returns:
        tipl-drift if a tipl-gate is followed, else a rival of it.

    Raises:
        TrainError: there are no validation runs, or they do not learn; there are no factors; or the
            folder holds another choice.
        ForecastError: there is no such forecaster, or it makes no forecast for such a horizon.
        EvaluateError: the runs have no returns, or are too short.
    """
    from tipl.zoo.lookup import load

    numbers = dict.fromkeys(("horizons", "starts", "episodes"), 1) | {"seed": 0}
    check_settings(vars(config), numbers, TrainError)
    along, horizons = load(config.along), fitted(config.horizons)
    if isinstance(along, Gate):
        rows_of(along.config.network.horizons, horizons, along.name)
    runs = [run for run in wt.open_dataset(config.data) if run.split == "validation"]
    _check(config, runs)
    settings = asdict(config) | {
        "along": fingerprint(along),
        "chosen_on": str(config.data),
        "validation": {run.id: digest_of(run) for run in runs},
        "out": str(config.out),
        **_trained_on(Path(config.along)),
    }
    keep_settings(config.out, settings, ("out", "data", "chosen_on", "of_gate"), config)
    parts, factors = Parts(config.out / "parts"), tuple(sorted(config.amplitudes))
    console = console or Console(quiet=True)
    columns = (
        TextColumn("validation runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with LoggedProgress(*columns, console=console, disable=console.quiet) as progress:
        measured = [
            parts.get(run.id, _source(settings, run), lambda run=run: _measure(along, run, config))  # type: ignore[misc]
            for run in progress.track(runs)
        ]
    gains = gains_of(measured)
    best = [factors[row] for row in np.argmax(gains, axis=0)]
    followed = _followed(along, dict(zip(horizons, best, strict=True)), config.out.name)
    followed.save(config.out)
    lines = [
        {"amplitude": factor} | {f"gain_{h}": gain for h, gain in zip(horizons, row, strict=True)}
        for factor, row in zip(factors, gains.tolist(), strict=True)
    ]
    (config.out / "log.jsonl").write_text(
        "".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8"
    )
    return followed


def gains_of(measured: Sequence[Arrays]) -> Float64[np.ndarray, "amplitude horizon"]:
    """Inference gain of each amplitude, of sums over runs.

    Args:
        measured: of each run ``forecast``, what the forecasts of each amplitude add to the return,
            and ``training``, what training adds, summed over starts.

    Raises:
        TrainError: training adds nothing.
    """
    added = np.sum([one["forecast"] for one in measured], axis=0)
    by_training = np.sum([one["training"] for one in measured], axis=0)
    if not (by_training > 0).all():
        raise TrainError(
            "training adds nothing to the return, so no amplitude is better than another",
            expected="validation runs that learn over each horizon",
            got=f"{by_training.tolist()}, the sums over starts",
            do="choose other --horizons, more --starts or --episodes, or runs that learn",
        )
    gains: Float64[np.ndarray, "amplitude horizon"] = added / by_training
    return gains


def _followed(
    along: Forecaster, amplitudes: dict[int, float], name: str = "followed"
) -> Drift | Further:
    """A forecast that is followed so far; between these horizons, along lines in log h."""
    if not isinstance(along, Gate):
        return Further(along, amplitudes, name)
    known = along.config.network.horizons
    every = np.interp(np.log(known), np.log(list(amplitudes)), list(amplitudes.values()))
    return Drift(along, dict(zip(known, every.tolist(), strict=True)), name)


def _trained_on(along: Path) -> dict[str, Any]:
    """The data sets and runs that the network was trained on, and how, where its folder says so."""
    file = along / "train.json"
    settings = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    data, runs = settings.pop("data", None), settings.pop("runs", None)
    settings.pop("out", None)
    return {"data": data, "runs": runs, "of_gate": settings}


def _check(config: DriftConfig, runs: Sequence[wt.Run]) -> None:
    if not runs:
        raise TrainError(
            "there is nothing to choose amplitudes by",
            expected="runs in the validation split",
            where=config.data,
            do="move some runs there",
        )
    if not config.amplitudes or min(config.amplitudes) <= 0:
        raise TrainError(
            "there are no amplitudes to choose from",
            expected="factors above 0",
            got=config.amplitudes,
            do="choose other --amplitudes",
        )


def _source(settings: dict[str, Any], run: wt.Run) -> dict[str, Any]:
    ours = ("along", "horizons", "amplitudes", "starts", "episodes", "seed")
    return {name: settings[name] for name in ours} | run_source(run)


def _measure(along: Forecaster, run: wt.Run, config: DriftConfig) -> Arrays:
    horizons = fitted(config.horizons)
    protocol = EvaluateConfig(
        data=config.data,
        out=Path(os.devnull),
        horizons=horizons,
        return_horizons=horizons,
        learning_starts=config.starts,
        plateau_starts=0,
    )
    starts = starts_of(run, protocol).learning
    modes = (MODE,)

    def quiet(_: int) -> None:
        """Progress is shown by runs."""

    with threads(), Player(run, config.episodes, config.seed, modes=modes) as player:
        true = true_returns(player, run, starts, horizons, quiet)
        now = true["now"][0, :, None]
        added = []
        for factor in sorted(config.amplitudes):
            followed = _followed(along, dict.fromkeys(horizons, factor))
            found = forecast_returns(followed, player, run, starts, horizons, quiet)["forecast"][0]
            added.append((found - now).sum(0))
    return {"forecast": np.stack(added), "training": (true["later"][0] - now).sum(0)}


__all__ = ["MODE", "DriftConfig", "gains_of", "train_drift"]
