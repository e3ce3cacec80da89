"""Evaluates forecasters and writes the report: what ``tipl evaluate`` does."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from tipl.evaluation.config import EvaluateConfig
from tipl.evaluation.evaluate import evaluate as measure
from tipl.evaluation.results import Results
from tipl.forecaster import Forecaster
from tipl.report.page import write_report


def evaluate(
    forecasters: Sequence[Forecaster],
    config: EvaluateConfig,
    *,
    workers: int = 1,
    imports: Sequence[str] = (),
    console: Console | None = None,
) -> Results:
    """Evaluate forecasters beside persistence; write ``results.json``, a page and figures.

    What was measured is kept in ``config.out``: the same call goes on where it stopped, and more
    forecasters cost only their own measurements.

    Args:
        forecasters: what is evaluated; persistence is added, and the oracle of each TIPL's rank.
        config: on what, and how much.
        workers: number of processes; 1 means this one.
        imports: modules that register environments; every worker imports them.
        console: where progress is shown; None: nowhere.

    Returns:
        What ``results.json`` holds.

    Raises:
        EvaluateError: the runs do not fit together, are too short, or have no returns, or two
            forecasters have one name.
        KeyboardInterrupt: it was stopped; what was measured stays.
    """
    results = measure(forecasters, config, workers=workers, imports=imports, console=console)
    write_report(results, config.out)
    return results
