"""Judges forecasters on runs that they have not seen."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console
from rich.progress import Progress

import weighttraj as wt
from tipl.baselines import Persistence, Reconstruction
from tipl.errors import EvaluateError
from tipl.forecast import TIPL, Forecaster
from tipl.report import write_report
from weighttraj.policies import Evaluator, PolicyBatch, env_of, load_policies

Mode = Literal["deterministic", "sampled"]
MAX_BYTES = 256 * 2**20
"""Memory for the forecasts of one chunk of starts."""


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """One evaluation."""

    data: Path
    """Data set."""
    out: Path
    """Folder of the results."""
    split: Literal["train", "validation", "test"] = "test"
    """Runs that are judged on."""
    max_horizon: int = 10
    """Forecast steps 1, 2, ..., this many."""
    return_starts: int = 8
    """Starts, evenly spaced over each run, from which returns are compared."""
    episodes: int = 10
    """Episodes for the return of one policy."""
    modes: tuple[Mode, ...] = ("deterministic", "sampled")
    """How the policies act when their return is measured."""
    bootstrap: int = 2_000
    """Resamples of the runs for intervals."""
    seed: int = 0
    """Seed of episodes and resamples."""


@dataclass(frozen=True)
class _Errors:
    """Summed squared errors of one forecaster on one run, each (horizon,)."""

    forecast: Float[np.ndarray, " horizon"]
    copy: Float[np.ndarray, " horizon"]
    count: int


def evaluate(
    models: Sequence[TIPL], config: EvaluateConfig, *, console: Console | None = None
) -> dict[str, Any]:
    """Judge models beside persistence and their reconstruction floor; writes results and a page.

    Writes ``results.json``, ``report.html`` and a figure for each action mode into ``config.out``.

    Returns:
        What ``results.json`` holds.

    Raises:
        EvaluateError: the runs are too short, or two forecasters have one name.
    """
    runs = wt.open_dataset(config.data).split(config.split).runs
    horizons = np.arange(1, config.max_horizon + 1)
    shortest = min(len(run) for run in runs)
    if shortest <= config.max_horizon:
        raise EvaluateError(
            "a run is too short to be forecast",
            expected=f"more than {config.max_horizon} snapshots",
            got=shortest,
            where=config.data,
            do="lower --max-horizon, or collect longer runs",
        )
    floors = [Reconstruction(rank) for rank in sorted({m.config.gpt.rank for m in models})]
    forecasters: list[Forecaster] = [Persistence(), *models, *floors]
    with Progress(console=console or Console(quiet=True)) as progress:
        errors = _all_errors(forecasters, runs, horizons, progress)
        returns = _all_returns(forecasters, runs, horizons, config, progress)
    results = _summary(forecasters, runs, horizons, config, errors, returns)
    config.out.mkdir(parents=True, exist_ok=True)
    (config.out / "results.json").write_text(json.dumps(results, indent=1))
    write_report(results, config.out)
    return results


def squared_errors(
    forecaster: Forecaster,
    run: wt.Run,
    weights: Float[np.ndarray, "time param"],
    horizons: Int[np.ndarray, " horizon"],
) -> _Errors:
    """Summed squared errors over every start that has all horizons after it."""
    starts = np.arange(len(run) - max(horizons))
    chunk = max(1, MAX_BYTES // (weights.shape[1] * len(horizons) * 4))
    forecast, copy = np.zeros(len(horizons)), np.zeros(len(horizons))
    for first in range(0, len(starts), chunk):
        part = starts[first : first + chunk]
        truth = weights[part[:, None] + horizons].astype(np.float64)
        predicted = forecaster.forecast(run, part.tolist(), horizons.tolist())
        forecast += ((predicted - truth) ** 2).sum((0, 2))
        copy += ((weights[part][:, None] - truth) ** 2).sum((0, 2))
    return _Errors(forecast, copy, len(starts) * weights.shape[1])


def skill_with_interval(
    errors: Sequence[_Errors], *, resamples: int, seed: int
) -> list[dict[str, float | None]]:
    """Skill at each horizon, ``1 - sum |error|^2 / sum |copy's error|^2``, over all runs.

    The interval is the 95 % bootstrap over *runs*; None with fewer than two.
    """
    forecast = np.stack([e.forecast for e in errors])  # (run, horizon)
    copy = np.stack([e.copy for e in errors])
    value = 1 - forecast.sum(0) / copy.sum(0)
    low: list[float | None] = [None] * len(value)
    high = list(low)
    if len(errors) > 1:
        pick = np.random.default_rng(seed).integers(len(errors), size=(resamples, len(errors)))
        drawn = 1 - forecast[pick].sum(1) / copy[pick].sum(1)  # (resample, horizon)
        low, high = np.quantile(drawn, [0.025, 0.975], axis=0).tolist()
    return [
        {"value": float(v), "low": a, "high": b} for v, a, b in zip(value, low, high, strict=True)
    ]


def _all_errors(
    forecasters: Sequence[Forecaster],
    runs: Sequence[wt.Run],
    horizons: Int[np.ndarray, " horizon"],
    progress: Progress,
) -> dict[str, list[_Errors]]:
    errors: dict[str, list[_Errors]] = {f.name: [] for f in forecasters}
    if len(errors) < len(forecasters):
        raise EvaluateError(
            "two forecasters have the same name",
            got=[f.name for f in forecasters],
            do="a model is named after its folder: rename one",
        )
    bar = progress.add_task("weights", total=len(runs) * len(forecasters))
    for run in runs:
        weights = run.weights[:]
        for forecaster in forecasters:
            errors[forecaster.name].append(squared_errors(forecaster, run, weights, horizons))
            progress.advance(bar)
    return errors


@dataclass(frozen=True)
class _Returns:
    """Mean returns on one run in one action mode; forecasts' is (forecaster, start, horizon)."""

    true: Float[np.ndarray, "start horizon"]
    again: Float[np.ndarray, "start horizon"]
    forecast: dict[str, Float[np.ndarray, "start horizon"]]


def _all_returns(
    forecasters: Sequence[Forecaster],
    runs: Sequence[wt.Run],
    horizons: Int[np.ndarray, " horizon"],
    config: EvaluateConfig,
    progress: Progress,
) -> dict[str, list[_Returns]]:
    """Returns of true and forecast policies, by action mode, run by run."""
    found: dict[str, list[_Returns]] = {mode: [] for mode in config.modes}
    starts = config.return_starts * len(horizons)
    policies = starts * (1 + len(forecasters))
    bar = progress.add_task("returns", total=len(runs) * len(config.modes) * policies)
    for run in runs:
        env = env_of(run)
        with (
            Evaluator(env, episodes=config.episodes, seed=config.seed) as evaluator,
            Evaluator(env, episodes=config.episodes, seed=config.seed + 10_000) as fresh,
        ):
            for mode in config.modes:
                scorer = _Scorer(evaluator, fresh, mode == "deterministic", progress, bar)
                found[mode].append(_returns_of_run(forecasters, run, horizons, config, scorer))
    return found


class _Scorer:
    """Mean returns of policies; equal weights are played once."""

    def __init__(
        self,
        evaluator: Evaluator,
        fresh: Evaluator,
        deterministic: bool,
        progress: Progress,
        bar: Any,
    ) -> None:
        self._evaluators = {"same": evaluator, "fresh": fresh}
        self._deterministic = deterministic
        self._progress, self._bar = progress, bar
        self._known: dict[tuple[str, bytes], float] = {}

    def __call__(self, policies: PolicyBatch, episodes: str = "same") -> np.ndarray:
        """Mean returns, (policy,)."""
        keys = [(episodes, key) for key in _keys(policies)]
        rows = {key: row for row, key in enumerate(keys) if key not in self._known}
        if rows:
            some = policies[list(rows.values())]
            played = self._evaluators[episodes](some, deterministic=self._deterministic)
            self._known |= dict(zip(rows, played.returns.mean(1).tolist(), strict=True))
        self._progress.advance(self._bar, len(policies))
        return np.array([self._known[key] for key in keys])


def _keys(policies: PolicyBatch) -> list[bytes]:
    """What tells one policy from another: its weights and its normaliser."""
    parts = [x for x in (policies.weights, policies.mean, policies.var) if x is not None]
    return [b"".join([part[row].tobytes() for part in parts]) for row in range(len(policies))]


def _returns_of_run(
    forecasters: Sequence[Forecaster],
    run: wt.Run,
    horizons: Int[np.ndarray, " horizon"],
    config: EvaluateConfig,
    score: _Scorer,
) -> _Returns:
    starts = np.linspace(0, len(run) - 1 - max(horizons), config.return_starts).astype(int)
    shape = (len(starts), len(horizons))
    later = load_policies(run, (starts[:, None] + horizons).ravel())
    # A forecast acts with the normaliser of its start: the later one is the future's.
    now = load_policies(run, np.repeat(starts, len(horizons)))
    again, edge = np.full(shape, np.nan), np.zeros(shape, bool)
    edge[0] = edge[:, 0] = True
    again[edge] = score(later[edge.ravel()], "fresh")
    true = score(later).reshape(shape)
    by_name = {}
    for forecaster in forecasters:
        weights = forecaster.forecast(run, starts.tolist(), horizons.tolist())
        base = later if isinstance(forecaster, Reconstruction) else now
        policies = base.with_weights(weights.reshape(len(base), -1))
        by_name[forecaster.name] = score(policies).reshape(shape)
    return _Returns(true, again, by_name)


def _summary(
    forecasters: Sequence[Forecaster],
    runs: Sequence[wt.Run],
    horizons: Int[np.ndarray, " horizon"],
    config: EvaluateConfig,
    errors: dict[str, list[_Errors]],
    returns: dict[str, list[_Returns]],
) -> dict[str, Any]:
    hs = horizons.tolist()
    by_name: dict[str, Any] = {}
    for forecaster in forecasters:
        name = forecaster.name
        skill = skill_with_interval(errors[name], resamples=config.bootstrap, seed=config.seed)
        summed = np.sum([e.forecast for e in errors[name]], axis=0)
        wpe = (summed / sum(e.count for e in errors[name])).tolist()
        by_name[name] = {
            "causal": forecaster.causal,
            "floor": isinstance(forecaster, Reconstruction),
            "skill": [{"h": h, **row} for h, row in zip(hs, skill, strict=True)],
            "wpe": [{"h": h, "value": v} for h, v in zip(hs, wpe, strict=True)],
            "repw": {m: _repw(name, hs, found) for m, found in returns.items()},
            "returns": {m: _scatter(name, runs, found) for m, found in returns.items()},
        }
    noise = {
        mode: float(np.nanmean(np.concatenate([np.abs(r.true - r.again) for r in found])))
        for mode, found in returns.items()
    }
    return {
        "data": wt.open_dataset(config.data).info.id,
        "split": config.split,
        "runs": [run.id for run in runs],
        "horizons": hs,
        "modes": list(config.modes),
        "episodes": config.episodes,
        "seed": config.seed,
        "n_starts": sum(len(run) - max(hs) for run in runs),
        "n_return_starts": config.return_starts * len(runs),
        "noise_floor": noise,
        "forecasters": by_name,
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }


def _repw(name: str, horizons: list[int], found: Sequence[_Returns]) -> list[dict[str, float]]:
    """Mean over starts and runs of |J(true) - J(forecast)|, by horizon."""
    gaps = np.concatenate([np.abs(r.true - r.forecast[name]) for r in found])
    return [{"h": h, "value": float(v)} for h, v in zip(horizons, gaps.mean(0), strict=True)]


def _scatter(name: str, runs: Sequence[wt.Run], found: Sequence[_Returns]) -> list[dict[str, Any]]:
    return [
        {
            "run": run.id,
            "true": r.true.reshape(-1).tolist(),
            "forecast": r.forecast[name].reshape(-1).tolist(),
        }
        for run, r in zip(runs, found, strict=True)
    ]
