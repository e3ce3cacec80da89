"""The Stable-Baselines3 callback that records a policy's path through weight space."""

from __future__ import annotations

import contextlib
import warnings
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from weighttraj.collect.agents import Agent, Unit, find_agent
from weighttraj.collect.describe import describe_agent, describe_run, diagnostics_of
from weighttraj.collect.guard import Guard
from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.origin import find_origin, find_source
from weighttraj.collect.recorder import Counters, Reading, Recorder
from weighttraj.collect.settings import Store
from weighttraj.collect.watch import Watch
from weighttraj.errors import CollectError, PolicyError
from weighttraj.format import RunInfo
from weighttraj.format.schema import Status
from weighttraj.run import Run
from weighttraj.writer import RunWriter

_WATCHED_STEPS = 64
"""First gradient steps before which the weights of off-policy algorithms are compared; those of
others are compared before each step of the first update."""


class WeightTrajectoryCallback(BaseCallback):
    """Stores a snapshot of the policy every so many gradient steps, from inside ``train()``.

    The first snapshot is the policy before training, the last one the policy after it. No random
    number is drawn and nothing is evaluated, so training is the same bit by bit with and without
    this callback. Each row of the store holds only what was known when its snapshot was taken:
    an update's diagnostics stand beside the snapshot of its end, NaN beside the others.

    It records algorithms whose optimizer steps the policy: PPO, A2C, MaskablePPO and RecurrentPPO,
    whose snapshots have an iteration and a phase; and SAC, TD3, DDPG, DQN, TQC, CrossQ and QR-DQN,
    which have none. There the parameters are those of the actor or the Q-network, and the steps
    those of its optimizer: with TD3's ``policy_delay`` of 2, one for two steps of the critic. It
    is checked that the weights change by the counted steps only. Algorithms that move their policy
    in another way, such as TRPO, are recorded with ``unit="update"``.

    Args:
        path: folder of the run to be written, ``<data set>/runs/<run id>.zarr``.
        every: gradient steps (or updates) from one snapshot to the next. PPO's default update (2048
            samples, 10 epochs, minibatches of 64) has 320 gradient steps: 64, the default, gives 5
            snapshots an update. The default for ``unit="update"`` is 1.
        unit: what is counted: ``"gradient_step"``, the optimizer's steps, or ``"update"``, all that
            changes the weights between two rollouts.
        run_id: id of the run; default: the path's name.
        continues: run that the training goes on from, or its path. The model's weights must be
            one of its snapshots: the new run says which, and its counters go on from there.
        critic: store the critic's parameters too.
        optimizer_moments: store Adam's moments of the policy's parameters too.
        probe_observations: network inputs kept of each rollout, evenly spaced; 0: none. Off-policy
            algorithms have no rollouts, and none are kept.
        block: snapshots in a chunk and in a commit; a killed process loses at most one block.
        resume: continue an interrupted run by repeating it: see ``RunWriter``.
        verbose: SB3's verbosity.

    Raises:
        CollectError: (when training starts, before anything is written) no single optimizer steps
            the policy; several normalisers; the model is no snapshot of the run that it continues.
            (after the first update, and nothing is kept; or later) the weights change outside the
            counted steps.
        StoreExistsError: (when training starts) the path exists.
        SnapshotError: (while training) the weights are not finite.

    An exception that ends ``learn``, such as Ctrl-C, is noticed: what was recorded is committed
    and the run is marked ``crashed``. A callback records one call of ``learn``. A second call,
    with ``reset_num_timesteps=False``, gets a callback of its own that ``continues`` the first run.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        every: int | None = None,
        unit: Unit | str = "gradient_step",
        run_id: str | None = None,
        continues: Run | str | Path | None = None,
        critic: bool = False,
        optimizer_moments: bool = False,
        probe_observations: int = 64,
        block: int = 64,
        resume: bool = False,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if unit not in get_args(Unit):
            raise CollectError(
                "an unknown unit of steps",
                expected=" or ".join(map(repr, get_args(Unit))),
                got=repr(unit),
                do="choose what is counted",
            )
        if every is None:
            every = 64 if unit == "gradient_step" else 1
        if every < 1:
            raise CollectError(
                "snapshots need at least one gradient step between them",
                expected="every at least 1",
                got=every,
                do="set every to at least 1",
            )
        self.path = Path(path)
        self.unit: Unit = "update" if unit == "update" else "gradient_step"
        self.run_id = run_id or self.path.name.removesuffix(".zarr")
        self.continues = continues
        self.store = Store(
            every=every,
            critic=critic,
            optimizer_moments=optimizer_moments,
            probe_observations=probe_observations,
            block=block,
        )
        self.resume = resume
        self._agent: Agent
        self._watch: Watch
        self._recorder: Recorder | None = None
        self._undo: list[Callable[[], None]] = []
        self._steps = 0
        self._trusted = False

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
            self._let_go()
            self._recorder.close(status)

    @contextlib.contextmanager
    def moving(self, by: str) -> Iterator[None]:
        """Let another callback change the weights, between an update and the next rollout.

        The next snapshot shows the changed weights, with the gradient steps that came after.

        Args:
            by: name of the other callback; the run's metadata will have it in ``moved_by``.
        """
        if self._recorder is None:  # this callback's turn comes after the other's
            yield
            return
        self._end_update()
        try:
            yield
        finally:
            if self._watch.has_moved():
                self.writer.note_move(by)
            self._watch.note()

    def __enter__(self) -> WeightTrajectoryCallback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _on_training_start(self) -> None:
        if self._recorder is not None:
            raise CollectError(
                "a callback records one call of learn()",
                got="a second call",
                where=self.path,
                do="make a new callback for the second call, with a path of its own; where the "
                "training goes on, with reset_num_timesteps=False, give it "
                f"continues={str(self.path)!r}",
            )
        self._agent = find_agent(self.model, self.unit)
        self._norm = find_normalizers(self.model.get_env() or self.training_env)
        self._check_options()
        info, counters = self._describe()
        _warn_if_lost(info, self.path)
        _warn_if_not_remade(info, self.path)
        steps = info.cadence.gradient_steps_per_iteration if info.cadence else None
        self._recorder = Recorder(
            self.path,
            info,
            self._read,
            every=self.store.every,
            steps_per_epoch=steps // getattr(self.model, "n_epochs", 1) if steps else None,
            rollouts=self._agent.has_rollouts,
            start=counters,
            resume=self.resume,
        )
        self._watch = Watch(self._agent)
        self._hold_on()
        # For notebooks. Not at exit: Zarr's threads are gone by then.
        weakref.finalize(self, self._recorder.writer.close, "crashed").atexit = False

    def _check_options(self) -> None:
        """Raise CollectError if something is to be stored that the algorithm does not have."""
        agent, name = self._agent, type(self.model).__name__
        if self.store.optimizer_moments and not isinstance(agent.optimizer, torch.optim.Adam):
            raise CollectError(
                "this optimizer has no moments to store",
                expected="Adam or AdamW",
                got=type(agent.optimizer).__name__ if agent.optimizer else f"unit={self.unit!r}",
                where=name,
                do="leave optimizer_moments out",
            )
        if self.store.critic and not agent.critic:
            raise CollectError(
                "this algorithm has no critic apart from the network that acts",
                expected="an actor and a critic, as in PPO or SAC",
                got=name,
                do="leave critic out",
            )

    def _describe(self) -> tuple[RunInfo, Counters]:
        """Return the run's metadata and the counters that it starts with."""
        info = describe_run(self._agent, self._norm, self.run_id, self.store)
        self._timesteps_before = 0
        if self.continues is None:
            return replace(info, continues=find_origin(self._agent)), Counters()
        weights = _flat(list(self._agent.actor.values()))
        origin, counters = find_source(
            self.continues, self._agent, info.layout, weights, self._norm
        )
        self._timesteps_before = origin.num_timesteps - self.model.num_timesteps
        return replace(info, continues=origin), counters

    def _hold_on(self) -> None:
        """Follow the optimizer's steps, and notice when an exception ends the training."""
        callback = self.locals.get("callback")
        self._undo = [Guard(self.model, self.close, callback, self._abandon).remove]
        optimizer = self._agent.optimizer
        if optimizer is not None:
            self._undo += [
                optimizer.register_step_pre_hook(self._on_step_begin).remove,
                optimizer.register_step_post_hook(self._on_gradient_step).remove,
            ]

    def _abandon(self) -> None:
        """Leave no run: the training does not begin."""
        self._let_go()
        self._recording.discard()

    def _let_go(self) -> None:
        for undo in self._undo:
            undo()
        self._undo = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._end_update()
        self._recording.end_update(self._diagnostics())

    def _on_rollout_end(self) -> None:
        returns = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        if not self._agent.has_rollouts:
            self._recording.note_returns(returns)
            return
        self._check("during a rollout")
        inputs: np.ndarray = np.empty(0)
        if self.writer.info.probe_observations and self._agent.on_policy is not None:
            inputs = np.asarray(self._agent.on_policy.rollout_buffer.observations, np.float32)
            inputs = inputs.reshape(-1, *self.writer.info.policy.observation_shape)
        self._recording.end_rollout(returns, inputs)

    def _on_step_begin(self, *_: object) -> None:
        if not self._trusted:  # later the borders of updates will do
            self._check("between the optimizer's steps")

    def _on_gradient_step(self, *_: object) -> None:
        self._watch.note()
        self._steps += 1
        self._recording.end_gradient_step()

    def _end_update(self) -> None:
        """Count an update, or check that its steps were counted."""
        if self.unit == "update":
            if self._watch.has_moved():
                self._on_gradient_step()
        else:
            self._check("at the end of an update")
        if self._steps >= (1 if self._agent.has_rollouts else _WATCHED_STEPS):
            self._trusted = True

    def _check(self, when: str) -> None:
        try:
            self._watch.check(when)
        except CollectError:
            self._let_go()
            if self._trusted:
                self._recording.close("crashed")
            else:
                self._recording.discard()
            raise

    def _on_training_end(self) -> None:
        try:
            self._end_update()
            self._check_again()
            self._recording.end_training(self._diagnostics())
        finally:
            self.close()

    def _check_again(self) -> None:
        """Compare the rebuilt policy with the agent again: its code may act otherwise by now."""
        before = self.writer.info.policy
        reasons = describe_agent(self._agent, self._norm.unknown).cannot_rebuild
        if reasons and not before.cannot_rebuild:
            now = replace(before, kind="other", acting="", cannot_rebuild=reasons)
            self.writer.describe_again(now)
            _warn_if_lost(self.writer.info, self.path)

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
        agent, norm = self._agent, self._norm
        return {
            "weights": _flat(list(agent.actor.values())),
            "num_timesteps": self.model.num_timesteps + self._timesteps_before,
            "learning_rate": agent.learning_rate,
            "obs_norm": norm.read_obs() if norm.read_obs else None,
            "ret_norm": norm.read_ret() if norm.read_ret else None,
            "critic": _flat(list(agent.critic.values())) if self.store.critic else None,
            "moments": self._moments() if self.store.optimizer_moments else None,
        }

    def _diagnostics(self) -> dict[str, float]:
        logged, names = self.logger.name_to_value, diagnostics_of(self.model)
        return {name: float(logged.get(f"train/{name}", np.nan)) for name in names}

    def _moments(self) -> tuple[np.ndarray, np.ndarray]:
        state = self._agent.optimizer.state if self._agent.optimizer is not None else {}

        def read(name: str) -> np.ndarray:
            parameters = self._agent.actor.values()
            return _flat([state.get(p, {}).get(name, torch.zeros_like(p)) for p in parameters])

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


def _warn_if_not_remade(info: RunInfo, path: Path) -> None:
    """Tell the trainer, before the training begins, that the environment cannot be made again."""
    if info.env is not None and info.env.cannot_remake:
        text = PolicyError(
            "this training is recorded, but its environment cannot be made again from the record",
            got="; ".join(info.env.cannot_remake),
            where=f"{path}, {info.env.id}",
            do="keep the code that makes it, for weighttraj.policies.evaluate(policy, my_function)",
        )
        warnings.warn(text.message, UserWarning, stacklevel=2)


def _flat(tensors: list[torch.Tensor]) -> np.ndarray:
    """A copy of the tensors as one float32 vector."""
    detached = [tensor.detach() for tensor in tensors]
    vector = nn.utils.parameters_to_vector(detached)
    return vector.to("cpu", torch.float32).numpy().copy()
