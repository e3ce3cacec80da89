"""What Gymnasium's MuJoCo environments do around the physics, for many simulations at once.

A kernel computes observations, rewards and ends of episodes as the environment's ``step`` does, in
the same types and the same order, so that its numbers are Gymnasium's to the last bit; tests hold
it against ``step`` over 1,000 random actions. Settings such as reward weights are read from the
environment itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

State = Mapping[str, np.ndarray]
"""Fields of ``mujoco.MjData`` by name, each (simulation, ...)."""


class Kernel:
    """Base of the kernels: positions and velocities are observed, nothing ends an episode.

    Args:
        env: the environment, without wrappers.
    """

    fields: ClassVar[tuple[str, ...]] = ("qpos", "qvel")
    """Fields of ``mujoco.MjData`` that it reads."""
    hidden_positions: ClassVar[int] = 0
    """Leading positions that are not observed if the environment excludes them."""
    max_velocity: ClassVar[float | None] = None
    """Bound to which observed velocities are clipped."""

    def __init__(self, env: MujocoEnv) -> None:
        self.env: Any = env
        excludes = getattr(env, "_exclude_current_positions_from_observation", False)
        self._skip = self.hidden_positions if excludes else 0

    def observe(self, state: State) -> np.ndarray:
        """Return observations, float64 (simulation, obs)."""
        velocity = state["qvel"]
        if self.max_velocity is not None:
            velocity = np.clip(velocity, -self.max_velocity, self.max_velocity)
        return np.concatenate((state["qpos"][:, self._skip :], velocity), axis=1)

    def memory(self, state: State) -> np.ndarray:
        """Return what the next step's reward needs of the state before it."""
        return state["qpos"][:, 0].copy()

    def terminated(self, state: State) -> np.ndarray:
        """Return whether the episode ends here, bool (simulation,)."""
        return np.zeros(len(state["qpos"]), bool)

    def reward(
        self, before: np.ndarray, state: State, action: np.ndarray, terminated: np.ndarray
    ) -> np.ndarray:
        """Return rewards of a step, float64 (simulation,).

        Args:
            before: ``memory`` of the state before the step.
            state: after the step.
            action: float32 (simulation, action).
            terminated: whether the step ended the episode.
        """
        raise NotImplementedError


class _InvertedPendulum(Kernel):
    def terminated(self, state: State) -> np.ndarray:
        finite = np.isfinite(state["qpos"]).all(1) & np.isfinite(state["qvel"]).all(1)
        return ~finite | (np.abs(state["qpos"][:, 1]) > 0.2)

    def reward(
        self, before: np.ndarray, state: State, action: np.ndarray, terminated: np.ndarray
    ) -> np.ndarray:
        return np.ones(len(action))  # v4 pays for the last step too


class _InvertedPendulumV5(_InvertedPendulum):
    def reward(
        self, before: np.ndarray, state: State, action: np.ndarray, terminated: np.ndarray
    ) -> np.ndarray:
        return (~terminated).astype(np.float64)


class _InvertedDoublePendulum(Kernel):
    fields = ("qpos", "qvel", "qfrc_constraint", "site_xpos")
    observed_forces: ClassVar[slice] = slice(None)

    def observe(self, state: State) -> np.ndarray:
        cart, angles = state["qpos"][:, :1], state["qpos"][:, 1:]
        forces = np.clip(state["qfrc_constraint"], -10, 10)[:, self.observed_forces]
        velocity = np.clip(state["qvel"], -10, 10)
        return np.concatenate((cart, np.sin(angles), np.cos(angles), velocity, forces), axis=1)

    def terminated(self, state: State) -> np.ndarray:
        return np.asarray(state["site_xpos"][:, 0, 2] <= 1)

    def reward(
        self, before: np.ndarray, state: State, action: np.ndarray, terminated: np.ndarray
    ) -> np.ndarray:
        x, y = state["site_xpos"][:, 0, 0], state["site_xpos"][:, 0, 2]
        v1, v2 = state["qvel"][:, 1], state["qvel"][:, 2]
        distance = 0.01 * _square(x) + _square(y - 2)
        velocity = 1e-3 * _square(v1) + 5e-3 * _square(v2)
        return np.asarray(self._alive(terminated) - distance - velocity)

    def _alive(self, terminated: np.ndarray) -> Any:
        return 10


class _InvertedDoublePendulumV5(_InvertedDoublePendulum):
    observed_forces = slice(1)

    def _alive(self, terminated: np.ndarray) -> Any:
        return self.env._healthy_reward * (~terminated).astype(np.float64)


class _Runner(Kernel):
    """Pays for forward velocity, less a cost of control."""

    hidden_positions = 1

    def reward(
        self, before: np.ndarray, state: State, action: np.ndarray, terminated: np.ndarray
    ) -> np.ndarray:
        env = self.env
        forward = env._forward_reward_weight * ((state["qpos"][:, 0] - before) / env.dt)
        cost = env._ctrl_cost_weight * np.square(action).sum(1)
        return np.asarray(forward + self._alive(state) - cost)

    def _alive(self, state: State) -> Any:
        return 0.0


class _Swimmer(_Runner):
    hidden_positions = 2


class _Walker2d(_Runner):
    max_velocity = 10

    def terminated(self, state: State) -> np.ndarray:
        if not self.env._terminate_when_unhealthy:
            return np.zeros(len(state["qpos"]), bool)
        return np.asarray(~self._healthy(state))

    def _healthy(self, state: State) -> np.ndarray:
        z, angle = state["qpos"][:, 1], state["qpos"][:, 2]
        (low_z, high_z), (low, high) = self.env._healthy_z_range, self.env._healthy_angle_range
        return np.asarray((low_z < z) & (z < high_z) & (low < angle) & (angle < high))

    def _alive(self, state: State) -> Any:
        pays = self._healthy(state) | self.env._terminate_when_unhealthy  # v4: the last step too
        return pays.astype(np.float64) * self.env._healthy_reward


class _Walker2dV5(_Walker2d):
    def _alive(self, state: State) -> Any:
        return self._healthy(state) * self.env._healthy_reward


class _HopperHealth(_Walker2d):
    def _healthy(self, state: State) -> np.ndarray:
        low, high = self.env._healthy_state_range
        rest = np.concatenate((state["qpos"][:, 2:], state["qvel"]), axis=1)
        inside = ((low < rest) & (rest < high)).all(1)
        return np.asarray(super()._healthy(state) & inside)


class _Hopper(_HopperHealth, _Walker2d):
    pass


class _HopperV5(_HopperHealth, _Walker2dV5):
    pass


class _Reacher(Kernel):
    fields = ("qpos", "qvel", "xpos")
    observed_offset: ClassVar[slice] = slice(None)

    def __init__(self, env: MujocoEnv) -> None:
        super().__init__(env)
        self._bodies = [env.model.body(name).id for name in ("fingertip", "target")]

    def observe(self, state: State) -> np.ndarray:
        angles, rest = state["qpos"][:, :2], state["qpos"][:, 2:]
        offset = self.memory(state)[:, self.observed_offset]
        parts = (np.cos(angles), np.sin(angles), rest, state["qvel"][:, :2], offset)
        return np.concatenate(parts, axis=1)

    def memory(self, state: State) -> np.ndarray:
        fingertip, target = (state["xpos"][:, body] for body in self._bodies)
        return np.asarray(fingertip - target)

    def reward(
        self, before: np.ndarray, state: State, action: np.ndarray, terminated: np.ndarray
    ) -> np.ndarray:
        distance = -_norm(before)  # v4 pays for where the arm was
        return np.asarray(distance - np.square(action).sum(1))


class _ReacherV5(_Reacher):
    observed_offset = slice(2)

    def reward(
        self, before: np.ndarray, state: State, action: np.ndarray, terminated: np.ndarray
    ) -> np.ndarray:
        env = self.env
        distance = -_norm(self.memory(state)) * env._reward_dist_weight
        return np.asarray(distance - np.square(action).sum(1) * env._reward_control_weight)


_KERNELS: dict[str, type[Kernel]] = {
    "half_cheetah_v4": _Runner,
    "half_cheetah_v5": _Runner,
    "hopper_v4": _Hopper,
    "hopper_v5": _HopperV5,
    "inverted_double_pendulum_v4": _InvertedDoublePendulum,
    "inverted_double_pendulum_v5": _InvertedDoublePendulumV5,
    "inverted_pendulum_v4": _InvertedPendulum,
    "inverted_pendulum_v5": _InvertedPendulumV5,
    "reacher_v4": _Reacher,
    "reacher_v5": _ReacherV5,
    "swimmer_v4": _Swimmer,
    "swimmer_v5": _Swimmer,
    "walker2d_v4": _Walker2d,
    "walker2d_v5": _Walker2dV5,
}
"""Kernels by the module of Gymnasium that defines the environment."""

_HARMLESS = (OrderEnforcing, PassiveEnvChecker, TimeLimit)
"""Wrappers that change neither observation, action nor reward."""


def kernel_for(env: gym.Env[Any, Any]) -> Kernel | None:
    """The kernel of an environment; None: there is none, or wrappers change the environment."""
    inner: gym.Env[Any, Any] = env
    while isinstance(inner, gym.Wrapper):
        if type(inner) not in _HARMLESS:
            return None
        inner = inner.env
    package, _, module = type(inner).__module__.rpartition(".")
    known = package == "gymnasium.envs.mujoco" and isinstance(inner, MujocoEnv)
    if not known or module not in _KERNELS:
        return None
    return _KERNELS[module](cast(MujocoEnv, inner))


def _square(x: np.ndarray) -> np.ndarray:
    """As ``x**2`` rounds a number; of an array that is ``x * x``, now and then another last bit."""
    return np.asarray(np.float_power(x, 2))


def _norm(vectors: np.ndarray) -> np.ndarray:
    """Return Euclidean norms, rounded as ``np.linalg.norm`` rounds that of a single vector."""
    return np.asarray(np.sqrt(np.matmul(vectors[:, None, :], vectors[:, :, None])[:, 0, 0]))
