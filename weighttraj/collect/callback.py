"""The Stable-Baselines3 callback that records a policy's path through weight space."""

from __future__ import annotations

import weakref
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import nn

from weighttraj.collect.describe import (
    DIAGNOSTICS,
    actor_parameters,
    check_model,
    critic_parameters,
    describe_algorithm,
    describe_cadence,
    describe_env,
    describe_layout,
    describe_policy,
    describe_provenance,
)
from weighttraj.collect.normalizers import Normalizers, find_normalizers
from weighttraj.errors import CollectError
from weighttraj.format import RunInfo, RunWriter
from weighttraj.format.schema import Status
from weighttraj.format.writer import check_finite


class WeightTrajectoryCallback(BaseCallback):
    """Stores a snapshot of the policy every so many gradient steps, from inside ``train()``.

    The first snapshot is the policy before training, the last one the policy after it. No random
    number is drawn and nothing is evaluated, so training is the same bit by bit with and without
    this callback. Each row of the store holds only what was known when its snapshot was taken:
    an update's diagnostics stand beside the snapshot of its end, NaN beside the others.

    Args:
        path: folder of the run to be written, ``<data set>/runs/<run id>.zarr``.
        every: gradient steps from one snapshot to the next. PPO's default update (2048 samples,
            10 epochs, minibatches of 64) has 320 gradient steps: 64 gives 5 snapshots an update.
        run_id: id of the run; default: the path's name.
        critic: store the critic's parameters too.
        optimizer_moments: store Adam's moments of the policy's parameters too.
        probe_observations: network inputs kept of each rollout, evenly spaced; 0: none.
        block: snapshots in a chunk and in a commit; a killed process loses at most one block.
        resume: continue an interrupted run by repeating it: see ``RunWriter``.
        verbose: SB3's verbosity.

    Raises:
        CollectError: (when training starts) several optimizers or normalisers.
        StoreExistsError: (when training starts) the path exists.
        SnapshotError: (while training) the weights are not finite.

    SB3 tells callbacks nothing when training ends by an exception. Used as a context manager around
    ``learn``, the callback then commits the last snapshots and marks the run ``crashed``; otherwise
    the block that was being filled is lost, as if the process had been killed.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        every: int = 64,
        run_id: str | None = None,
        critic: bool = False,
        optimizer_moments: bool = False,
        probe_observations: int = 64,
        block: int = 64,
        resume: bool = False,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if every < 1:
            raise CollectError(
                "snapshots need at least one gradient step between them",
                expected="every at least 1",
                got=every,
            )
        self.path = Path(path)
        self.every = every
        self.run_id = run_id or self.path.name.removesuffix(".zarr")
        self.critic = critic
        self.optimizer_moments = optimizer_moments
        self.probe_observations = probe_observations
        self.block = block
        self.resume = resume
        self._algorithm: OnPolicyAlgorithm
        self._writer: RunWriter | None = None
        self._closed = False

    @property
    def writer(self) -> RunWriter:
        """The writer, once training has started.

        Raises:
            CollectError: it has not.
        """
        if self._writer is None:
            raise CollectError(
                "nothing is recorded before training starts",
                where=self.path,
                do="pass the callback to model.learn(..., callback=...)",
            )
        return self._writer

    def close(self, status: Status = "crashed") -> None:
        """Commit what is left and stop recording. Does nothing after training has ended well."""
        if self._writer is not None and not self._closed:
            self._closed = True
            self._hook.remove()
            try:
                self._append_pending()
            finally:
                self._writer.close(status)

    def __enter__(self) -> WeightTrajectoryCallback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _on_training_start(self) -> None:
        self._algorithm = model = check_model(self.model)
        if self._writer is not None:
            raise CollectError(
                "a callback records one call of learn()",
                got="a second call",
                where=self.path,
                do="make a new callback, with a new path, for the second call",
            )
        self._norm = find_normalizers(model.get_env() or self.training_env)
        if self.optimizer_moments and not isinstance(model.policy.optimizer, torch.optim.Adam):
            raise CollectError(
                "this optimizer has no moments to store",
                expected="Adam or AdamW",
                got=type(model.policy.optimizer).__name__,
                where=type(model).__name__,
                do="leave optimizer_moments out",
            )
        info = self._describe(model, self._norm)
        self._actor = actor_parameters(model.policy)
        self._critic = critic_parameters(model.policy)
        self._iteration = self._step = self._step_before = 0
        self._pending: dict[str, Any] | None = None
        self._ep_rew_mean = float("nan")
        self._writer = RunWriter(self.path, info, resume=self.resume)
        self._hook = model.policy.optimizer.register_step_post_hook(self._on_gradient_step)
        # For notebooks. Not at exit: Zarr's threads are gone by then.
        weakref.finalize(self, self._writer.close, "crashed").atexit = False
        self._snapshot()

    def _describe(self, model: OnPolicyAlgorithm, norm: Normalizers) -> RunInfo:
        policy = describe_policy(model.policy, norm.unknown)
        critic = describe_layout(critic_parameters(model.policy), policy)
        probes = self.probe_observations if policy.observation_shape else 0
        return RunInfo(
            run_id=self.run_id,
            layout=describe_layout(actor_parameters(model.policy), policy),
            policy=policy,
            env=describe_env(model, norm.wrappers),
            algorithm=describe_algorithm(model),
            seed=model.seed,
            cadence=describe_cadence(model, self.every),
            obs_norm=norm.obs_norm,
            ret_norm=norm.read_ret is not None,
            diagnostics=(*DIAGNOSTICS.get(type(model).__name__, ()), "ep_rew_mean"),
            critic_layout=critic if self.critic else None,
            optimizer_moments=self.optimizer_moments,
            probe_observations=min(probes, model.n_steps * model.n_envs),
            provenance=describe_provenance(),
            block=self.block,
        )

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._finish_iteration()

    def _on_rollout_end(self) -> None:
        self._iteration += 1
        self._step_before = self._step
        episodes = [episode["r"] for episode in self._algorithm.ep_info_buffer or ()]
        self._ep_rew_mean = float(np.mean(episodes)) if episodes else float("nan")
        if self.writer.info.probe_observations:
            inputs = np.asarray(self._algorithm.rollout_buffer.observations, np.float32)
            inputs = inputs.reshape(-1, *self.writer.info.policy.observation_shape)
            k = self.writer.info.probe_observations
            self.writer.append_iteration(inputs[np.arange(k) * len(inputs) // k])

    def _on_gradient_step(self, *_: object) -> None:
        self._step += 1
        if self._step % self.every == 0:
            self._snapshot()

    def _on_training_end(self) -> None:
        if self._step % self.every:
            self._snapshot()
        self._finish_iteration()
        self.close("complete")

    def _snapshot(self) -> None:
        """Copy the policy as it is now; it is appended when the next one comes."""
        self._append_pending()
        policy, norm = self._algorithm.policy, self._norm
        weights = check_finite("policy/weights", _flat([p.detach() for p in self._actor.values()]))
        steps = self._step - self._step_before
        per_epoch = self._steps_per_epoch()
        self._pending = {
            "weights": weights,
            "num_timesteps": self._algorithm.num_timesteps,
            "iteration": self._iteration,
            "epoch": steps // per_epoch if per_epoch else -1,
            "gradient_step": self._step,
            "phase": (steps - 1) // self.every if self._step else -1,
            "learning_rate": policy.optimizer.param_groups[0]["lr"] if self._step else float("nan"),
            "obs_norm": norm.read_obs() if norm.read_obs else None,
            "ret_norm": norm.read_ret() if norm.read_ret else None,
            "train": {"ep_rew_mean": self._ep_rew_mean},
            "critic": _flat([p.detach() for p in self._critic.values()]) if self.critic else None,
            "moments": self._moments(policy.optimizer) if self.optimizer_moments else None,
        }

    def _finish_iteration(self) -> None:
        """Put the diagnostics of the update that just ended beside the snapshot of its end."""
        if self._pending is not None and self._pending["gradient_step"] == self._step > 0:
            logged = self.logger.name_to_value
            for name in DIAGNOSTICS.get(type(self.model).__name__, ()):
                self._pending["train"][name] = float(logged.get(f"train/{name}", np.nan))
            self._append_pending()

    def _append_pending(self) -> None:
        if self._pending is not None:
            snapshot, self._pending = self._pending, None
            self.writer.append(**snapshot)

    def _steps_per_epoch(self) -> int | None:
        cadence = self.writer.info.cadence
        steps = cadence.gradient_steps_per_iteration if cadence else None
        epochs = getattr(self.model, "n_epochs", 1)
        return steps // epochs if steps else None

    def _moments(self, optimizer: torch.optim.Optimizer) -> tuple[np.ndarray, np.ndarray]:
        def read(name: str) -> np.ndarray:
            states = [(p, optimizer.state.get(p, {})) for p in self._actor.values()]
            return _flat([s.get(name, torch.zeros_like(p)).detach() for p, s in states])

        return read("exp_avg"), read("exp_avg_sq")


def _flat(tensors: list[torch.Tensor]) -> np.ndarray:
    """A copy of the tensors as one float32 vector."""
    return nn.utils.parameters_to_vector(tensors).to("cpu", torch.float32).numpy().copy()
