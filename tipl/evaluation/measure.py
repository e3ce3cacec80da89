"""Everything that is measured on one run: an engine's task."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tipl.errors import ForecastError
from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.parts import Arrays, Parts, run_source
from tipl.evaluation.returns import FRESH, MODES, Player, forecast_returns, true_returns
from tipl.evaluation.starts import Starts, at_boundary, starts_of
from tipl.evaluation.weights import Tick, divergences, squared_errors
from tipl.forecaster import Forecaster
from tipl.saved import fingerprint
from tipl.threads import threads
from weighttraj import Place, Run, open_run
from weighttraj.engine import Tell


@dataclass(frozen=True, kw_only=True)
class Task:
    """One run on which forecasters are evaluated."""

    path: Place
    """The run."""
    forecasters: tuple[Forecaster, ...]
    """The forecasters; the first one is persistence."""
    config: EvaluateConfig
    """What is measured, and how much of it."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What was measured on one run."""

    run: str
    """Id of the run."""
    starts: Starts
    """Where forecasts started."""
    boundary: np.ndarray
    """bool (start,): whether the next step of a start for weights crosses into an iteration."""
    function_starts: np.ndarray
    """int (start,): the starts for divergences."""
    function_boundary: np.ndarray
    """bool (start,): ``boundary`` of these starts."""
    tensors: np.ndarray
    """int (tensor,): number of parameters of each."""
    weights: dict[str, Arrays]
    """``squared`` by forecaster."""
    functions: dict[str, Arrays]
    """``kl`` by forecaster; empty without observations."""
    true: Arrays
    """``now``, ``later`` and ``fresh``; empty without returns."""
    returns: dict[str, Arrays]
    """``forecast`` by forecaster."""
    failed: dict[str, str] = field(default_factory=dict)
    """Why a forecaster could not be evaluated."""


def measure(task: Task, tell: Tell) -> Measured:
    """Measure what is not stored yet.

    ``tell`` is called with what was done ("weights", "policies" or "returns") and how much of it.
    """
    with threads(), _Measurement(task, tell) as measurement:
        return measurement.all()


def function_starts(starts: Starts, config: EvaluateConfig) -> np.ndarray:
    """Return some of the starts for weights, evenly spaced."""
    count = min(config.function_starts, len(starts.weights))
    chosen = np.linspace(0, len(starts.weights) - 1, count).round().astype(int)
    return np.asarray(starts.weights[np.unique(chosen)])


class _Measurement(contextlib.ExitStack):
    def __init__(self, task: Task, tell: Tell) -> None:
        super().__init__()
        self._task, self._config, self._tell = task, task.config, tell
        self._run: Run = open_run(task.path)
        self._parts = Parts(task.config.out / "parts")
        self._starts = starts_of(self._run, task.config)
        self._return_starts = np.concatenate([self._starts.learning, self._starts.plateau])
        self._marks = {f.name: fingerprint(f) for f in task.forecasters}
        self._players: dict[int, Player] = {}

    def all(self) -> Measured:
        """Measure everything."""
        starts, config, forecasters = self._starts, self._config, self._task.forecasters
        chosen = function_starts(starts, config)
        weights, functions, returns, failed = {}, {}, {}, {}
        with_returns = config.learning_starts > 0
        for forecaster in forecasters:
            name = forecaster.name
            try:
                weights[name] = self._errors("weights", forecaster, starts.weights, squared_errors)
                if len(chosen):
                    functions[name] = self._errors("policies", forecaster, chosen, divergences)
                if with_returns:
                    returns[name] = self._returns(forecaster)
            except ForecastError as error:
                failed[name] = str(error)
        return Measured(
            run=self._run.id,
            starts=starts,
            boundary=at_boundary(self._run, starts.weights),
            function_starts=chosen,
            function_boundary=at_boundary(self._run, chosen),
            tensors=np.array([param.size for param in self._run.layout.params]),
            weights=weights,
            functions=functions,
            true=self._true() if with_returns else {},
            returns=returns,
            failed=failed,
        )

    def _errors(
        self, what: str, forecaster: Forecaster, starts: np.ndarray, function: Callable[..., Arrays]
    ) -> Arrays:
        horizons = self._config.horizons
        return self._kept(
            f"{what}/{forecaster.name}",
            {
                "forecaster": self._marks[forecaster.name],
                "starts": starts.tolist(),
                "horizons": list(horizons),
            },
            lambda tick: function(forecaster, self._run, starts, horizons, tick),
            what,
            len(starts),
        )

    def _true(self) -> Arrays:
        starts, config, run = self._return_starts, self._config, self._run
        horizons = config.return_horizons

        def play(tick: Tick) -> Arrays:
            found = true_returns(self._player(config.seed), run, starts, horizons, tick)
            fresh = self._player(config.seed + FRESH)
            again = true_returns(fresh, run, starts, horizons[:1], lambda _: None)
            return found | {"fresh": again["later"]}

        count = len(MODES) * len(starts) * (1 + len(horizons))
        return self._kept("returns/true", self._played(), play, "returns", count)

    def _returns(self, forecaster: Forecaster) -> Arrays:
        starts, horizons = self._return_starts, self._config.return_horizons

        def play(tick: Tick) -> Arrays:
            player = self._player(self._config.seed)
            return forecast_returns(forecaster, player, self._run, starts, horizons, tick)

        return self._kept(
            f"returns/{forecaster.name}",
            self._played() | {"forecaster": self._marks[forecaster.name]},
            play,
            "returns",
            len(MODES) * len(starts) * len(horizons),
        )

    def _played(self) -> dict[str, Any]:
        """Return what all returns depend on."""
        config = self._config
        return {
            "starts": self._return_starts.tolist(),
            "horizons": list(config.return_horizons),
            "episodes": config.episodes,
            "seed": config.seed,
        }

    def _kept(
        self,
        name: str,
        source: dict[str, Any],
        measure: Callable[[Tick], Arrays],
        what: str,
        work: int,
    ) -> Arrays:
        """Return stored arrays, or measure them now; report the same work in both cases."""
        done: list[int] = []

        def tick(some: int) -> None:
            done.append(some)
            self._tell(what, some)

        name, source = f"{name}/{self._run.id}", run_source(self._run) | source
        arrays = self._parts.get(name, source, lambda: measure(tick))
        self._tell(what, work - sum(done))
        return arrays

    def _player(self, seed: int) -> Player:
        if seed not in self._players:
            player = Player(self._run, self._config.episodes, seed)
            self._players[seed] = self.enter_context(player)
        return self._players[seed]
