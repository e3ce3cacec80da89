"""Many copies of one environment, stepped together: batched physics, or Gymnasium's own loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.batch import Batch

from weighttraj.environments import quiet_mujoco
from weighttraj.policies.kernels import Kernel, kernel_for

_START_FIELDS = ("qpos", "qvel", "act", "time", "qacc_warmstart")
"""State of a simulation between reset and first step; controls and forces are zero."""

_UNSTABLE = [
    int(getattr(mujoco.mjtWarning, name))
    for name in ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_BADCTRL")
]
"""Warnings upon which MuJoCo resets a simulation, or takes its controls for zero."""


class Step(NamedTuple):
    """What one step of some simulations gave."""

    observations: np.ndarray
    """(simulation, *obs), raw."""
    rewards: np.ndarray
    """float64 (simulation,)."""
    terminated: np.ndarray
    """bool (simulation,): the episode ended in a terminal state."""
    truncated: np.ndarray
    """bool (simulation,): the environment cut the episode off. Batched physics knows no time limit:
    the caller counts."""
    unstable: np.ndarray
    """bool (simulation,): the physics broke down; the other values mean nothing."""


@runtime_checkable
class Simulator(Protocol):
    """Simulations of one environment. Simulation i starts from ``seeds[i % len(seeds)]``."""

    name: str
    """What steps them: ``mujoco.batch`` or ``gymnasium``."""
    most: int | None
    """Simulations, in multiples of the seeds, that fit at once; None: memory is the limit."""

    def reset(self, copies: int) -> np.ndarray:
        """Start ``copies`` simulations from every seed; observations (simulation, *obs)."""

    def step(self, sims: np.ndarray, actions: np.ndarray) -> Step:
        """Step the simulations ``sims``, ascending; actions are (len(sims), *action)."""

    def close(self) -> None:
        """Close the environments."""


def make_simulator(make: Callable[[], gym.Env[Any, Any]], seeds: Sequence[int]) -> Simulator:
    """Return the fastest simulator that there is for an environment.

    Args:
        make: makes the environment.
        seeds: of the resets.
    """
    env = make()
    kernel = kernel_for(env)
    if kernel is not None:
        return PhysicsSimulator(env, kernel, seeds)
    return GymnasiumSimulator([env, *(make() for _ in seeds[1:])], seeds)


@dataclass(frozen=True, kw_only=True)
class Start:
    """A simulation just after the environment's ``reset``."""

    observation: np.ndarray
    """Observation, (obs,)."""
    fields: dict[str, np.ndarray]
    """State by field of ``mujoco.MjData``."""
    memory: np.ndarray
    """What the kernel needs of it for the reward of the first step."""


class Physics:
    """A batch of MuJoCo simulations with the environment's kernel around it.

    Bit by bit the physics of Gymnasium's ``step``, whatever the number of simulations.

    Args:
        kernel: the environment's.
        nsim: number of simulations.
    """

    def __init__(self, kernel: Kernel, nsim: int) -> None:
        self._kernel = kernel
        self._batch = Batch(kernel.env.model, nsim, nthread=1)
        self._fields = {name: self._batch.bind(name) for name in kernel.fields}
        self._starts = {name: self._batch.bind(name) for name in _START_FIELDS}
        self._ctrl = self._batch.bind("ctrl")
        self._memory = np.repeat(kernel.memory(_state_of(kernel)), nsim, axis=0)
        self._warnings = np.zeros(nsim, np.int64)

    def load(self, sims: Sequence[int] | np.ndarray, starts: Sequence[Start]) -> None:
        """Put simulations where ``reset`` left the environment."""
        for name, values in self._starts.items():
            values[sims] = np.stack([start.fields[name] for start in starts])
        self._memory[sims] = np.stack([start.memory for start in starts])

    def step(self, sims: np.ndarray, actions: np.ndarray) -> Step:
        """See ``Simulator.step``."""
        everything = len(sims) == self._batch.nsim
        chosen: Any = slice(None) if everything else sims
        self._ctrl[chosen] = actions
        with quiet_mujoco():
            self._batch.step(None if everything else sims, nstep=self._kernel.env.frame_skip)
        state = {name: values[chosen] for name, values in self._fields.items()}
        terminated = self._kernel.terminated(state)
        rewards = self._kernel.reward(self._memory[chosen], state, actions, terminated)
        self._memory[chosen] = self._kernel.memory(state)
        return Step(
            observations=self._kernel.observe(state),
            rewards=rewards,
            terminated=terminated,
            truncated=np.zeros(len(sims), bool),
            unstable=self._newly_unstable(chosen),
        )

    def _newly_unstable(self, chosen: Any) -> np.ndarray:
        counts = self._batch.warning[chosen][:, _UNSTABLE, 1].sum(1)
        unstable = counts > self._warnings[chosen]
        self._warnings[chosen] = counts
        return np.asarray(unstable)


def start_of(kernel: Kernel, observation: np.ndarray) -> Start:
    """Return the state in which the kernel's environment stands, just after its ``reset``.

    Args:
        kernel: the environment's.
        observation: what ``reset`` returned.
    """
    data = kernel.env.data
    return Start(
        observation=observation,
        fields={name: np.copy(getattr(data, name)) for name in _START_FIELDS},
        memory=np.array(kernel.memory(_state_of(kernel))[0]),
    )


def _state_of(kernel: Kernel) -> dict[str, np.ndarray]:
    """State of the kernel's own environment, as of one simulation."""
    return {name: np.asarray(getattr(kernel.env.data, name))[None] for name in kernel.fields}


class PhysicsSimulator:
    """Batched MuJoCo: thousands of simulations at once. See ``Simulator``."""

    name: str = "mujoco.batch"
    most: int | None = None

    def __init__(self, env: gym.Env[Any, Any], kernel: Kernel, seeds: Sequence[int]) -> None:
        self._env = env
        self._kernel = kernel
        self._starts = [start_of(kernel, env.reset(seed=seed)[0]) for seed in seeds]
        self._physics = Physics(kernel, len(self._starts))

    def reset(self, copies: int) -> np.ndarray:
        """See ``Simulator.reset``."""
        starts = self._starts * copies  # and new counters of instability
        self._physics = Physics(self._kernel, len(starts))
        self._physics.load(np.arange(len(starts)), starts)
        return np.stack([start.observation for start in starts])

    def step(self, sims: np.ndarray, actions: np.ndarray) -> Step:
        """See ``Simulator.step``."""
        return self._physics.step(sims, actions)

    def close(self) -> None:
        """See ``Simulator.close``."""
        self._env.close()


class GymnasiumSimulator:
    """Environments stepped one after another in Python: any environment, slowly.

    A Gymnasium vector environment would step finished episodes too; here they are left out.
    See ``Simulator``.
    """

    name: str = "gymnasium"
    most: int | None = 1

    def __init__(self, envs: Sequence[gym.Env[Any, Any]], seeds: Sequence[int]) -> None:
        self._envs = list(envs)
        self._seeds = list(seeds)

    def reset(self, copies: int) -> np.ndarray:
        """See ``Simulator.reset``."""
        pairs = zip(self._envs, self._seeds, strict=True)
        return np.stack([env.reset(seed=seed)[0] for env, seed in pairs])

    def step(self, sims: np.ndarray, actions: np.ndarray) -> Step:
        """See ``Simulator.step``."""
        pairs = zip(sims.tolist(), actions, strict=True)
        with quiet_mujoco():
            steps = [(*self._envs[sim].step(action)[:4], self._broke(sim)) for sim, action in pairs]
        observations, rewards, terminated, truncated, unstable = zip(*steps, strict=True)
        return Step(
            observations=np.stack(observations),
            rewards=np.array(rewards, np.float64),
            terminated=np.array(terminated, bool),
            truncated=np.array(truncated, bool),
            unstable=np.array(unstable, bool),
        )

    def _broke(self, sim: int) -> bool:
        """Return whether MuJoCo, if it is behind the environment, has reset a broken simulation."""
        data = getattr(self._envs[sim].unwrapped, "data", None)
        if not isinstance(data, mujoco.MjData):
            return False
        return any(data.warning[kind].number for kind in _UNSTABLE)

    def close(self) -> None:
        """See ``Simulator.close``."""
        for env in self._envs:
            env.close()
