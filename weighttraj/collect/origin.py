"""Finds out what a training goes on from: a recorded run, or a model that was trained before."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from weighttraj.collect.agents import Agent
from weighttraj.collect.normalizers import Normalizers
from weighttraj.collect.recorder import Counters
from weighttraj.errors import CollectError
from weighttraj.format import Continuation, ParamLayout
from weighttraj.opening import open_run
from weighttraj.run import Run


def find_origin(agent: Agent) -> Continuation | None:
    """Return how far a model had been trained before recording began; None: it is untrained.

    Weights that were set by hand, as after imitation learning, leave no trace in the model.
    """
    model = agent.model
    updates = int(getattr(model, "_n_updates", 0))
    has_state = agent.optimizer is not None and len(agent.optimizer.state) > 0
    if not (model.num_timesteps or updates or has_state):
        return None
    return Continuation(num_timesteps=model.num_timesteps)


def find_source(
    source: Run | str | Path,
    agent: Agent,
    layout: ParamLayout,
    weights: np.ndarray,
    norm: Normalizers,
) -> tuple[Continuation, Counters]:
    """Return the snapshot of a run that a training goes on from, and its counters.

    Args:
        source: the run.
        agent: what will be trained.
        layout: order of its parameters.
        weights: the present ones, float32 (param,).
        norm: the present normalisers.

    Raises:
        CollectError: the agent is none of the run's snapshots.
        FileNotFoundError: there is no run at the path.
    """
    run = source if isinstance(source, Run) else open_run(source)
    digest = hashlib.sha256(np.ascontiguousarray(weights, "<f4").tobytes()).digest()
    equal = (run["digest"][:] == np.frombuffer(digest, np.uint8)).all(axis=1)
    if run.layout != layout or not equal.any():
        raise CollectError(
            "the training does not go on from a snapshot of the run that it is said to continue",
            expected=f"weights that equal one of the run's {len(run)} snapshots",
            got="parameters of another layout" if run.layout != layout else "other weights",
            where=run.path,
            do="load the model that this run ended with, or leave continues out",
        )
    t = int(np.flatnonzero(equal)[-1])
    _check_normalizer(run, t, norm)
    counters = Counters(
        iteration=max(int(run["index/iteration"][t]), 0),
        gradient_step=max(int(run["index/gradient_step"][t]), 0),
    )
    steps = max(int(run["index/num_timesteps"][t]), agent.model.num_timesteps)
    origin = Continuation(num_timesteps=steps, run_id=run.id, snapshot=t, digest=digest.hex())
    return origin, counters


def _check_normalizer(run: Run, t: int, norm: Normalizers) -> None:
    """Refuse a normaliser that has seen less than the snapshot's: the agent acts otherwise."""
    before = run.obs_norm(t)
    now = norm.read_obs() if norm.read_obs is not None else None
    seen_before = 0.0 if before is None else before.count
    seen_now = 0.0 if now is None else now[2]
    if seen_now < seen_before or (before is None and now is not None):
        raise CollectError(
            "the observation normaliser is not the one of the snapshot that the training continues",
            expected=f"statistics of at least {seen_before:.0f} observations",
            got=f"statistics of {seen_now:.0f}" if now is not None else "no normaliser",
            where=f"{run.path}, snapshot {t}",
            do="load it with the model, as with VecNormalize.load, or leave continues out",
        )
