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

    A class that names this one as its base only has to write ``name`` and ``forecast``; the other
    members have defaults.
    """

    @property
    def name(self) -> str:
        """Name in tables and figures."""
        ...

    @property
    def kind(self) -> str:
        """Which kind of forecaster this is, as ``config.json`` of a saved one says."""
        return "other"

    @property
    def causal(self) -> bool:
        """Whether a forecast from t uses nothing that comes after t."""
        return True

    @property
    def is_oracle(self) -> bool:
        """Whether it reads the true future, and so shows a bound and not a forecast."""
        return False

    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return forecasts of phi_{t+h} for each start t and horizon h, from phi_0, ..., phi_t.

        Args:
            run: whose weights they are.
            starts: rows of ``run.weights``, from 0, in any order.
            horizons: snapshots ahead, from 1.

        Raises:
            ForecastError: it makes no such forecast, or of no such run.
        """
        ...

    def save(self, path: str | Path) -> None:
        """Write the forecaster into a folder; the default writes its class and name.

        The files identify a forecaster: two with the same files are taken for the same one.
        """
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        what = f"{type(self).__module__}:{type(self).__qualname__} {self.name}\n"
        (path / "forecaster.txt").write_text(what, encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Forecaster:
        """Read what ``save`` wrote; the default makes a new forecaster without arguments."""
        return cls()


def check_forecaster(forecaster: object) -> None:
    """Check that an object follows the protocol.

    Raises:
        ForecastError: a member is missing.
    """
    wanted = ("name", "kind", "causal", "is_oracle", "forecast", "save", "load")
    if missing := [member for member in wanted if not hasattr(forecaster, member)]:
        raise ForecastError(
            "this is not a forecaster",
            expected=", ".join(wanted),
            got=f"{type(forecaster).__qualname__} without {', '.join(missing)}",
            do="make tipl.Forecaster its base class: then only name and forecast are needed",
        )


def check_request(run: Run, starts: Sequence[int], horizons: Sequence[int]) -> None:
    """Check what a forecaster is asked for.

    Raises:
        ForecastError: a start is no snapshot of the run, or a horizon is below 1.
    """
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
        )


def check_cadence(run: Run, every: int | None, phases: int | None = None) -> None:
    """Check that a run has the cadence that a model was trained on.

    Args:
        run: the run to forecast.
        every: gradient steps from one snapshot to the next in the training runs.
        phases: snapshots of one iteration in the training runs; None: they do not matter.

    Raises:
        ModelError: the run has another cadence.
    """
    got = run.info.cadence.every if run.info.cadence else None
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
