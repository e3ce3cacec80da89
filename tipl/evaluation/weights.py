"""Errors of forecast weights, and divergences of the policies that they make."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from torch.distributions import Normal, kl_divergence

from tipl.evaluation.parts import Arrays
from tipl.forecaster import Forecaster
from tipl.runs import weights_of
from weighttraj import Run
from weighttraj.policies import PolicyBatch, load_policies

MAX_BYTES = 2**27
"""Bytes of the forecasts of one chunk of starts."""

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
    """
    offsets = [param.offset for param in run.layout.params]
    parts = []
    for chunk, forecast in _forecasts(forecaster, run, starts, horizons, run.layout.size):
        error = forecast - _later(weights_of(run), chunk, horizons)
        np.square(error, out=error)
        parts.append(np.add.reduceat(error, offsets, axis=2, dtype=np.float64))
        tick(len(chunk))
    return {"squared": np.concatenate(parts)}


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
    for chunk, forecast in _forecasts(forecaster, run, starts, horizons, room):
        rows = (chunk[:, None] + np.asarray(horizons)).ravel()
        rollout = np.maximum(run.iteration[rows] - 1, 0)  # phi_0 precedes the first one
        seen, place = np.unique(rollout, return_inverse=True)
        inputs = np.asarray(probes[seen], np.float32)[place]  # (policy, observation, *obs)
        true = load_policies(run, rows)
        other = true.with_weights(forecast.reshape(len(rows), -1))
        parts.append(_divergence(true, other, inputs).reshape(forecast.shape[:2]))
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
        yield chunk, forecaster.forecast(run, chunk.tolist(), list(horizons))


def _later(
    weights: Any, starts: Int[np.ndarray, " start"], horizons: Sequence[int]
) -> Float32[np.ndarray, "start horizon param"]:
    """Return the true weights; rows that several starts need are read once."""
    rows = starts[:, None] + np.asarray(horizons)
    wanted, place = np.unique(rows, return_inverse=True)
    return np.asarray(weights[wanted])[place.reshape(rows.shape)]


def _widest(run: Run) -> int:
    return max(max(param.shape, default=1) for param in run.layout.params)
