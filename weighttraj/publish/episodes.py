"""Episodes of a run's policies, at the moments of training that show how it learns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from jaxtyping import Float64, Int64

from weighttraj import environments
from weighttraj.errors import PolicyError
from weighttraj.policies import Evaluator, Policy, env_of, load_policies
from weighttraj.publish.curves import Curve, mean_returns, thin
from weighttraj.publish.scene import Placement, Pose, View, placement_of, pose_of, view_of
from weighttraj.run import Run
from weighttraj.threads import one_torch_thread

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Where a return is on its way from the lowest to the highest, at each moment after the start."""

PROBES = 16
"""Snapshots that are tried where no returns are stored: evenly in t, and as many in log t."""

PROBE_EPISODES = 2
"""Episodes of each of them."""

MAX_STEPS = 10_000
"""Steps of an episode that are played, whatever its time limit."""


@dataclass(frozen=True, kw_only=True)
class Moments:
    """Snapshots that are shown, and the returns by which they were chosen."""

    snapshots: tuple[int, ...]
    """Their numbers, increasing."""
    curve: Curve
    """Returns over the training."""
    why: str
    """How they were chosen, for the page."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode of one snapshot, from the first state on."""

    t: int
    """Snapshot."""
    num_timesteps: int
    """Environment steps that the training had taken."""
    placements: list[Placement]
    """Where the model was at the start and after each step, as far as it is shown."""
    rewards: Float64[np.ndarray, " step"]
    """Raw reward of each step, to the end of the episode."""
    terminated: bool
    """Whether a state ended it, such as a fall; else it was cut off, by its time limit mostly."""


def choose(run: Run, seed: int) -> Moments:
    """Return the start, and where the return first passes 25, 50, 75 and 100 % of its range.

    Returns are the stored ones of deterministic actions, else those of some episodes played now.
    So are those between two snapshots over which a policy learns nearly all it learns.

    Raises:
        CollectError: the environment is not registered here.
        PolicyError: the policy cannot be rebuilt, or does not fit the environment.
    """
    stored = mean_returns(run, "deterministic")
    known = np.flatnonzero(np.isfinite(stored)) if stored is not None else np.arange(0)
    with Evaluator(env_of(run), episodes=PROBE_EPISODES, seed=seed) as evaluator:
        if stored is not None and len(known) > len(SHARES):
            values, which = stored[known], "the stored return"
        else:
            known = _candidates(len(run))
            values, which = _probe(run, known, evaluator), ""
        between = _between(known, values)
        if len(between):
            known = np.append(known, between)
            values = np.append(values, _probe(run, between, evaluator))
            known, values = known[np.argsort(known)], values[np.argsort(known)]
    played = f"the mean return of {PROBE_EPISODES} episodes, played for {len(known)} snapshots,"
    steps = run.num_timesteps[known].astype(np.float64)
    return Moments(
        snapshots=moments(known, values),
        curve=Curve(run=run.id, steps=steps, returns=values),
        why=f"the start, and where {which or played} first passes 25, 50, 75 and 100 % of its "
        "range (moments in between where it passes several at once)",
    )


def moments(
    snapshots: Int64[np.ndarray, " point"], values: Float64[np.ndarray, " point"]
) -> tuple[int, ...]:
    """Return five snapshots, or all if there are fewer, at which the values rise.

    Where they pass several shares of their range at once, others are added, evenly spaced in log t.
    """
    known = np.isfinite(values)
    picks = {int(snapshots[0])}
    if known.any():
        low, high = values[known].min(), values[known].max()
        passed = np.where(known, values, -np.inf)
        first = [int(np.argmax(passed >= low + share * (high - low))) for share in SHARES]
        picks |= {int(snapshots[i]) for i in first}
    for i in np.geomspace(1, len(snapshots), 3 * len(SHARES)).round().astype(int)[::-1] - 1:
        if len(picks) < 1 + len(SHARES):
            picks.add(int(snapshots[i]))
    return tuple(sorted(picks))


def _candidates(count: int) -> Int64[np.ndarray, " point"]:
    """Return snapshots at which returns are tried, the first and last included."""
    last = count - 1
    spaced = [0, *np.geomspace(1, max(last, 1), PROBES), *np.linspace(0, last, PROBES)]
    found: np.ndarray = np.unique(np.round(spaced).astype(np.int64))
    return found[found <= last]


def _between(
    known: Int64[np.ndarray, " point"], values: Float64[np.ndarray, " point"]
) -> Int64[np.ndarray, " new"]:
    """Snapshots where the values rise most, if they pass several shares of their range at once."""
    finite = values[np.isfinite(values)]
    if len(known) < 2 or len(finite) < 2:
        return np.arange(0)
    rises = np.nan_to_num(np.diff(values), nan=-np.inf)
    steepest = int(np.argmax(rises))
    if rises[steepest] <= SHARES[0] * float(np.ptp(finite)):
        return np.arange(0)
    between = np.arange(known[steepest] + 1, known[steepest + 1])
    chosen: np.ndarray = between[thin(len(between), PROBES)]
    return chosen


def _probe(
    run: Run, snapshots: Int64[np.ndarray, " point"], evaluator: Evaluator
) -> Float64[np.ndarray, " point"]:
    """Return the mean return of episodes of each snapshot; NaN: the simulation became unstable."""
    means: np.ndarray = evaluator(load_policies(run, snapshots)).returns.mean(1)
    return means


class Stage:
    """The environment of a run, seen from one side.

    Raises:
        CollectError: the environment is not registered here.
        PolicyError: the run does not say which environment, or it is no MuJoCo environment.
    """

    def __init__(self, run: Run) -> None:
        self._info = info = env_of(run)
        self.env: gym.Env[Any, Any] = environments.remake(info)
        inner: Any = self.env.unwrapped
        self.model, self.data = getattr(inner, "model", None), getattr(inner, "data", None)
        if not (isinstance(self.model, mujoco.MjModel) and isinstance(self.data, mujoco.MjData)):
            self.env.close()
            raise PolicyError(
                "only MuJoCo environments can be drawn",
                got=info.id,
                where=run.path,
                do="leave the film out: --no-film",
            )
        self.dt = float(inner.dt)
        self.view: View = view_of(self.model)

    def pose(self, placement: Placement) -> Pose:
        """Return what is seen of the model."""
        return pose_of(self.model, placement, self.view)

    def play(self, run: Run, t: int, *, seed: int, shown: int) -> Episode:
        """Play one episode of snapshot t, with the mode of its actions.

        Args:
            run: the run.
            t: the snapshot.
            seed: of the first state.
            shown: steps after which the model's placement is kept.

        Raises:
            PolicyError: the policy cannot be rebuilt, or does not fit the environment.
        """
        policy = run.load_policy(t)
        with environments.explained(self._info):
            observation, _ = self.env.reset(seed=seed)
        places = [self._placement()]
        rewards: list[float] = []
        terminated = truncated = False
        with one_torch_thread(), environments.quiet_mujoco():
            while not (terminated or truncated) and len(rewards) < MAX_STEPS:
                action = self._action(policy, observation)
                with environments.explained(self._info):
                    observation, reward, terminated, truncated, _ = self.env.step(action)
                rewards.append(float(reward))
                if len(rewards) <= shown:
                    places.append(self._placement())
        return Episode(
            t=t,
            num_timesteps=int(run.num_timesteps[t]),
            placements=places,
            rewards=np.array(rewards),
            terminated=bool(terminated),
        )

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _placement(self) -> Placement:
        return placement_of(self.data, self.view)

    def _action(self, policy: Policy, observation: Any) -> np.ndarray:
        action, _ = policy.predict(observation, deterministic=True)
        expected = self.env.action_space.shape
        if action.shape != expected:
            raise PolicyError(
                "the policy does not fit the environment",
                expected=f"actions {expected}",
                got=f"actions {action.shape}",
                do="install the version of the environment that run.info.provenance names",
            )
        return action
