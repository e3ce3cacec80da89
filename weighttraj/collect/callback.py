"""The Stable-Baselines3 callback that records a policy's path through weight space."""

from __future__ import annotations

import warnings
import weakref
from pathlib import Path

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
    describe_run,
)
from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.recorder import Reading, Recorder
from weighttraj.errors import CollectError, PolicyError
from weighttraj.format import RunInfo, RunWriter
from weighttraj.format.schema import Status


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
        self._recorder: Recorder | None = None

    @property
    def writer(self) -> RunWriter:
        """The writer, once training has started.

        Raises:
            CollectError: it has not.
        """
        return self._recording.writer

    def close(self, status: Status = "crashed") -> None:
        """Commit what is left and stop recording. Does nothing after training has ended well."""
        if self._recorder is not None:
            self._hook.remove()
            self._recorder.close(status)

    def __enter__(self) -> WeightTrajectoryCallback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _on_training_start(self) -> None:
        self._algorithm = model = check_model(self.model)
        if self._recorder is not None:
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
        self._actor = actor_parameters(model.policy)
        self._critic = critic_parameters(model.policy)
        info = describe_run(
            model,
            self._norm,
            run_id=self.run_id,
            every=self.every,
            critic=self.critic,
            optimizer_moments=self.optimizer_moments,
            probe_observations=self.probe_observations,
            block=self.block,
        )
        _warn_if_lost(info, self.path)
        steps = info.cadence.gradient_steps_per_iteration if info.cadence else None
        self._recorder = Recorder(
            self.path,
            info,
            self._read,
            every=self.every,
            steps_per_epoch=steps // getattr(model, "n_epochs", 1) if steps else None,
            resume=self.resume,
        )
        self._hook = model.policy.optimizer.register_step_post_hook(self._on_gradient_step)
        # For notebooks. Not at exit: Zarr's threads are gone by then.
        weakref.finalize(self, self._recorder.writer.close, "crashed").atexit = False

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._recording.end_update(self._diagnostics())

    def _on_rollout_end(self) -> None:
        returns = [episode["r"] for episode in self._algorithm.ep_info_buffer or ()]
        inputs: np.ndarray = np.empty(0)
        if self.writer.info.probe_observations:
            inputs = np.asarray(self._algorithm.rollout_buffer.observations, np.float32)
            inputs = inputs.reshape(-1, *self.writer.info.policy.observation_shape)
        self._recording.end_rollout(returns, inputs)

    def _on_gradient_step(self, *_: object) -> None:
        self._recording.end_gradient_step()

    def _on_training_end(self) -> None:
        self._hook.remove()
        self._recording.end_training(self._diagnostics())

    @property
    def _recording(self) -> Recorder:
        if self._recorder is None:
            raise CollectError(
                "nothing is recorded before training starts",
                where=self.path,
                do="pass the callback to model.learn(..., callback=...)",
            )
        return self._recorder

    def _read(self) -> Reading:
        policy, norm = self._algorithm.policy, self._norm
        return {
            "weights": _flat([p.detach() for p in self._actor.values()]),
            "num_timesteps": self._algorithm.num_timesteps,
            "learning_rate": policy.optimizer.param_groups[0]["lr"],
            "obs_norm": norm.read_obs() if norm.read_obs else None,
            "ret_norm": norm.read_ret() if norm.read_ret else None,
            "critic": _flat([p.detach() for p in self._critic.values()]) if self.critic else None,
            "moments": self._moments(policy.optimizer) if self.optimizer_moments else None,
        }

    def _diagnostics(self) -> dict[str, float]:
        logged, names = self.logger.name_to_value, DIAGNOSTICS.get(type(self.model).__name__, ())
        return {name: float(logged.get(f"train/{name}", np.nan)) for name in names}

    def _moments(self, optimizer: torch.optim.Optimizer) -> tuple[np.ndarray, np.ndarray]:
        def read(name: str) -> np.ndarray:
            states = [(p, optimizer.state.get(p, {})) for p in self._actor.values()]
            return _flat([s.get(name, torch.zeros_like(p)).detach() for p, s in states])

        return read("exp_avg"), read("exp_avg_sq")


def _warn_if_lost(info: RunInfo, path: Path) -> None:
    """Tell the trainer, before the training begins, that the run's policies cannot be rebuilt."""
    if info.policy.cannot_rebuild:
        text = PolicyError(
            "the weights of this training are recorded, but run.load_policy(t) cannot rebuild "
            "its policies from them",
            got="; ".join(info.policy.cannot_rebuild),
            where=path,
            do="load snapshots into a model of your own with run.load_into(model, t)",
        )
        warnings.warn(text.message, UserWarning, stacklevel=2)


def _flat(tensors: list[torch.Tensor]) -> np.ndarray:
    """A copy of the tensors as one float32 vector."""
    return nn.utils.parameters_to_vector(tensors).to("cpu", torch.float32).numpy().copy()
