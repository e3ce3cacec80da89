"""The PPO update of several independent learners in lockstep: Stable-Baselines3's, stacked.

Step by step what ``stable_baselines3.PPO.train`` does (2.x), with one row a learner: advantages
standardised in each minibatch, clipped surrogate, clipped value loss, entropy bonus, one gradient
clip over all parameters of a learner, Adam. Equal up to the rounding of float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from stable_baselines3.common.utils import explained_variance
from torch import Tensor

from weighttraj.collect.networks import MLP, Stack
from weighttraj.collect.ppo import PPOConfig

_HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """What some learners have seen and done, float32; the first two axes are (learner, step)."""

    observations: Tensor
    """Network inputs, (learner, step, obs)."""
    actions: Tensor
    """Sampled actions before clipping, (learner, step, action)."""
    log_probs: Tensor
    """Their log-probabilities, (learner, step)."""
    values: Tensor
    """The critic's estimates, (learner, step)."""
    advantages: Tensor
    """Generalised advantage estimates, (learner, step)."""
    returns: Tensor
    """Advantages plus values, (learner, step)."""

    def __getitem__(self, learners: slice) -> Rollout:
        """Return the part of some of the learners."""
        return Rollout(**{name: tensor[learners] for name, tensor in vars(self).items()})


class Learners:
    """Several agents that learn side by side.

    Args:
        config: settings of the training.
        stack: their parameters, named as SB3's ``ActorCriticPolicy`` names them.
        actor: prefixes of the actor's layers.
        critic: prefixes of the critic's layers.
    """

    def __init__(
        self, config: PPOConfig, stack: Stack, actor: Sequence[str], critic: Sequence[str]
    ) -> None:
        self._config = config
        self._stack = stack
        self._actor = MLP(stack, actor, config.batch_size, config.activation)
        self._critic = MLP(stack, critic, config.batch_size, config.activation)
        self._log_std = stack.value("log_std")
        self._log_std_gradient = stack.gradient("log_std")
        self._rows = [torch.nn.Parameter(row) for row in stack.values]
        for row, gradient in zip(self._rows, stack.gradients, strict=True):
            row.grad = gradient
        self.optimizer = torch.optim.Adam(
            self._rows, config.learning_rate, eps=config.adam_eps, fused=True
        )

    def adam(self, learner: int) -> dict[str, Tensor]:
        """Return Adam's state of a learner, not a copy: ``step``, ``exp_avg`` and ``exp_avg_sq``.

        The moments have a row's columns; all is 0 before the first gradient step.
        """
        row = self._rows[learner]
        state: dict[str, Tensor] = self.optimizer.state[row]
        if not state:  # as Adam begins
            names = ("exp_avg", "exp_avg_sq")
            state |= {"step": torch.zeros(()), **{name: torch.zeros_like(row) for name in names}}
        return state

    def estimate(self, observations: Tensor) -> Tensor:
        """Return the critic's values (learner, step) for network inputs (learner, step, obs)."""
        parts = observations.chunk(observations.shape[1] // self._config.batch_size, dim=1)
        return torch.cat([self._critic.forward(part)[..., 0].clone() for part in parts], dim=1)

    @torch.no_grad()
    def update(
        self,
        rollout: Rollout,
        permutations: np.ndarray,
        learning_rate: float,
        after_step: Callable[[], None],
    ) -> list[dict[str, float]]:
        """Learn from a rollout.

        Args:
            rollout: of these learners.
            permutations: order of the samples, (epoch, learner, step).
            learning_rate: of all gradient steps.
            after_step: called after each gradient step.

        Returns:
            Each learner's diagnostics, named as SB3 logs them.
        """
        self.optimizer.param_groups[0]["lr"] = learning_rate
        history = []
        for order in permutations:
            epoch = _Epoch.of(rollout, order, self._config)
            for i in range(len(epoch.advantages)):
                self._set_gradients(epoch, i)
                self._clip_gradients()
                self.optimizer.step()
                after_step()
            history.append(_losses(epoch, self._config))
        return [_diagnostics(history, rollout, learner) for learner in range(len(self._stack))]

    def _set_gradients(self, epoch: _Epoch, i: int) -> None:
        """Write the gradients of minibatch i into the stack."""
        config, observations = self._config, epoch.observations[i]
        means = self._actor.forward(observations)
        values = self._critic.forward(observations)[..., 0]
        std = self._log_std.exp()[:, None]
        z = (epoch.actions[i] - means) / std
        square = z * z
        entropy = (self._log_std + _HALF_LOG_2PI).sum(1, keepdim=True)  # less 1/2 a dimension
        log_probs = -0.5 * square.sum(2) - entropy
        epoch.now_log_probs[i], epoch.now_values[i] = log_probs, values
        epoch.now_entropy[i] = entropy[:, 0] + 0.5 * self._log_std.shape[1]

        surrogate, clipped = _surrogates(
            log_probs - epoch.log_probs[i], epoch.advantages[i], config.clip_range
        )
        # The smaller one counts; where that is the clipped one, nothing depends on the policy.
        by_log_prob = torch.where(surrogate > clipped, 0.0, surrogate) * (-1 / config.batch_size)
        by_log_prob = by_log_prob[..., None]
        torch.sum(by_log_prob * (square - 1), 1, out=self._log_std_gradient)
        self._log_std_gradient -= config.ent_coef
        self._actor.backward(observations, by_log_prob * z / std)

        change, allowed = _value_change(values, epoch.values[i], config.clip_range_vf)
        error = epoch.values[i] + allowed - epoch.returns[i]
        by_value = error * (2 * config.vf_coef / config.batch_size) * (change == allowed)
        self._critic.backward(observations, by_value[..., None])

    def _clip_gradients(self) -> None:
        """Scale each learner's gradient to the allowed norm, as ``clip_grad_norm_`` does."""
        norm = torch.linalg.vector_norm(self._stack.gradients, dim=1, keepdim=True)
        self._stack.gradients *= (self._config.max_grad_norm / (norm + 1e-6)).clamp(max=1)


@dataclass(frozen=True, kw_only=True)
class _Epoch(Rollout):
    """A rollout in the order of one epoch: the first axes are (minibatch, learner, sample).

    Advantages are standardised in each minibatch, if the settings say so.
    """

    now_log_probs: Tensor
    """Filled in as the epoch goes on: by the policy before the minibatch's gradient step."""
    now_values: Tensor
    """So are these."""
    now_entropy: Tensor
    """(minibatch, learner); so is this."""

    @classmethod
    def of(cls, rollout: Rollout, order: np.ndarray, config: PPOConfig) -> _Epoch:
        learners, steps = order.shape
        rows = order + steps * np.arange(learners)[:, None]
        rows = rows.reshape(learners, -1, config.batch_size).swapaxes(0, 1)
        index = torch.from_numpy(np.ascontiguousarray(rows))
        fields = {name: tensor.flatten(0, 1)[index] for name, tensor in vars(rollout).items()}
        if config.normalize_advantage:
            raw = fields["advantages"]
            centred = raw - raw.mean(2, keepdim=True)
            fields["advantages"] = centred / (raw.std(2, keepdim=True) + 1e-8)
        shape = index.shape
        return cls(
            **fields,
            now_log_probs=torch.empty(shape),
            now_values=torch.empty(shape),
            now_entropy=torch.empty(shape[:2]),
        )


def _surrogates(log_ratio: Tensor, advantages: Tensor, clip: float) -> tuple[Tensor, Tensor]:
    """PPO's surrogate, and the clipped one."""
    ratio = log_ratio.exp()
    return advantages * ratio, advantages * ratio.clamp(1 - clip, 1 + clip)


def _value_change(values: Tensor, old: Tensor, clip: float | None) -> tuple[Tensor, Tensor]:
    """Return how far values have moved from the old ones, and how far the loss lets them."""
    change = values - old
    return change, change if clip is None else change.clamp(-clip, clip)


def _losses(epoch: _Epoch, config: PPOConfig) -> dict[str, np.ndarray]:
    """Return what SB3 logs of each minibatch, float64 (learner, minibatch)."""
    log_ratio = epoch.now_log_probs - epoch.log_probs
    ratio = log_ratio.exp()
    surrogates = _surrogates(log_ratio, epoch.advantages, config.clip_range)
    _, allowed = _value_change(epoch.now_values, epoch.values, config.clip_range_vf)
    error = epoch.values + allowed - epoch.returns
    means = {
        "approx_kl": ((ratio - 1) - log_ratio).mean(2),
        "clip_fraction": ((ratio - 1).abs() > config.clip_range).float().mean(2),
        "entropy_loss": -epoch.now_entropy,
        "policy_gradient_loss": -torch.minimum(*surrogates).mean(2),
        "value_loss": (error * error).mean(2),
    }
    return {name: mean.T.double().contiguous().numpy() for name, mean in means.items()}


def _diagnostics(
    history: list[dict[str, np.ndarray]], rollout: Rollout, learner: int
) -> dict[str, float]:
    """Return one learner's figures of an update, as SB3 sums them up."""
    figures = {
        name: float(np.concatenate([epoch[name][learner] for epoch in history]).mean())
        for name in history[0]
    }
    figures["approx_kl"] = float(history[-1]["approx_kl"][learner].mean())  # of the last epoch
    values, returns = rollout.values[learner].numpy(), rollout.returns[learner].numpy()
    figures["explained_variance"] = explained_variance(values, returns)
    return figures
