"""Runs the six checks on any forecaster, with a fit of its kind to random walks for the null.

A forecaster that was fitted to real runs does not show what its kind finds in random walks. So a
new one, of the same kind and sizes, is fitted to walks. The registry says how; a kind without a
fit is the same on walks as on runs.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import weighttraj as wt
from tipl.checks.copies import RefitConfig
from tipl.checks.measures import Fit, check
from tipl.checks.results import CheckResults, Limits
from tipl.errors import ForecastError
from tipl.forecaster import Forecaster
from tipl.registry import imported, kinds
from tipl.runs import cache_in
from tipl.saved import fingerprint
from tipl.settings import check_settings


def refit_of(forecaster: Forecaster, config: RefitConfig) -> Fit | None:
    """Return what fits such a forecaster to other runs; None: there is nothing to fit."""
    kind = kinds().get(forecaster.kind)
    if kind is None or kind.refit is None:
        return None
    refit = imported(kind.refit)
    return lambda runs: refit(forecaster, runs, config)


def check_model(
    forecaster: Forecaster,
    data: str | Path,
    *,
    horizons: tuple[int, ...] = (1, 2, 5, 10),
    batches: int = 2_000,
    walks: int = 12,
    seed: int = 0,
) -> CheckResults:
    """Run the six checks on copies of the first test run of a data set, as ``tipl check`` does.

    The other arguments are described in ``CheckResults``.

    Raises:
        ForecastError: it makes no such forecast, or a number is too small or too large.
    """
    numbers = {"horizons": horizons, "batches": batches, "walks": walks, "seed": seed}
    least = {"horizons": 1, "batches": 1, "walks": 3, "seed": 0}
    check_settings(numbers, least, ForecastError)
    dataset = wt.open_dataset(data)
    run = dataset.split("test").runs[0]
    with tempfile.TemporaryDirectory() as place, cache_in(Path(place) / "cache"):
        folder = Path(place)
        config = RefitConfig(folder=folder, horizons=horizons, batches=batches, seed=seed)
        fit = refit_of(forecaster, config)
        found = check(forecaster, run, folder, fit=fit, horizons=horizons, count=walks, seed=seed)
    return CheckResults(
        forecaster=forecaster.name,
        fingerprint=fingerprint(forecaster),
        data=dataset.info.id,
        version=dataset.info.version,
        run=run.id,
        fitted_to_walks=fit is not None,
        batches=batches,
        walks=walks,
        seed=seed,
        largest=Limits(),
        **asdict(found),
        passed=found.passed,
        command=" ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    )
