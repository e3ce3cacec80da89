"""Which snapshots of a training are stored, and what stands beside each, whoever trains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weighttraj.format import RunInfo
from weighttraj.format.schema import Status
from weighttraj.writer import RunWriter, check_finite

Reading = Mapping[str, Any]
"""What an agent is at this moment: ``weights``, ``num_timesteps``, ``learning_rate``, and
``obs_norm``, ``ret_norm``, ``critic`` and ``moments`` where there are any. Copies, not views."""


@dataclass(frozen=True, kw_only=True)
class Counters:
    """Where a training stands."""

    iteration: int = 0
    """Rollouts begun."""
    gradient_step: int = 0
    """Steps of the optimizer."""


class Recorder:
    """Stores a snapshot of an agent every so many gradient steps.

    The first snapshot is the policy before training, the last one the policy after it. Each row
    holds only what was known when its snapshot was taken: an update's diagnostics stand beside the
    snapshot of its end, NaN beside the others.

    Args:
        path: folder of the run to be written.
        info: metadata of the run.
        read: reads the agent.
        every: gradient steps from one snapshot to the next.
        steps_per_epoch: gradient steps in a pass over the rollout; None: it varies.
        rollouts: whether training alternates between rollouts and updates; else iteration, epoch
            and phase are not recorded.
        start: counters that the first snapshot has, where the training goes on from another run.
        resume: continue an interrupted run by repeating it: see ``RunWriter``.

    Raises:
        StoreExistsError: the path exists, and ``resume`` is False.
        StoreLockedError: another process is writing this run.
        FormatError: the run at the path was started with other settings, or is complete.
        SnapshotError: (here and later) the weights are not finite.
        ReplayError: (here and later) a continued run does not repeat what it had committed.
    """

    def __init__(
        self,
        path: Path,
        info: RunInfo,
        read: Callable[[], Reading],
        *,
        every: int,
        steps_per_epoch: int | None,
        rollouts: bool = True,
        start: Counters | None = None,
        resume: bool = False,
    ) -> None:
        self._every = every
        self._read = read
        self._steps_per_epoch = steps_per_epoch
        self._rollouts = rollouts
        self._start = start or Counters()
        self._iteration = self._start.iteration
        self._step = self._step_before = self._start.gradient_step
        self._pending: dict[str, Any] | None = None
        self._ep_rew_mean = float("nan")
        self._closed = False
        self.writer = RunWriter(path, info, resume=resume)
        try:
            self._snapshot()
        except BaseException:
            self.close()
            raise

    def end_rollout(self, returns: Sequence[Any], inputs: np.ndarray) -> None:
        """Begin an iteration: its rollout is there, its update comes.

        Args:
            returns: numbers, of the last episodes; their mean is stored with the snapshots to come.
            inputs: network inputs of the rollout, (step, *obs).
        """
        self._iteration += 1
        self._step_before = self._step
        self.note_returns(returns)
        k = self.writer.info.probe_observations
        if k:
            self.writer.append_iteration(inputs[np.arange(k) * len(inputs) // k])

    def note_returns(self, returns: Sequence[Any]) -> None:
        """Remember the returns of the last episodes; their mean is stored with later snapshots."""
        self._ep_rew_mean = float(np.mean(returns)) if returns else float("nan")

    def end_gradient_step(self) -> None:
        """Count a gradient step, and take the snapshot that is due after it."""
        self._step += 1
        if self._taken % self._every == 0:
            self._snapshot()

    def end_update(self, diagnostics: Mapping[str, float]) -> None:
        """Put the diagnostics of the update that just ended beside the snapshot of its end."""
        if self._pending is None or not self._taken:
            return
        if self._pending["gradient_step"] == self._step:
            self._pending["train"].update(diagnostics)
            self._append_pending()

    def end_training(self, diagnostics: Mapping[str, float]) -> None:
        """Store the last weights, whatever the cadence, and mark the run ``complete``."""
        if self._taken % self._every:
            self._snapshot()
        self.end_update(diagnostics)
        self.close("complete")

    def close(self, status: Status = "crashed") -> None:
        """Commit what is left and release the run. Closing twice does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._append_pending()
        finally:
            self.writer.close(status)

    def discard(self) -> None:
        """Delete the run, if this recorder began it, and release it."""
        if not self._closed:
            self._closed = True
            self.writer.discard()

    @property
    def _taken(self) -> int:
        """Gradient steps since recording began."""
        return self._step - self._start.gradient_step

    def _snapshot(self) -> None:
        """Copy the agent as it is now; it is appended when the next one comes."""
        self._append_pending()
        reading = dict(self._read())
        check_finite("policy/weights", reading["weights"])
        steps, per_epoch = self._step - self._step_before, self._steps_per_epoch
        self._pending = {
            **reading,
            "iteration": self._iteration if self._rollouts else -1,
            "epoch": steps // per_epoch if per_epoch else -1,
            "gradient_step": self._step,
            "phase": (steps - 1) // self._every if self._taken and self._rollouts else -1,
            "learning_rate": reading["learning_rate"] if self._taken else float("nan"),
            "train": {"ep_rew_mean": self._ep_rew_mean},
        }

    def _append_pending(self) -> None:
        if self._pending is not None:
            snapshot, self._pending = self._pending, None
            self.writer.append(**snapshot)
