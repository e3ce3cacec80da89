"""Errors of forecast weights, and divergences of the policies that they make."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Float32, Int
from torch.distributions import Normal, kl_divergence

from tipl.errors import ForecastError
from tipl.evaluation.parts import Arrays
from tipl.forecaster import Forecaster
from tipl.runs import weights_of
from weighttraj import Run
from weighttraj.errors import WeightTrajError
from weighttraj.policies import PolicyBatch, load_policies

SLOWEST = 60
"""Seconds that a forecast from one start may take."""

MAX_BYTES = 2**27
"""Bytes of the forecasts of one chunk of starts."""

T = TypeVar("T")
Tick = Callable[[int], None]
"""Progress callback, called with a number of starts."""


def squared_errors(
    forecaster: Forecaster,
    run: Run,
    starts: Int[np.ndarray, " start"],
    horizons: Sequence[int],
    tick: Tick,
) -> Arrays:
    """Return sums of squared errors of the weights.

    Returns:
        ``squared``: float64 (start, horizon, tensor), a sum for each tensor of the layout.
        ``seconds``: float64 (2,), wall and CPU seconds of a forecast, a mean over the starts.
    """
    offsets = [param.offset for param in run.layout.params]
    parts, clock = [], Clock()
    chunks = _forecasts(forecaster, run, starts, horizons, run.layout.size)
    for chunk, found in clock.of(chunks):
        error = found - _later(weights_of(run), chunk, horizons)
        np.square(error, out=error)
        parts.append(np.add.reduceat(error, offsets, axis=2, dtype=np.float64))
        tick(len(chunk))
    return {"squared": np.concatenate(parts), "seconds": clock.seconds / max(len(starts), 1)}


class Clock:
    """Measures how long the elements of an iterator take to be made."""

    def __init__(self) -> None:
        self.seconds: Float[np.ndarray, "2"] = np.zeros(2)
        """Wall and CPU seconds so far."""

    def of(self, made: Iterator[T]) -> Iterator[T]:
        """Yield the elements."""
        while True:
            began = np.array([time.perf_counter(), time.process_time()])
            try:
                found = next(made)
            except StopIteration:
                return
            finally:
                self.seconds += [time.perf_counter(), time.process_time()] - began
            yield found


def divergences(
    forecaster: Forecaster,
    run: Run,
    starts: Int[np.ndarray, " start"],
    horizons: Sequence[int],
    tick: Tick,
) -> Arrays:
    """Return the divergence of forecast policies from the true ones: KL(pi_{t+h} || pi~_{t+h}).

    Both see the same network inputs, which were stored from the rollout that precedes pi_{t+h}; so
    normalisers play no part.

    Returns:
        ``kl``: float64 (start, horizon), means over observations.
    """
    probes = run["probe/observations"]
    room = run.layout.size + 4 * probes.shape[1] * _widest(run)
    parts = []
    for chunk, found in _forecasts(forecaster, run, starts, horizons, room):
        rows = (chunk[:, None] + np.asarray(horizons)).ravel()
        rollout = np.maximum(run.iteration[rows] - 1, 0)  # phi_0 precedes the first one
        seen, place = np.unique(rollout, return_inverse=True)
        inputs = np.asarray(probes[seen], np.float32)[place]  # (policy, observation, *obs)
        true = load_policies(run, rows)
        other = true.with_weights(found.reshape(len(rows), -1))
        parts.append(_divergence(true, other, inputs).reshape(found.shape[:2]))
        tick(len(chunk))
    return {"kl": np.concatenate(parts)}


def _divergence(
    true: PolicyBatch, other: PolicyBatch, inputs: Float32[np.ndarray, "policy obs *shape"]
) -> Float[np.ndarray, " policy"]:
    p, q = true.distribution(inputs), other.distribution(inputs)
    each = kl_divergence(p, q).double()
    over_actions = each.sum(-1) if isinstance(p, Normal) else each
    return np.asarray(over_actions.mean(1).numpy())


def _forecasts(
    forecaster: Forecaster,
    run: Run,
    starts: Int[np.ndarray, " start"],
    horizons: Sequence[int],
    room: int,
) -> Iterator[tuple[Int[np.ndarray, " start"], Float32[np.ndarray, "start horizon param"]]]:
    """Yield forecasts in chunks of starts; ``room`` is how many numbers one forecast takes."""
    size = max(1, MAX_BYTES // (room * len(horizons) * 4))
    for first in range(0, len(starts), size):
        chunk = starts[first : first + size]
        yield chunk, forecast(forecaster, run, chunk, horizons)


def forecast(
    forecaster: Forecaster, run: Run, starts: Int[np.ndarray, " start"], horizons: Sequence[int]
) -> Float32[np.ndarray, "start horizon param"]:
    """Return a forecast of which one knows that it is one.

    Raises:
        ForecastError: the forecaster raised an error, gave another shape or NaN, or took more than
            ``SLOWEST`` seconds for a start.
    """
    began = time.monotonic()
    try:
        found = np.asarray(forecaster.forecast(run, starts.tolist(), list(horizons)))
    except WeightTrajError:
        raise
    except Exception as error:  # a stranger's forecaster may raise anything
        raise _refused(forecaster, run, "an array", f"{type(error).__name__}: {error}") from error
    shape = (len(starts), len(horizons), run.layout.size)
    if found.shape != shape or found.dtype.kind != "f":
        got = f"{found.dtype} {found.shape}"
        raise _refused(forecaster, run, f"float32 (start, horizon, param) {shape}", got)
    if np.isnan(found).any():
        bad = starts[np.isnan(found).any((1, 2))]
        raise _refused(forecaster, run, "numbers", f"NaN from {len(bad)} starts, first {bad[0]}")
    if (each := (time.monotonic() - began) / len(starts)) > SLOWEST:
        raise _refused(forecaster, run, f"at most {SLOWEST} s for a start", f"{each:.0f} s")
    return found.astype(np.float32, copy=False)


def _refused(forecaster: Forecaster, run: Run, expected: str, got: str) -> ForecastError:
    return ForecastError(
        f"{forecaster.name} gives no forecast",
        expected=expected,
        got=got,
        where=f"run {run.id}",
        do="mend the forecaster, or leave it out",
    )


def _later(
    weights: Any, starts: Int[np.ndarray, " start"], horizons: Sequence[int]
) -> Float32[np.ndarray, "start horizon param"]:
    """Return the true weights; rows that several starts need are read once."""
    rows = starts[:, None] + np.asarray(horizons)
    wanted, place = np.unique(rows, return_inverse=True)
    return np.asarray(weights[wanted])[place.reshape(rows.shape)]


def _widest(run: Run) -> int:
    return max(max(param.shape, default=1) for param in run.layout.params)
