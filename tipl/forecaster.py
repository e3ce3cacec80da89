"""The protocol that every forecaster follows. It knows no model, no evaluation and no publisher."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from tipl.errors import ForecastError, ModelError
from weighttraj import Run


@runtime_checkable
class Forecaster(Protocol):
    """Forecasts the weights of a policy some snapshots ahead.

    A subclass only needs ``name`` and ``forecast``; the other members have defaults.
    """

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        ...

    @property
    def kind(self) -> str:
        """Kind of the forecaster, which ``config.json`` of a saved one names."""
        return "other"

    @property
    def causal(self) -> bool:
        """Whether a forecast from t uses nothing that comes after t."""
        return True

    @property
    def is_oracle(self) -> bool:
        """Whether it reads the true future, and so is a bound and not a forecast."""
        return False

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return forecasts of phi_{t+h} for each start t and horizon h, from phi_0, ..., phi_t.

        Args:
            run: the run.
            starts: rows of ``run.weights``, from 0, in any order.
            horizons: numbers of snapshots ahead, from 1.

        Raises:
            ForecastError: it makes no such forecast.
            ModelError: it makes no forecast of such a run.
        """
        ...

    def save(self, path: str | Path) -> None:
        """Write the forecaster into a folder; the default writes its class and name.

        Two forecasters with the same files are taken for the same one.
        """
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        what = f"{type(self).__module__}:{type(self).__qualname__} {self.name}\n"
        (path / "forecaster.txt").write_text(what, encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Forecaster:
        """Read what ``save`` wrote; the default makes a new forecaster without arguments.

        Raises:
            FileNotFoundError: there is no forecaster in the folder.
            ModelError: the files are those of another kind, or damaged.
        """
        return cls()


def check_forecaster(forecaster: object) -> None:
    """Refuse an object that does not follow the protocol."""
    wanted = ("name", "kind", "causal", "is_oracle", "forecast", "save", "load")
    if missing := [member for member in wanted if not hasattr(forecaster, member)]:
        raise ForecastError(
            "this is not a forecaster",
            expected=", ".join(wanted),
            got=f"{type(forecaster).__qualname__} without {', '.join(missing)}",
            do="make tipl.Forecaster its base class: then only name and forecast are needed",
        )


def check_request(run: Run, starts: Sequence[int], horizons: Sequence[int]) -> None:
    """Refuse starts that are no snapshots of the run, and horizons below 1."""
    if not (
        len(starts)
        and len(horizons)
        and 0 <= min(starts) <= max(starts) < len(run)
        and min(horizons) >= 1
    ):
        raise ForecastError(
            "the run has no such starts, or the horizons are invalid",
            expected=f"starts from 0 to {len(run) - 1}, horizons from 1",
            got=f"starts {list(starts)}, horizons {list(horizons)}",
            where=run.path,
            do="choose starts among the snapshots of the run",
        )


def every_of(run: Run) -> int | None:
    """Return the number of gradient steps from one snapshot to the next; None: not recorded."""
    return run.info.cadence.every if run.info.cadence else None


def check_cadence(run: Run, every: int | None, phases: int | None = None) -> None:
    """Refuse a run whose cadence is not that of the training runs.

    Args:
        run: the run to forecast.
        every: number of gradient steps from one snapshot to the next in the training runs.
        phases: number of snapshots of an iteration in the training runs; None: it does not matter.

    Raises:
        ModelError: the run has another cadence.
    """
    got = every_of(run)
    longest = 0 if phases is None else int(run.phase.max()) + 1
    if got != every or longest > (phases or 0):
        raise ModelError(
            "the model was trained on snapshots of another cadence",
            expected=f"a snapshot every {every} gradient steps"
            + (f", at most {phases} in an iteration" if phases else ""),
            got=f"every {got}" + (f", {longest} in an iteration" if phases else ""),
            where=run.path,
            do="train a model on runs of this cadence",
        )
