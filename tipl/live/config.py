"""When, how far and under which guard a training jumps, and what is written of each jump."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_type_hints

import msgspec
import numpy as np

from tipl.errors import ForecastError
from tipl.forecaster import Forecaster
from tipl.settings import check_settings

Guard = Literal["none", "batch", "rollout"]
"""How a jump is checked. ``batch``: before it is made, by KL divergence and surrogate on the last
rollout. ``rollout``: after the next rollout, by its mean return; a bad jump is undone."""


@dataclass(frozen=True, kw_only=True)
class JumpConfig:
    """When a training jumps, how far, and what happens to the optimizer."""

    horizon: int = 50
    """Number of snapshots ahead that is forecast."""
    schedule: Literal["constant", "falling"] | tuple[tuple[int, int], ...] = "constant"
    """``constant``: always ``horizon``. ``falling``: ``horizon`` times the share of the training
    that is still to come. Pairs (iteration, horizon): from each iteration on its horizon."""
    period: int = 1
    """Number of iterations from one jump to the next."""
    first: int = 2
    """First iteration that a jump may follow, counted from 1."""
    last: int | None = None
    """Last iteration that a jump may follow; unset: the last but one of the training."""
    amplitude: float = 1.0
    """Factor of the forecast displacement: 1 moves all the way, 0.5 half of it."""
    fade: bool = False
    """Whether the amplitude is multiplied by the share of the training that is still to come."""
    guard: Guard = "none"
    """How a jump is checked."""
    max_kl: float = 0.05
    """Largest KL divergence, in nats, of the policies before and after a jump that the guard
    ``batch`` accepts."""
    noise: float = 2.0
    """Number of standard errors by which the mean return must fall for the guard ``rollout`` to
    undo a jump."""
    episodes: int = 20
    """Number of training episodes before a jump whose mean return the guard ``rollout`` compares
    with."""
    moments: Literal["keep", "reset"] = "keep"
    """What happens to Adam's first moment of the moved parameters; ``reset`` sets it to 0."""
    log_std: bool = False
    """Whether a jump also moves ``log_std``, the logarithm of the exploration noise."""
    every: int | None = None
    """Number of gradient steps from one snapshot of the path to the next; unset: that of the runs
    that the forecaster was trained on, or 64."""

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(JumpConfig).items():
            try:
                value = getattr(self, name)
                msgspec.convert(value.item() if isinstance(value, np.generic) else value, kind)
            except msgspec.ValidationError as error:
                raise ForecastError(
                    "invalid settings of a jump",
                    expected=f"{name}: {error}",
                    got=repr(value),
                    do=f"change {name}",
                ) from error
        least = {"horizon": 1, "period": 1, "first": 1, "max_kl": 0, "noise": 0, "episodes": 2}
        check_settings(asdict(self), least, ForecastError)
        if self.every is not None:
            check_settings({"every": self.every}, {"every": 1}, ForecastError)
        last = self.first if self.last is None else self.last
        if not math.isfinite(self.amplitude) or last < self.first:
            raise ForecastError(
                "these settings make no jump",
                expected="a finite amplitude, and last at least first",
                got=f"amplitude {self.amplitude}, first {self.first}, last {self.last}",
                do="change them",
            )
        pairs = () if isinstance(self.schedule, str) else self.schedule
        if not isinstance(self.schedule, str) and not pairs:
            raise _no_schedule(self.schedule)
        if any(iteration < 0 or horizon < 1 for iteration, horizon in pairs):
            raise _no_schedule(self.schedule)

    def is_due(self, iteration: int) -> bool:
        """Say whether a jump follows an iteration, counted from 1."""
        last = iteration if self.last is None else self.last
        return self.first <= iteration <= last and (iteration - self.first) % self.period == 0

    def horizon_at(
        self, iteration: int, remaining: float, known: Sequence[int] | None
    ) -> int | None:
        """Return the horizon of a jump after an iteration; None: there is no jump.

        Args:
            iteration: counted from 1.
            remaining: share of the training that is still to come.
            known: horizons that the forecaster forecasts; None: any. The next one below is taken,
                or the shortest.
        """
        if self.schedule == "constant":
            wanted = float(self.horizon)
        elif self.schedule == "falling":
            wanted = self.horizon * remaining
        else:
            begun = [pair for pair in self.schedule if pair[0] <= iteration]
            if not begun:
                return None
            wanted = float(max(begun)[1])
        if known is None:
            return max(1, round(wanted))
        return max((h for h in known if h <= wanted), default=min(known))

    def amplitude_at(self, remaining: float) -> float:
        """Return the factor of the displacement."""
        return self.amplitude * remaining if self.fade else self.amplitude


@dataclass(kw_only=True)
class Jump:
    """What is written of one jump."""

    iteration: int
    """Iteration that it followed, counted from 1."""
    num_timesteps: int
    """Environment steps so far."""
    horizon: int
    """Number of snapshots ahead."""
    size: float
    """Euclidean norm of the displacement."""
    relative_size: float
    """The same over the norm of the last iteration's own displacement; 0: that was 0."""
    outcome: Literal["accepted", "refused", "undone"] = "accepted"
    """``refused``: the guard ``batch`` did not let it happen; ``undone``: the guard ``rollout``
    took it back."""


def known_horizons(forecaster: Forecaster) -> tuple[int, ...] | None:
    """Return the horizons that a forecaster was fitted for; None: it forecasts any."""
    fitted = _without_stretch(forecaster)
    config = getattr(fitted, "config", None)
    for place in (getattr(config, "network", None), config, fitted):
        if isinstance(found := getattr(place, "horizons", None), tuple) and found:
            return found
    return None


def known_every(forecaster: Forecaster) -> int | None:
    """Return the gradient steps between snapshots that a forecaster was fitted for; None: any."""
    found: int | None = getattr(
        getattr(_without_stretch(forecaster), "config", None), "every", None
    )
    return found


def _without_stretch(forecaster: Any) -> Any:
    """Return the forecaster whose displacement a stretched one makes longer, or itself."""
    for name in ("gate", "along"):
        if (inner := getattr(forecaster, name, None)) is not None:
            return _without_stretch(inner)
    return forecaster


def _no_schedule(got: object) -> ForecastError:
    return ForecastError(
        "the schedule of horizons is invalid",
        expected="constant, falling, or pairs (iteration from 0, horizon from 1), such as "
        "((2, 50), (40, 20))",
        got=got,
        do="change schedule",
    )
