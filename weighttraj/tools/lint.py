"""Looks for what is suspicious about runs whose bytes are whole."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track

from weighttraj.frames import distance
from weighttraj.opening import open_dataset
from weighttraj.remote.address import here
from weighttraj.run import Run

JUMP = 30.0
"""A step is a discontinuity if it is so many times the median of the steps around it."""

AROUND = 25
"""Steps before and after that a step is compared with."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something that a careful reader would ask about."""

    check: str
    """Name of the check."""
    run: str
    """Id of the run."""
    message: str
    """What was found, and what it may mean."""

    def __str__(self) -> str:
        return f"{self.run}: {self.check}: {self.message}"


def lint(path: str | Path, *, console: Console | None = None) -> list[Finding]:
    """Return what is suspicious about a data set or run; an empty list means nothing.

    Checks: ``duplicate`` (snapshots that equal another one), ``final`` (snapshots that equal the
    last one, as when a mirror serves final weights under every name), ``gap`` (counters that do
    not follow the cadence), ``order`` (counters that go back), ``jump`` (a step far longer than
    those around it), ``finite``, ``constant`` (parameters that never change), ``normalizer`` (an
    agent without recorded normaliser), ``start`` (a run that begins with a trained policy of
    unknown origin, or a data set that trains on a run and tests on its continuation),
    ``returns`` (sampled returns that are the same for every snapshot), ``short`` (fewer
    snapshots than the other runs have), ``twin`` (runs with the same weights).

    Args:
        path: data set, run or HDF5 file.
        console: where progress is shown; None: nowhere.

    Raises:
        FileNotFoundError: there is neither a data set nor a run at the path.
        DamageError: it is not whole: see ``verify``.
    """
    runs = open_dataset(here(path)).runs
    bar = track(runs, "runs", console=console, disable=console is None, transient=True)
    findings = [finding for run in bar for finding in lint_run(run)]
    return findings + list(_between(runs))


def lint_run(run: Run) -> list[Finding]:
    """Return what is suspicious about one run."""
    if not len(run):
        return [Finding(check="short", run=run.id, message="no snapshots")]
    checks = (_start, _duplicates, _counters, _weights, _normalizer, _returns)
    found = [finding for check in checks for finding in check(run)]
    return [Finding(check=check, run=run.id, message=message) for check, message in found]


def _start(run: Run) -> Iterator[tuple[str, str]]:
    origin, steps = run.info.continues, int(run.num_timesteps[0])
    if origin is not None and not origin.run_id:
        yield (
            "start",
            f"starts from a trained model: num_timesteps {origin.num_timesteps} at the start; "
            "which run it continues is not recorded",
        )
    if run.info.moved_by:
        movers = ", ".join(run.info.moved_by)
        yield "moved", f"{movers} changed the weights between updates and rollouts"
    if origin is None and steps > 0:
        yield "start", f"begins at num_timesteps {steps}: what was before is not stored"


def _duplicates(run: Run) -> Iterator[tuple[str, str]]:
    seen: dict[bytes, int] = {}
    digests = [row.tobytes() for row in run["digest"][:]]
    final = [t for t, digest in enumerate(digests[:-1]) if digest == digests[-1]]
    if final:
        yield "final", f"{_some(final)} equal the last snapshot"
    pairs = []
    for t, digest in enumerate(digests):
        if digest in seen:
            pairs.append((seen[digest], t))
        seen[digest] = t
    if pairs:
        yield "duplicate", f"equal snapshots {_some(pairs)}: did training stand still?"


def _counters(run: Run) -> Iterator[tuple[str, str]]:
    for name in ("iteration", "gradient_step", "num_timesteps"):
        values = run[f"index/{name}"][:]
        back = np.flatnonzero(np.diff(values) < 0) + 1
        if back.size:
            yield "order", f"{name} goes back at {_some(back.tolist())}"
    cadence, steps = run.info.cadence, run["index/gradient_step"][:]
    if cadence is None or (steps < 0).any():
        return
    # The last snapshot is that of the end, wherever the cadence was.
    gaps = np.flatnonzero(np.diff(steps)[:-1] != cadence.every) + 1
    if gaps.size:
        yield "gap", f"not {cadence.every} gradient steps before {_some(gaps.tolist())}"


def _weights(run: Run) -> Iterator[tuple[str, str]]:
    first = run.weights[0]
    moved = np.zeros(first.shape, bool)
    lengths, bad, last = [], [], first
    for start, rows in run.weights.pieces():
        for t, row in enumerate(rows, start):
            moved |= row != first
            bad += [] if np.isfinite(row).all() else [t]
            lengths.append(distance(row, last))
            last = row
        last = last.copy()  # the piece need not stay in memory
    if bad:
        yield "finite", f"NaN or infinite weights at {_some(bad)}"
    moved |= _behind_silent_inputs(run)
    if len(run) > 1 and not moved.all():
        names = [s.name for s in run.layout.params if not moved[s.slice].all()]
        still = int((~moved).sum())
        yield "constant", f"{still} of {moved.size} parameters never change, in {names}"
    jumps = _jumps(np.array(lengths)[1:])
    if jumps:
        yield "jump", f"steps {JUMP:g} times longer than those around them end at {_some(jumps)}"


def _behind_silent_inputs(run: Run) -> np.ndarray:
    """Return which parameters multiply an observation that is always 0: these cannot move.

    Reacher-v4 and InvertedDoublePendulum-v4 have such observations. The normaliser shows them: its
    mean is exactly 0 at every snapshot, and its variance has shrunk to almost nothing.
    """
    behind = np.zeros(run.layout.size, bool)
    stats, layers = run.info.obs_norm, run.info.policy.layers
    if stats is None or len(stats.shape) != 1 or not layers or not len(run):
        return behind
    silent = (run["obs_norm/mean"][:] == 0).all(axis=0) & (run["obs_norm/var"][-1] < 1e-3)
    for spec in run.layout.params:
        if spec.name == layers[0][0] and spec.shape[-1:] == silent.shape:
            behind[spec.slice] = np.broadcast_to(silent, spec.shape).reshape(-1)
    return behind


def _jumps(lengths: np.ndarray) -> list[int]:
    """Return snapshots that end a step far longer than the median of its surroundings."""
    found = []
    for t, length in enumerate(lengths):
        around = lengths[max(0, t - AROUND) : t + AROUND + 1]
        usual = np.median(around[around > 0]) if (around > 0).any() else 0.0
        if length > JUMP * usual > 0:
            found.append(t + 1)
    return found


def _normalizer(run: Run) -> Iterator[tuple[str, str]]:
    info = run.info
    if info.obs_norm is None and info.env is not None:
        named = [w for w in info.env.wrappers if "normaliz" in w.lower()]
        if named:
            yield "normalizer", f"wrappers {named} normalise, but no statistics are stored"


def _continued(runs: Sequence[Run]) -> Iterator[Finding]:
    """Yield runs of one training that are taken for independent ones."""
    by_id = {run.id: run for run in runs}
    for run in runs:
        origin = run.info.continues
        source = by_id.get(origin.run_id) if origin is not None else None
        if source is None or origin is None:
            continue
        digests = source["digest"][:]
        t = origin.snapshot
        if not 0 <= t < len(digests) or digests[t].tobytes().hex() != origin.digest:
            message = f"continues snapshot {t} of {source.id}, which is another one here"
            yield Finding(check="start", run=run.id, message=message)
        elif run.split != source.split:
            message = f"split {run.split!r}, and goes on from {source.id} in {source.split!r}"
            yield Finding(check="start", run=run.id, message=message)


def lint_returns(run: Run) -> list[Finding]:
    """Return what is suspicious about the returns of one run."""
    return [Finding(check=check, run=run.id, message=said) for check, said in _returns(run)]


def _returns(run: Run) -> Iterator[tuple[str, str]]:
    """Find sampled returns that do not tell the snapshots apart.

    All policies meet the same noise, so that small differences between them show. Policies that are
    close to uniform then take the very same actions.
    """
    evaluation = run.info.evaluation
    if evaluation is None or all(evaluation.deterministic):
        return
    sampled = ~np.array(evaluation.deterministic)
    returns, lengths = run["eval/returns"][:][:, sampled], run["eval/lengths"][:][:, sampled]
    known = np.isfinite(returns).all(axis=1)
    returns, lengths = returns[known], lengths[known]
    if len(returns) < 2 or (returns != returns[0]).any():
        return
    if np.ptp(returns) > 0 or np.ptp(lengths) > 0:  # else all reach the same end, as if solved
        yield (
            "returns",
            f"the sampled returns of all {len(returns)} evaluated snapshots are equal, episode by "
            "episode: under the noise that all policies share they take the same actions, as "
            "near-uniform policies do; look at deterministic actions, or train for longer",
        )


def _between(runs: Sequence[Run]) -> Iterator[Finding]:
    yield from _continued(runs)
    lengths = defaultdict(list)
    ends = defaultdict(list)
    for run in runs:
        lengths[len(run)].append(run.id)
        if len(run):
            ends[run["digest"][-1].tobytes()].append(run.id)
    usual = max(lengths, key=lambda n: len(lengths[n]), default=0)
    for n, ids in lengths.items():
        for run_id in ids if n < usual else ():
            message = f"{n} snapshots, where most runs have {usual}"
            yield Finding(check="short", run=run_id, message=message)
    for ids in ends.values():
        if len(ids) > 1:
            yield Finding(check="twin", run=ids[0], message=f"ends in the weights of {ids[1:]}")


def _some(values: Sequence[object]) -> str:
    shown = ", ".join(map(str, values[:5]))
    return shown if len(values) <= 5 else f"{shown} and {len(values) - 5} more"
