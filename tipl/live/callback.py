"""The Stable-Baselines3 callback that moves PPO's policy to where it is forecast to go."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import msgspec
import numpy as np
import torch
from jaxtyping import Float32
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecMonitor,
    VecNormalize,
    is_vecenv_wrapped,
)

from tipl.errors import ForecastError
from tipl.forecaster import Forecaster
from tipl.live.config import Jump, JumpConfig
from tipl.live.guards import ReturnWatch, passes_batch, surrogate
from tipl.live.path import TrainingPath, forecaster_of
from weighttraj.atomic import replace_file
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.collect.agents import Agent, find_agent
from weighttraj.collect.describe import describe_agent, describe_layout
from weighttraj.collect.undisturbed import undisturbed

_DEFAULT = JumpConfig()


@dataclass(frozen=True, kw_only=True)
class _Before:
    """What the guard ``rollout`` goes back to."""

    jump: Jump
    policy: dict[str, Any]
    optimizer: dict[str, Any]
    statistics: list[dict[str, Any]]


class ForecastCallback(BaseCallback):
    """Jumps ahead between two iterations of PPO: moves the actor to where a forecast expects it.

    The critic stays as it is, and so does the exploration noise ``log_std`` unless ``config`` says
    otherwise. Training is the same, bit by bit, as long as no jump is made. Beside a
    ``WeightTrajectoryCallback`` of the same training, the jumps are written to ``RUN.jumps.json``
    as they happen. The recorded run ends with the last gradient step: if the guard ``rollout``
    undoes the last jump after it, the trained model is not the last snapshot.

    A second call of ``learn`` of the same model continues the path and the jumps of the first one.

    Args:
        forecaster: a folder, a name or an address for ``tipl.load``, or the forecaster itself.
        config: when, how far and under which guard.
        log: JSON file for the jumps; None: beside the recorded run, if there is one.
        verbose: Stable-Baselines3's verbosity.

    Raises:
        ForecastError: the forecaster needs the future of the run; or (when training starts) the
            model is no PPO, or another one than before, an iteration has too few gradient steps, or
            the guard ``rollout`` cannot put a normaliser back; or (when an episode ends) that guard
            cannot see its return; or the jumps cannot be written.
        ModelError: (at the first jump) the forecaster was trained on another cadence.
    """

    model: PPO

    def __init__(
        self,
        forecaster: str | Path | Forecaster,
        config: JumpConfig = _DEFAULT,
        *,
        log: str | Path | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.config = config
        self._forecaster = forecaster_of(forecaster)
        self._log = None if log is None else Path(log)
        self._iteration = 0
        self._returns: list[float] = []
        self._watch = ReturnWatch(config)
        self._before: _Before | None = None
        self._fallen = False
        self._path: TrainingPath | None = None
        self._followed: PPO | None = None
        self._has_monitor = False
        self._batch: dict[str, Any] = {}
        self._hook: Any = None
        self._agent: Agent

    @property
    def jumps(self) -> list[Jump]:
        """What was done so far."""
        return [] if self._path is None else self._path.jumps

    @property
    def seconds(self) -> float:
        """CPU time of forecasts and of keeping the path so far."""
        return 0.0 if self._path is None else self._path.seconds

    def _on_training_start(self) -> None:
        if not isinstance(self.model, PPO):
            raise ForecastError(
                "the callback jumps in trainings by PPO only",
                expected="stable_baselines3.PPO",
                got=type(self.model).__name__,
                do="leave the callback out",
            )
        if self._followed not in (None, self.model):
            raise ForecastError(
                "the callback has followed the training of another model",
                expected="the same model in each call of learn",
                got=f"another {type(self.model).__name__}",
                do="make a new callback for this model",
            )
        self._followed, self._agent = self.model, find_agent(self.model)
        if self._path is None:  # a second call of learn continues the same path
            layout = describe_layout(self._agent.actor, describe_agent(self._agent, ()))
            self._path = TrainingPath(self._forecaster, self.config, layout, self._weights())
        self._path.end_iteration(self._weights())
        self._before, self._fallen, self._returns = None, False, []
        samples = self.model.n_steps * self.model.n_envs
        self._path.check_iteration(self.model.n_epochs * -(-samples // self.model.batch_size))
        if self.config.guard == "rollout":
            self._check_normalizers()
            self._has_monitor = _has_monitor(cast(VecEnv, self.model.get_env()))
        if self._log is not None:
            self._write_jumps()
        if self._hook is not None:  # an exception ended the call of learn() before
            self._hook.remove()
        optimizer = cast(torch.optim.Optimizer, self._agent.optimizer)
        self._hook = optimizer.register_step_post_hook(self._on_gradient_step)
        self._trained = False

    def _on_step(self) -> bool:
        infos = self.locals.get("infos", ())
        for info, done in zip(infos, self.locals.get("dones", [False] * len(infos)), strict=True):
            if (episode := info.get("episode")) is not None:
                self._returns.append(float(np.asarray(episode["r"]).item()))
            elif done and self.config.guard == "rollout" and not self._has_monitor:
                raise ForecastError(
                    "an episode ended without a reported return, which the guard 'rollout' needs",
                    expected="an environment in Stable-Baselines3's Monitor or VecMonitor",
                    got="an info without 'episode'",
                    do="wrap the environment in Monitor, or choose another guard",
                )
        return True

    def _on_rollout_end(self) -> None:
        self._trained = True
        self._iteration += 1
        self._fallen = self._before is not None and self._watch.has_fallen(self._returns)
        if not self._fallen:
            self._watch.add(self._returns)
        self._returns = []
        if self.config.guard == "batch":
            buffer = self.model.rollout_buffer
            names = ("observations", "actions", "log_probs", "advantages")
            self._batch = {name: _kept(getattr(buffer, name)) for name in names}

    def _on_gradient_step(self, *_: object) -> None:
        path = cast(TrainingPath, self._path)
        if path.end_gradient_step():
            rate = self._agent.learning_rate
            path.append(self._weights(), self._iteration, self.model.num_timesteps, rate)

    @torch.no_grad()
    def _on_rollout_start(self) -> None:
        if self._path is None or not self._trained:
            return
        now = self._weights()
        if self._before is not None and self._fallen:
            self._undo(now, self._before)
            return
        self._before = None
        with undisturbed():
            proposed = self._path.propose(
                now,
                self._iteration,
                self.model.num_timesteps,
                self.model._current_progress_remaining,
            )
            if proposed is not None:
                self._jump(now, *proposed)

    def _check_normalizers(self) -> None:
        """Refuse normalisers that the guard ``rollout`` could not put back."""
        env = cast(VecEnv, self.model.get_env()).unwrapped
        kinds = (gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward)
        if isinstance(env, DummyVecEnv):
            return
        found = [kind.__name__ for kind in kinds if any(env.env_is_wrapped(cast(Any, kind)))]
        if found:
            raise ForecastError(
                "the guard 'rollout' cannot put normalisers in other processes back",
                expected="VecNormalize, or environments in a DummyVecEnv",
                got=f"{', '.join(found)} in a {type(env).__name__}",
                do="normalise with VecNormalize, or choose another guard",
            )

    def _jump(
        self, now: Float32[np.ndarray, " param"], jump: Jump, after: Float32[np.ndarray, " param"]
    ) -> None:
        """Make a jump, unless the guard refuses it."""
        path = cast(TrainingPath, self._path)
        path.jumps.append(jump)
        saved = self._save(jump) if self.config.guard == "rollout" else None
        with self._moving():
            accepted = self._move(after)
            if accepted:
                path.moved(now, self._weights())
                self._before = saved
            else:
                jump.outcome = "refused"
        if accepted and self.config.moments == "reset":
            self._forget_direction()
        self._write_jumps()

    def _move(self, after: Float32[np.ndarray, " param"]) -> bool:
        """Set the actor's weights; set them back and return False if the guard refuses."""
        before = self._weights()
        guarded = self.config.guard == "batch"
        old = self._judge() if guarded else None
        self._write(after)
        if old is None:
            return True
        new = self._judge()
        each = kl_divergence(old[0], new[0])  # (sample,) or (sample, action)
        kl = float(each.reshape(len(each), -1).sum(1).mean())
        if passes_batch(kl, old[1], new[1], self.config):
            return True
        self._write(before)
        return False

    def _judge(self) -> tuple[Any, float]:
        """Return the policy's distributions on the last rollout, and its surrogate."""
        policy = self.model.policy
        observations, actions = self._flat("observations"), self._flat("actions").float()
        distribution = copy.copy(policy.get_distribution(observations))
        if isinstance(policy.action_space, gym.spaces.Discrete):  # as PPO.train
            actions = actions.long().flatten()
        change = distribution.log_prob(actions) - self._flat("log_probs")
        clip = cast(Any, self.model.clip_range)(self.model._current_progress_remaining)
        return distribution, surrogate(change, self._flat("advantages"), clip)

    def _flat(self, name: str) -> Any:
        """Return a part of the last rollout with its steps and environments in one axis."""
        rows, device = self._batch[name], self.model.device
        if isinstance(rows, dict):
            return {key: _flattened(value, device) for key, value in rows.items()}
        return _flattened(rows, device)

    def _undo(self, now: Float32[np.ndarray, " param"], before: _Before) -> None:
        """Put everything back to what it was before the jump; the environment steps are spent."""
        before.jump.outcome = "undone"
        with self._moving():
            self.model.policy.load_state_dict(before.policy)
            rate = self._agent.learning_rate
            self.model.policy.optimizer.load_state_dict(before.optimizer)
            for group in self.model.policy.optimizer.param_groups:
                group["lr"] = rate
            for stats, old in zip(self._statistics(), before.statistics, strict=True):
                vars(stats).update(copy.deepcopy(old))
            cast(TrainingPath, self._path).moved(now, self._weights())
        self._before = None
        self._write_jumps()

    def _save(self, jump: Jump) -> _Before:
        policy = self.model.policy
        return _Before(
            jump=jump,
            policy=copy.deepcopy(policy.state_dict()),
            optimizer=copy.deepcopy(policy.optimizer.state_dict()),
            statistics=[copy.deepcopy(vars(stats)) for stats in self._statistics()],
        )

    def _statistics(self) -> list[Any]:
        """Return the running statistics of all normalisers of the training environment."""
        found: list[Any] = []
        env: Any = self.model.get_env()
        while isinstance(env, VecEnv):
            if isinstance(env, VecNormalize):
                observed = env.obs_rms
                found += observed.values() if isinstance(observed, dict) else [observed]
                found.append(env.ret_rms)
            if isinstance(env, DummyVecEnv):
                found += [stats for one in env.envs for stats in _statistics_of(one)]
            env = getattr(env, "venv", None)
        return found

    def _forget_direction(self) -> None:
        """Set Adam's first moment of the actor's parameters to 0."""
        state = self.model.policy.optimizer.state
        for parameter in self._agent.actor.values():
            if "exp_avg" in state.get(parameter, {}):
                state[parameter]["exp_avg"].zero_()

    def _weights(self) -> Float32[np.ndarray, " param"]:
        parameters = [p.detach() for p in self._agent.actor.values()]
        vector = torch.nn.utils.parameters_to_vector(parameters)
        return vector.to("cpu", torch.float32).numpy().copy()

    @torch.no_grad()
    def _write(self, weights: Float32[np.ndarray, " param"]) -> None:
        rest = torch.from_numpy(weights)
        for parameter in self._agent.actor.values():
            part, rest = rest[: parameter.numel()], rest[parameter.numel() :]
            parameter.copy_(part.view_as(parameter))

    @contextlib.contextmanager
    def _moving(self) -> Iterator[None]:
        """Change weights with the knowledge of those who record them."""
        with contextlib.ExitStack() as stack:
            for recorder in _recorders(self.locals.get("callback")):
                stack.enter_context(recorder.moving(type(self).__name__))
            yield

    @torch.no_grad()
    def _on_training_end(self) -> None:
        self._hook.remove()
        if self._before is not None and self._fallen:
            self._undo(self._weights(), self._before)
        self._before = None
        self._write_jumps()

    def _write_jumps(self) -> None:
        """Write all jumps so far, so that a training that is killed leaves them too."""
        paths = [_beside(recorder.path) for recorder in _recorders(self.locals.get("callback"))]
        content = msgspec.json.encode([asdict(jump) for jump in self.jumps])
        for path in [self._log] if self._log is not None else paths:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                replace_file(path, msgspec.json.format(content, indent=1) + b"\n")
            except OSError as error:
                raise ForecastError(
                    "the jumps cannot be written",
                    expected="a file that can be written",
                    got=error.strerror or repr(error),
                    where=path,
                    do="choose another path for the log",
                ) from error


def _recorders(callback: Any) -> list[WeightTrajectoryCallback]:
    """Return the callbacks that record the training."""
    if isinstance(callback, CallbackList):
        return [found for one in callback.callbacks for found in _recorders(one)]
    return [callback] if isinstance(callback, WeightTrajectoryCallback) else []


def _has_monitor(env: VecEnv) -> bool:
    """Say whether something around an environment reports the returns of episodes."""
    kinds: Any = (Monitor, gym.wrappers.RecordEpisodeStatistics)
    inside = any(any(env.env_is_wrapped(kind)) for kind in kinds)
    return inside or is_vecenv_wrapped(env, VecMonitor)


def _kept(rows: Any) -> Any:
    """Return arrays of a rollout buffer that stay as they are when the buffer is read or reset."""
    return dict(rows) if isinstance(rows, dict) else rows


def _flattened(rows: np.ndarray, device: torch.device) -> torch.Tensor:
    return torch.as_tensor(rows.reshape(-1, *rows.shape[2:]), device=device)


def _beside(run: Path) -> Path:
    return run.with_name(run.name.removesuffix(".zarr") + ".jumps.json")


def _statistics_of(env: Any) -> Iterator[Any]:
    """Yield the running statistics of Gymnasium's normalisers around an environment."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.NormalizeObservation):
            yield env.obs_rms
        if isinstance(env, gym.wrappers.NormalizeReward):
            yield env.return_rms
        env = env.env
