"""Returns of forecast policies beside those of the true ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Int

from tipl.evaluation.parts import Arrays
from tipl.evaluation.weights import Tick, forecast
from tipl.forecaster import Forecaster
from tipl.runs import weights_of
from weighttraj import Run
from weighttraj.policies import Evaluator, PolicyBatch, env_of, load_policies

MODES = ("sampled", "held", "deterministic")
"""How policies act: by samples; by samples with the exploration noise ``log_std`` of the start; by
the distribution's mode."""
FRESH = 10_000
"""Offset of the seeds of the episodes that measure how noisy a return is."""


class Player:
    """Measures mean returns of policies of one run; equal policies play once.

    Args:
        run: the run.
        episodes: number of episodes of each policy, the same seeds for all.
        seed: seed of the first episode.
        modes: how policies act, of ``MODES``.
    """

    def __init__(self, run: Run, episodes: int, seed: int, *, modes: Sequence[str] = MODES) -> None:
        self._run, self.modes = run, tuple(modes)
        self._evaluator = Evaluator(env_of(run), episodes=episodes, seed=seed)
        self._known: dict[tuple[bool, bytes], float] = {}

    def __enter__(self) -> Player:
        return self

    def __exit__(self, *_: object) -> None:
        self._evaluator.close()

    def returns(
        self,
        policies: PolicyBatch,
        starts: Int[np.ndarray, " policy"],
        tick: Tick = lambda _: None,
    ) -> Float[np.ndarray, "mode policy"]:
        """Return the mean returns in each mode.

        Args:
            policies: the policies.
            starts: the snapshot whose ``log_std`` each policy has in the mode ``held``.
            tick: progress callback, called with a number of policies.
        """
        held = policies.with_weights(hold_log_std(self._run, policies.weights, starts))
        arms = {"sampled": policies, "held": held, "deterministic": policies}
        found = []
        for mode in self.modes:
            found.append(self._play(arms[mode], deterministic=mode == "deterministic"))
            tick(len(policies))
        return np.stack(found)

    def _play(self, policies: PolicyBatch, *, deterministic: bool) -> Float[np.ndarray, " policy"]:
        keys = [(deterministic, key) for key in _keys(policies)]
        rows = {key: row for row, key in enumerate(keys) if key not in self._known}
        if rows:
            some = policies[list(rows.values())]
            played = self._evaluator(some, deterministic=deterministic).returns.mean(1)
            self._known |= dict(zip(rows, played.tolist(), strict=True))
        return np.array([self._known[key] for key in keys])


def true_returns(
    player: Player, run: Run, starts: Int[np.ndarray, " start"], horizons: Sequence[int], tick: Tick
) -> Arrays:
    """Return the returns of the policies at the starts, and of their true successors.

    Returns:
        ``now``: float64 (mode, start); ``later``: (mode, start, horizon).
    """
    now = player.returns(load_policies(run, starts), starts, tick)
    policies = load_policies(run, (starts[:, None] + np.asarray(horizons)).ravel())
    later = player.returns(policies, np.repeat(starts, len(horizons)), tick)
    return {"now": now, "later": later.reshape(len(now), len(starts), len(horizons))}


def forecast_returns(
    forecaster: Forecaster,
    player: Player,
    run: Run,
    starts: Int[np.ndarray, " start"],
    horizons: Sequence[int],
    tick: Tick,
) -> Arrays:
    """Return the returns of forecast policies.

    They act with the normaliser of the start, because the later one is not known yet. An oracle,
    which is no forecast, acts with the later one.

    Returns:
        ``forecast``: float64 (mode, start, horizon).
    """
    weights = forecast(forecaster, run, starts, horizons)
    at = np.repeat(starts, len(horizons))
    rows = (starts[:, None] + np.asarray(horizons)).ravel() if forecaster.is_oracle else at
    policies = load_policies(run, rows).with_weights(weights.reshape(len(at), -1))
    found = player.returns(policies, at, tick)
    return {"forecast": found.reshape(len(found), len(starts), len(horizons))}


def hold_log_std(
    run: Run, weights: Float32[np.ndarray, "policy param"], starts: Int[np.ndarray, " policy"]
) -> Float32[np.ndarray, "policy param"]:
    """Return the weights with the exploration noise of other snapshots of the run."""
    names = [param.name for param in run.layout.params]
    if "log_std" not in names:
        return weights
    place = run.layout["log_std"].slice
    held = weights.copy()
    held[:, place] = weights_of(run)[starts][:, place]
    return held


def _keys(policies: PolicyBatch) -> list[bytes]:
    """Return the bytes that identify each policy: its weights and its normaliser."""
    parts = [x for x in (policies.weights, policies.mean, policies.var) if x is not None]
    return [b"".join([part[row].tobytes() for part in parts]) for row in range(len(policies))]
