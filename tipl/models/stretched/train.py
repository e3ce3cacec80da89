"""Chooses the factors of a stretched forecast by returns of its policies on validation runs."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

import weighttraj as wt
from tipl.checks.copies import RefitConfig
from tipl.errors import TrainError
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.parts import Arrays, Parts, run_source
from tipl.evaluation.returns import Player, forecast_returns, true_returns
from tipl.evaluation.starts import starts_of
from tipl.forecaster import Forecaster
from tipl.horizons import fitted, rows_of
from tipl.models.gate.forecaster import Gate
from tipl.models.gate.train import refit as refit_gate
from tipl.models.stretched.forecaster import Stretched, StretchedGate
from tipl.registry import load
from tipl.runs import checksum_of, fault_of, weights_of, without_faults
from tipl.saved import fingerprint
from tipl.settings import check_settings
from tipl.threads import threads
from tipl.training.checkpoint import keep_settings
from tipl.training.config import flat
from weighttraj.progress import LoggedProgress

MODE = "held"
"""How policies act while amplitudes are chosen: samples, with the noise of the start."""


@dataclass(frozen=True, kw_only=True)
class StretchedTrainConfig:
    """What is stretched, what chooses, and where the model goes."""

    along: str | Path
    """Forecaster to stretch: the folder of a trained tipl-gate, or another forecaster by folder or
    name."""
    data: str | Path
    """Data set: a path or an id. Its validation runs, which need returns, choose."""
    out: Path
    """Folder of the model. What was measured before an interruption is kept there."""
    horizons: tuple[int, ...] = (1, 2, 5, 10, 20, 50, 100)
    """Numbers of snapshots ahead to choose for; other horizons are interpolated."""
    amplitudes: tuple[float, ...] = (1, 1.5, 2, 3, 4, 6, 8)
    """Factors to choose from."""
    starts: int = 6
    """Number of starts in the learning phase of each run."""
    episodes: int = 10
    """Number of episodes of each policy, the same seeds for all."""
    seed: int = 0
    """Seed of the first episode."""

    def check(self) -> None:
        """Refuse numbers that leave nothing to choose."""
        numbers = dict.fromkeys(("horizons", "starts", "episodes"), 1) | {"seed": 0}
        check_settings(vars(self), numbers, TrainError)
        if not self.amplitudes or min(self.amplitudes) <= 0:
            raise TrainError(
                "there are no amplitudes to choose from",
                expected="factors above 0",
                got=self.amplitudes,
                do="choose other --amplitudes",
            )


def train_stretched(
    config: StretchedTrainConfig, *, console: Console | None = None
) -> StretchedGate | Stretched:
    """Stretch a model's forecasts: choose for each horizon the factor that gains most return.

    The inference gain on validation runs decides: how much the forecast adds to the return, as a
    share of what training adds until then, summed over starts and runs. At equal gain the smaller
    factor is taken. Policies are evaluated in the environment, which takes minutes.

    Example: tipl train stretched --along tipl-gate --data hopper-v4-ppo-16x16-v1 --out data/mine

    Returns:
        A ``StretchedGate`` if a tipl-gate is stretched, else a ``Stretched``.

    Raises:
        TrainError: there are no validation runs, or they do not learn; there are no factors; or the
            folder holds another choice.
        ForecastError: there is no such forecaster, or it makes no forecast for such a horizon.
        EvaluateError: the runs have no returns, or are too short.
    """
    config.check()
    along, horizons = load(config.along), fitted(config.horizons)
    if isinstance(along, Gate):
        rows_of(along.config.network.horizons, horizons, along.name)
    runs = _validation_runs(config.data)
    settings = _settings(config, along, runs)
    keep_settings(config.out, settings, ("out", "data", "chosen_on", "of_gate"))
    measured = _measure_all(config, along, runs, settings, console or Console(quiet=True))
    gains, factors = gains_of(measured), sorted(config.amplitudes)
    best = [factors[row] for row in np.argmax(gains, axis=0)]
    stretched = _stretched(along, dict(zip(horizons, best, strict=True)), config.out.name)
    stretched.save(config.out)
    lines = [
        {"amplitude": factor} | {f"gain_{h}": gain for h, gain in zip(horizons, row, strict=True)}
        for factor, row in zip(factors, gains.tolist(), strict=True)
    ]
    (config.out / "log.jsonl").write_text(
        "".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8"
    )
    return stretched


def _measure_all(
    config: StretchedTrainConfig,
    along: Forecaster,
    runs: Sequence[wt.Run],
    settings: dict[str, Any],
    console: Console,
) -> list[Arrays]:
    """Return what was measured on each run; what is there already is not measured again."""
    parts = Parts(config.out / "parts")
    columns = (
        TextColumn("validation runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with LoggedProgress(*columns, console=console) as progress:
        return [
            parts.get(run.id, _source(settings, run), partial(_measure, along, run, config))
            for run in progress.track(runs)
        ]


def _settings(
    config: StretchedTrainConfig, along: Forecaster, runs: Sequence[wt.Run]
) -> dict[str, Any]:
    """Return what train.json says of the choice."""
    return flat(config) | {
        "along": fingerprint(along),
        "chosen_on": str(config.data),
        "validation": {run.id: checksum_of(run) for run in runs},
        **_trained_on(Path(config.along)),
    }


def gains_of(measured: Sequence[Arrays]) -> Float64[np.ndarray, "amplitude horizon"]:
    """Return the inference gain of each amplitude, from sums over runs.

    For each run, ``forecast`` is what the forecasts of each amplitude add to the return, and
    ``training`` what training adds, summed over starts.
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


def _stretched(
    along: Forecaster, amplitudes: dict[int, float], name: str = "stretched"
) -> StretchedGate | Stretched:
    """Return a stretched forecast; between these horizons, amplitudes are linear in log h."""
    if not isinstance(along, Gate):
        return Stretched(along, amplitudes, name)
    known = along.config.network.horizons
    every = np.interp(np.log(known), np.log(list(amplitudes)), list(amplitudes.values()))
    return StretchedGate(along, dict(zip(known, every.tolist(), strict=True)), name)


def _trained_on(along: Path) -> dict[str, Any]:
    """Return the data sets and runs that the network was trained on, and how, if recorded."""
    file = along / "train.json"
    settings = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    data, runs = settings.pop("data", None), settings.pop("runs", None)
    settings.pop("out", None)
    return {"data": data, "runs": runs, "of_gate": settings}


def _validation_runs(data: str | Path) -> list[wt.Run]:
    runs = [run for run in wt.open_dataset(data) if run.split == "validation"]
    runs, _ = without_faults(runs, lambda run: fault_of(weights_of(run)))
    if not runs:
        raise TrainError(
            "there is nothing to choose amplitudes by",
            expected="runs in the validation split",
            where=data,
            do="move some runs there",
        )
    return runs


def _source(settings: dict[str, Any], run: wt.Run) -> dict[str, Any]:
    ours = ("along", "horizons", "amplitudes", "starts", "episodes", "seed")
    return {name: settings[name] for name in ours} | run_source(run)


def _measure(along: Forecaster, run: wt.Run, config: StretchedTrainConfig) -> Arrays:
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
            stretched = _stretched(along, dict.fromkeys(horizons, factor))
            found = forecast_returns(stretched, player, run, starts, horizons, quiet)["forecast"][0]
            added.append((found - now).sum(0))
    return {"forecast": np.stack(added), "training": (true["later"][0] - now).sum(0)}


def refit(old: StretchedGate, runs: Sequence[wt.Run], config: RefitConfig) -> StretchedGate:
    """Train another gate on other runs, for the null check; the amplitudes stay the same.

    Random walks have no returns to choose others by.
    """
    horizons = tuple(h for h in config.horizons if h in old.amplitudes)
    gate = refit_gate(old.gate, runs, replace(config, horizons=horizons))
    return StretchedGate(gate, {h: old.amplitudes[h] for h in horizons})
