"""Many snapshots of one structure as policies that act together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor
from torch.distributions import Categorical, Normal

from weighttraj.errors import PolicyError
from weighttraj.format import ParamLayout, PolicySpec
from weighttraj.format.schema import ObsNorm
from weighttraj.policies.policy import (
    ACTIVATIONS,
    LOG_STD_RANGE,
    check_acts,
    deviation_layer,
    network,
    normalize,
    to_actions,
)
from weighttraj.run import Run


class PolicyBatch:
    """A stack of policies: one batched matrix product a layer acts for all of them.

    Actions equal each policy's alone up to float32 rounding (the order of additions differs).

    Args:
        spec: structure of the networks.
        layout: order of the parameters in ``weights``.
        weights: float32 (policy, param).
        obs_norm: what is fixed about the normalisers; None: observations go in as they are.
        mean: of the normalisers, ``(policy, *obs)``.
        var: of the normalisers, ``(policy, *obs)``.

    Raises:
        PolicyError: the spec describes no policy that can be rebuilt.
    """

    def __init__(
        self,
        spec: PolicySpec,
        layout: ParamLayout,
        weights: Float32[np.ndarray, "policy param"],
        obs_norm: ObsNorm | None = None,
        mean: Float64[np.ndarray, "policy *obs"] | None = None,
        var: Float64[np.ndarray, "policy *obs"] | None = None,
    ) -> None:
        self.spec, self.layout, self.obs_norm = spec, layout, obs_norm
        self.weights = np.ascontiguousarray(weights, np.float32)
        self.mean, self.var = mean, var
        layers, log_std = network(spec, layout, self.weights, obs_norm)
        self._layers = [(weight.transpose(1, 2), bias[:, None]) for weight, bias in layers]
        self._std = None if log_std is None else log_std.exp()[:, None]
        deviation = deviation_layer(spec, layout, self.weights)
        self._deviation = deviation and (deviation[0].transpose(1, 2), deviation[1][:, None])

    def __len__(self) -> int:
        return len(self.weights)

    def __getitem__(self, chosen: slice | np.ndarray | Sequence[int]) -> PolicyBatch:
        """Return some of the policies."""
        mean, var = (None if x is None else x[chosen] for x in (self.mean, self.var))
        return PolicyBatch(self.spec, self.layout, self.weights[chosen], self.obs_norm, mean, var)

    def with_weights(self, weights: Float32[np.ndarray, "policy param"]) -> PolicyBatch:
        """Return the same structure and normalisers with other weights, such as forecasts."""
        return PolicyBatch(self.spec, self.layout, weights, self.obs_norm, self.mean, self.var)

    def normalize(self, observations: np.ndarray) -> np.ndarray:
        """Return network inputs, float32, for raw observations ``(policy, episode, *obs)``."""
        if self.mean is None or self.var is None:
            return np.asarray(observations, np.float32)
        return normalize(observations, self.obs_norm, self.mean[:, None], self.var[:, None])

    @torch.no_grad()
    def outputs(self, inputs: Float32[np.ndarray, "policy episode *obs"]) -> Tensor:
        """Return means, logits or values (policy, episode, output) for network inputs."""
        return self._outputs(inputs)[0]

    def _outputs(
        self, inputs: Float32[np.ndarray, "policy episode *obs"]
    ) -> tuple[Tensor, Tensor | None]:
        """Return outputs of the last layer, and the deviation of each where the head has one."""
        hidden = torch.from_numpy(inputs).flatten(2)
        activation = ACTIVATIONS[self.spec.activation]
        for weight, bias in self._layers[:-1]:
            hidden = activation(torch.baddbmm(bias, hidden, weight))
        weight, bias = self._layers[-1]
        outputs = torch.baddbmm(bias, hidden, weight)
        if self._deviation is None:
            return outputs, self._std
        weight, bias = self._deviation
        return outputs, torch.baddbmm(bias, hidden, weight).clamp(*LOG_STD_RANGE).exp()

    def distribution(
        self, inputs: Float32[np.ndarray, "policy episode *obs"]
    ) -> Normal | Categorical:
        """Return distributions over unclipped actions for network inputs, (policy, episode, ...).

        Raises:
            PolicyError: the policies have none, as they act in one way only.
        """
        if not self.spec.is_sampled:
            raise PolicyError(
                "these policies have no distribution over actions",
                expected="policies of PPO, A2C or SAC",
                got=f"such that act in one way only ({self.spec.mode})",
                do="compare their actions: policies.act",
            )
        outputs, std = self._outputs(inputs)
        if std is None:
            return Categorical(logits=outputs, validate_args=False)
        return Normal(outputs, std.expand_as(outputs), validate_args=False)

    @torch.no_grad()
    def act(self, observations: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """Return actions ``(policy, episode, *action)``, clipped to the action space.

        Args:
            observations: raw, ``(policy, episode, *obs)``.
            noise: None: act by the distribution's mode. For a Gaussian head: standard normal,
                float32 (episode, action). For a categorical one: uniform in [0, 1), (episode,).
                Policies that act in one way only take no notice of it.
        """
        outputs, std = self._outputs(self.normalize(observations))
        if self.spec.is_continuous:
            if noise is not None and std is not None:
                outputs = outputs + std * torch.from_numpy(noise)
            return to_actions(self.spec, outputs)
        if noise is None or not self.spec.is_sampled:
            return to_actions(self.spec, outputs.argmax(2))
        cumulative = outputs.double().softmax(2).cumsum(2)
        choice = (torch.from_numpy(noise)[:, None] > cumulative).sum(2)
        return to_actions(self.spec, choice.clamp(max=cumulative.shape[2] - 1))

    def __repr__(self) -> str:
        units = [bias.shape[2] for _, bias in self._layers]
        return f"<PolicyBatch of {len(self)}: {self.spec.mode}, units {units}>"


def load_policies(
    run: Run, rows: slice | Sequence[int] | np.ndarray, *, final_normalizer: bool = False
) -> PolicyBatch:
    """Return snapshots of a run as policies, each with the normaliser that it acted with.

    Args:
        run: the run.
        rows: the snapshots.
        final_normalizer: give each the run's last normaliser instead. It knows the future: this is
            for measuring what that changes.

    Raises:
        PolicyError: the run's policy cannot be rebuilt, or its weights are not finite; the message
            says why.
        IndexError: there is no such snapshot.
    """
    chosen: Any = rows if isinstance(rows, slice) else np.asarray(rows)
    weights = run.weights[chosen]
    check_acts(weights, np.arange(len(run))[chosen], run.path)
    mean = var = None
    if run.info.obs_norm is not None:
        source = np.full(len(weights), len(run) - 1) if final_normalizer else chosen
        mean, var = run["obs_norm/mean"][source], run["obs_norm/var"][source]
    return PolicyBatch(run.info.policy, run.layout, weights, run.info.obs_norm, mean, var)
