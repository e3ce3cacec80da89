"""What an item of a torch data set can hold beside weights.

A field is the name of any array that has a row for each snapshot (``run.keys()`` lists them), or

- ``weights``: policy weights, float32;
- ``returns``: the return of each episode, float32; NaN where a snapshot was not evaluated;
- ``mean_return``: mean return of the deterministic episodes, or of the sampled ones where a run
  has no deterministic ones, float32;
- ``obs_norm``: ``obs_norm/mean`` and ``obs_norm/var``, the observation normaliser;
- ``num_timesteps``, ``iteration``, ``phase``, ... : the counters in ``index/``.

Floating-point numbers become float32, integers int64.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from weighttraj.errors import WindowError
from weighttraj.run import Run

WEIGHTS = "weights"
MEAN_RETURN = "mean_return"

_ARRAYS = {"returns": ("eval/returns",), "obs_norm": ("obs_norm/mean", "obs_norm/var")}
"""Arrays that a name stands for."""


def expand(fields: Sequence[str], runs: Sequence[Run]) -> list[str]:
    """Return the names of the tensors that some fields stand for.

    Raises:
        WindowError: a run stores no such field.
    """
    names = [fields] if isinstance(fields, str) else list(fields)
    wanted = [
        tensor
        for name in names
        for tensor in (_ARRAYS["obs_norm"] if name == "obs_norm" else (name,))
    ]
    for run in runs:
        known = {name: _source(name) for name in wanted if name not in (WEIGHTS, MEAN_RETURN)}
        missing = [n for n, source in known.items() if not _by_snapshot(run, source)]
        if MEAN_RETURN in wanted and run.evaluation is None:
            missing.append(MEAN_RETURN)
        if missing:
            raise WindowError(
                "a run stores no such field for its snapshots",
                expected=f"some of weights, mean_return, {', '.join(_known(run))}",
                got=", ".join(missing),
                where=run.path,
                do="leave the field out; `weighttraj returns` stores returns",
            )
    for name in {name for name in wanted if name not in (WEIGHTS, MEAN_RETURN)}:
        _check_shapes(runs, _source(name))
    return list(dict.fromkeys(wanted))


def values(run: Run, name: str) -> np.ndarray:
    """Return a field of all snapshots of a run: (time, ...), float32 or int64."""
    rows = mean_returns(run) if name == MEAN_RETURN else run[_source(name)][:]
    return rows.astype(np.float32 if rows.dtype.kind == "f" else np.int64)


def mean_returns(run: Run) -> np.ndarray:
    """Return the mean return of each snapshot, float64 (time,); NaN where there is none."""
    if run.evaluation is None:
        return np.full(len(run), np.nan)
    return run.mean_return(deterministic=any(run.evaluation.deterministic))


def _check_shapes(runs: Sequence[Run], name: str) -> None:
    for run in runs:
        if run[name].shape[1:] != runs[0][name].shape[1:]:
            raise WindowError(
                "the rows of a field differ in shape, so they do not fit into one batch",
                expected=f"{name} of {runs[0].id}: {runs[0][name].shape[1:]}",
                got=run[name].shape[1:],
                where=run.path,
                do="leave the field out, or make one data set for each shape",
            )


def _source(name: str) -> str:
    """Return the name of the array that a tensor of an item is read from."""
    return "eval/returns" if name == "returns" else name if "/" in name else f"index/{name}"


def _by_snapshot(run: Run, name: str) -> bool:
    return name in run.keys() and run[name].dims[0] == "time"  # noqa: SIM118  run is no dict


def _known(run: Run) -> list[str]:
    return [name for name in run.keys() if run[name].dims[0] == "time"]  # noqa: SIM118
