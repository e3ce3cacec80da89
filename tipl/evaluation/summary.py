"""From measurements on each run to the figures that are reported."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.measure import Measured
from tipl.evaluation.results import GainRow, Interval, Points, Row, Rows, Scores
from tipl.evaluation.returns import MODES
from tipl.evaluation.starts import shares
from tipl.evaluation.statistics import (
    Bootstrap,
    interquartile_mean,
    mean,
    quotient,
    ratio_of_sums,
)
from tipl.forecaster import Forecaster
from tipl.saved import fingerprint

KINDS = ("all", "within", "boundary")
"""Kinds of starts: all; next step within the iteration; next step in a new one."""
AGGREGATES = ("ratio_of_sums", "mean_of_ratios", "tensors_equal")
"""Skills: of the summed errors; mean over the starts' own skills; mean over tensors."""
PHASES = ("learning", "plateau")
NEAR = 10
"""The paper's horizons end here."""

Errors = Float[np.ndarray, "_start horizon tensor"]
Chosen = Bool[np.ndarray, " _start"]
Shares = Float[np.ndarray, " _start"]


class Summary:
    """Figures of forecasters over runs, beside those of the forecaster named ``persistence``."""

    def __init__(
        self, measured: Sequence[Measured], config: EvaluateConfig, persistence: str
    ) -> None:
        self._measured, self._config, self._copy = measured, config, persistence
        self._bootstrap = Bootstrap(resamples=config.bootstrap, seed=config.seed)

    def of(self, forecaster: Forecaster) -> Scores:
        """Return all figures of one forecaster."""
        name, some = forecaster.name, self._measured[0]
        return Scores(
            kind=forecaster.kind,
            causal=forecaster.causal,
            is_oracle=forecaster.is_oracle,
            fingerprint=fingerprint(forecaster),
            skill=self._skills(name),
            wpe=self._wpe(name),
            function_skill=self._function_skills(name) if some.functions else {},
            repw=self._repw(name) if some.true else {},
            repw_ratio=self._repw_ratio(name) if some.true else {},
            gain=self._gain(name) if some.true else {},
            scatter=self._scatter(name) if some.true else {},
        )

    def noise(self) -> dict[str, float]:
        """Return the mean difference of true returns over two sets of episodes, by mode."""
        gaps = [np.abs(m.true["later"][:, :, :1] - m.true["fresh"]) for m in self._measured]
        each = np.concatenate(gaps, axis=1).mean((1, 2))
        return dict(zip(MODES, each.tolist(), strict=True))

    def _skills(self, name: str) -> dict[str, dict[str, Rows]]:
        runs = [
            (
                m.weights[name]["squared"],
                m.weights[self._copy]["squared"],
                m.boundary,
                shares(m.starts.weights),
            )
            for m in self._measured
        ]
        return {aggregate: self._by_kind(aggregate, runs) for aggregate in AGGREGATES}

    def _function_skills(self, name: str) -> dict[str, Rows]:
        runs = [
            (
                m.functions[name]["kl"][..., None],
                m.functions[self._copy]["kl"][..., None],
                m.function_boundary,
                shares(m.function_starts),
            )
            for m in self._measured
        ]
        return self._by_kind("ratio_of_sums", runs)

    def _by_kind(
        self, aggregate: str, runs: Sequence[tuple[Errors, Errors, Chosen, Shares]]
    ) -> dict[str, Rows]:
        """Return a skill over each kind of start; runs may have different starts."""
        found = {}
        for kind in KINDS:
            each = [
                _summed(aggregate, error, copy, share * _of_kind(kind, boundary))
                for error, copy, boundary, share in runs
            ]
            samples = (np.stack(part) for part in zip(*each, strict=True))
            found[kind] = self._rows(self._config.horizons, _SKILLS[aggregate], *samples)
        return found

    def _wpe(self, name: str) -> Rows:
        size = self._measured[0].tensors.sum()
        each = [
            np.average(m.weights[name]["squared"].sum(2), axis=0, weights=shares(m.starts.weights))
            / size
            for m in self._measured
        ]
        return self._rows(self._config.horizons, mean, np.stack(each))

    def _repw(self, name: str) -> dict[str, dict[str, Rows]]:
        """Return |J(true) - J(forecast)|, means over the starts of each run."""
        horizons = self._config.return_horizons
        return {
            mode: {
                phase: self._rows(horizons, mean, self._gaps(name, i, phase)) for phase in PHASES
            }
            for i, mode in enumerate(MODES)
        }

    def _repw_ratio(self, name: str) -> dict[str, Interval]:
        """Return REPW over persistence's while learning, summed over the paper's horizons.

        The interval is paired: it draws a run with the errors of both.
        """
        near = [i for i, h in enumerate(self._config.return_horizons) if h <= NEAR]
        found = {}
        for i, mode in enumerate(MODES):
            ours, copy = (
                self._gaps(each, i, "learning")[:, near].sum(1, keepdims=True)
                for each in (name, self._copy)
            )
            (cell,) = self._bootstrap.interval(ratio_of_sums, ours, copy)
            found[mode] = Interval(**cell)
        return found

    def _gaps(self, name: str, mode: int, phase: str) -> Float[np.ndarray, "run horizon"]:
        """Return REPW of each run: a mean over its starts, NaN where it has none."""
        arms = self._arms(name, mode, phase)
        return np.stack([_mean(np.abs(later - forecast)) for _, later, forecast in arms])

    def _gain(self, name: str) -> dict[str, tuple[GainRow, ...]]:
        """Return what a forecast earns of what training earns, over the learning phase."""
        found = {}
        for i, mode in enumerate(MODES):
            arms = list(self._arms(name, i, "learning"))
            earned = np.stack([(forecast - now[:, None]).sum(0) for now, _, forecast in arms])
            trained = np.stack([(later - now[:, None]).sum(0) for now, later, _ in arms])
            cells = self._bootstrap.interval(ratio_of_sums, earned, trained)
            now, later, forecast = (
                interquartile_mean(np.concatenate(arm))
                for arm in zip(
                    *((np.repeat(a[:, None], b.shape[1], 1), b, c) for a, b, c in arms),
                    strict=True,
                )
            )
            found[mode] = tuple(
                GainRow(
                    h=h,
                    now=float(now[j]),
                    later=float(later[j]),
                    forecast=float(forecast[j]),
                    **cells[j],
                )
                for j, h in enumerate(self._config.return_horizons)
            )
        return found

    def _scatter(self, name: str) -> dict[str, tuple[Points, ...]]:
        """Return the returns of true and forecast policies, for the paper's horizons."""
        near = [i for i, h in enumerate(self._config.return_horizons) if h <= NEAR]
        return {
            mode: tuple(
                Points(
                    run=m.run,
                    true=tuple(m.true["later"][i][:, near].round(1).ravel().tolist()),
                    forecast=tuple(
                        m.returns[name]["forecast"][i][:, near].round(1).ravel().tolist()
                    ),
                )
                for m in self._measured
            )
            for i, mode in enumerate(MODES)
            if mode != "held"
        }

    def _arms(self, name: str, mode: int, phase: str) -> Any:
        """Yield each run's returns: now (start,); later and forecast (start, horizon)."""
        for m in self._measured:
            n = len(m.starts.learning)
            part = slice(None, n) if phase == "learning" else slice(n, None)
            arms = m.true["now"], m.true["later"], m.returns[name]["forecast"]
            yield tuple(arm[mode][part] for arm in arms)

    def _rows(
        self, horizons: Sequence[int], statistic: Callable[..., np.ndarray], *samples: np.ndarray
    ) -> Rows:
        cells = self._bootstrap.interval(statistic, *samples)
        return tuple(Row(h=h, **cell) for h, cell in zip(horizons, cells, strict=True))


def _of_kind(kind: str, boundary: Chosen) -> Chosen:
    return {"all": np.ones_like(boundary), "within": ~boundary, "boundary": boundary}[kind]


def _summed(aggregate: str, error: Errors, copy: Errors, share: Shares) -> tuple[Any, ...]:
    """Return what a skill is computed from, for one run, so that runs can be drawn.

    ``copy`` are the errors of persistence; a start with a share of 0 is left out.
    """
    if aggregate == "mean_of_ratios":
        ratios = 1 - quotient(error.sum(2), copy.sum(2))
        known = np.isfinite(ratios)
        counts = np.where(known, share[:, None], 0.0)
        return (quotient((np.where(known, ratios, 0.0) * counts).sum(0), counts.sum(0)),)
    weight = share[:, None, None]
    sums = (np.where(weight > 0, weight * each, 0.0).sum(0) for each in (error, copy))
    if aggregate == "ratio_of_sums":
        return tuple(each.sum(1) for each in sums)
    return tuple(sums)


def _skill(error: np.ndarray, copy: np.ndarray) -> np.ndarray:
    return np.asarray(1 - ratio_of_sums(error, copy))


def _skill_of_tensors(error: np.ndarray, copy: np.ndarray) -> np.ndarray:
    each = 1 - ratio_of_sums(error, copy)  # (..., horizon, tensor); NaN: it never moves
    return mean(np.moveaxis(each, -1, 0))


_SKILLS: dict[str, Callable[..., np.ndarray]] = {
    "ratio_of_sums": _skill,
    "mean_of_ratios": mean,
    "tensors_equal": _skill_of_tensors,
}


def _mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over the first axis; NaN if it is empty."""
    return mean(values) if len(values) else np.full(values.shape[1:], np.nan)
