"""A stored snapshot as a policy that acts as the agent did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.distributions import Categorical, Normal
from torch.nn import functional

from weighttraj.errors import PolicyError
from weighttraj.format import ParamLayout, PolicySpec
from weighttraj.format.fit import find_misfit
from weighttraj.format.schema import ObsNorm
from weighttraj.run import NormStats, Run

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "": torch.nn.Identity(),
    "tanh": torch.tanh,
    "relu": functional.relu,
    "elu": functional.elu,
    "leaky_relu": functional.leaky_relu,
}
LOG_STD_RANGE = (-20.0, 2.0)
"""Within which SAC keeps the logarithm of its deviation."""


class Policy:
    """A multilayer perceptron with a head that turns outputs into actions, and its normaliser.

    The head is that of PPO and A2C (Gaussian or categorical), SAC (squashed Gaussian), TD3
    (squashed) or DQN (greedy). The noise that TD3 and DQN explore with belongs to their training,
    not to the policy, which acts in one way only, sampled or not.

    Actions equal those of the SB3 agent bit by bit, for the same observations, batch size and
    torch seed.

    Args:
        spec: structure of the network.
        layout: order of the parameters in ``weights``.
        weights: float32 (param,).
        obs_norm: what is fixed about the normaliser; None: observations go in as they are.
        stats: its statistics.

    Raises:
        PolicyError: the spec describes no policy that can be rebuilt.
    """

    def __init__(
        self,
        spec: PolicySpec,
        layout: ParamLayout,
        weights: Float32[np.ndarray, " param"],
        obs_norm: ObsNorm | None = None,
        stats: NormStats | None = None,
    ) -> None:
        self.spec = spec
        self.layout = layout
        self.obs_norm, self.stats = obs_norm, stats
        self.weights = np.array(weights, np.float32)
        layers, self._log_std = network(spec, layout, self.weights, obs_norm)
        self._deviation = deviation_layer(spec, layout, self.weights)
        # Matrix products give other last bits where a weight does not lie as torch aligns it.
        self._layers = [(weight.clone(), bias.clone()) for weight, bias in layers]

    def with_weights(self, weights: Float32[np.ndarray, " param"]) -> Policy:
        """Return the same structure and normaliser with other weights, such as a forecast's."""
        return Policy(self.spec, self.layout, weights, self.obs_norm, self.stats)

    def normalize(self, observation: np.ndarray) -> np.ndarray:
        """Return network inputs, float32, for raw observations of any batch shape."""
        if self.stats is None:
            return np.asarray(observation, np.float32)
        return normalize(observation, self.obs_norm, self.stats.mean, self.stats.var)

    @torch.no_grad()
    def distribution(self, inputs: Tensor) -> Normal | Categorical:
        """Return distributions over unclipped actions for network inputs ``(batch, *observation)``.

        Of a squashed Gaussian: before tanh.

        Raises:
            PolicyError: the policy has none, as it acts in one way only.
        """
        outputs, deviation = self._outputs(inputs)
        if not self.spec.is_sampled:
            raise PolicyError(
                "this policy has no distribution over actions",
                expected="a policy of PPO, A2C or SAC",
                got=f"one that acts in one way only ({self.spec.mode})",
                do="compare its actions: policy.predict",
            )
        if deviation is not None:
            return Normal(outputs, torch.ones_like(outputs) * deviation, validate_args=False)
        if self._log_std is None:
            return Categorical(logits=outputs, validate_args=False)
        return Normal(outputs, torch.ones_like(outputs) * self._log_std.exp(), validate_args=False)

    def predict(
        self,
        observation: np.ndarray,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions for raw observations; SB3's signature.

        Args:
            observation: ``(*observation)`` or ``(batch, *observation)``, not normalised.
            state: returned as it is; these policies have no memory.
            episode_start: not used.
            deterministic: the distribution's mode, else a sample by torch's global generator.

        Returns:
            Actions, clipped to the action space, batched as the observations are; and ``state``.

        Raises:
            PolicyError: the observations have another shape.
        """
        observation = np.asarray(observation)
        shape = self.spec.observation_shape
        batched = observation.ndim == len(shape) + 1
        if observation.shape[int(batched) :] != shape:
            raise PolicyError(
                "the observation has the wrong shape",
                expected=f"{shape} or (batch, {', '.join(map(str, shape))})",
                got=observation.shape,
                do="pass observations of the run's environment",
            )
        inputs = self.normalize(observation if batched else observation[None])
        actions = to_actions(self.spec, self.choose(torch.from_numpy(inputs), deterministic))
        return (actions if batched else actions.squeeze(0)), state

    @torch.no_grad()
    def _outputs(self, inputs: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return outputs of the last layer, and the deviation where a layer gives it."""
        hidden = inputs.flatten(1)
        activation = ACTIVATIONS[self.spec.activation]
        for weight, bias in self._layers[:-1]:
            hidden = activation(functional.linear(hidden, weight, bias))
        outputs = functional.linear(hidden, *self._layers[-1])
        if self._deviation is None:
            return outputs, None
        return outputs, functional.linear(hidden, *self._deviation).clamp(*LOG_STD_RANGE).exp()

    @torch.no_grad()
    def choose(self, inputs: Tensor, deterministic: bool) -> Tensor:
        """Actions for network inputs ``(batch, *observation)``: not shaped, nor within bounds.

        Of a squashed policy: before tanh.
        """
        if not self.spec.is_sampled:
            outputs, _ = self._outputs(inputs)
            return outputs.argmax(1) if self.spec.mode == "greedy" else outputs
        distribution = self.distribution(inputs)
        if isinstance(distribution, Categorical):
            return distribution.probs.argmax(1) if deterministic else distribution.sample()  # type: ignore[no-untyped-call]
        return distribution.mean if deterministic else distribution.rsample()

    def __repr__(self) -> str:
        units = [len(bias) for _, bias in self._layers]
        return f"<Policy {self.spec.mode}, {self.spec.activation}, units {units}>"


def check_acts(weights: np.ndarray, rows: Sequence[int] | np.ndarray, where: object) -> None:
    """Raise PolicyError if a snapshot has weights that are not finite: it would act at random.

    Args:
        weights: float32 (snapshot, param).
        rows: number of each snapshot.
        where: the run, for the message.
    """
    for row, values in zip(rows, weights, strict=True):
        if not np.isfinite(values).all():
            raise PolicyError(
                "a snapshot has weights that are NaN or infinite, so its policy does not act",
                expected="finite weights",
                got=f"{int((~np.isfinite(values)).sum())} of {values.size} not finite",
                where=f"{where}, snapshot {row}",
                do="choose another snapshot; weighttraj lint names all that are broken",
            )


def load_policy(run: Run, t: int = -1) -> Policy:
    """Return the policy of snapshot t of a run, with the normaliser that it acted with at t.

    Raises:
        PolicyError: the run's policy cannot be rebuilt, or its weights are not finite; the message
            says why.
        IndexError: there is no such snapshot.
    """
    weights: Any = run.weights[t]
    check_acts(weights[None], [t], run.path)
    return Policy(run.info.policy, run.layout, weights, run.info.obs_norm, run.obs_norm(t))


def network(
    spec: PolicySpec,
    layout: ParamLayout,
    weights: Float32[np.ndarray, "*policy param"],
    obs_norm: ObsNorm | None,
) -> tuple[list[tuple[Tensor, Tensor]], Tensor | None]:
    """(weight, bias) of each layer, and ``log_std`` if the head is Gaussian; views of ``weights``.

    Raises:
        PolicyError: the spec describes no policy that can be rebuilt.
    """
    if spec.mode == "other" or spec.activation not in ACTIVATIONS or not spec.layers:
        raise PolicyError(
            "this policy cannot be rebuilt from its weights",
            expected="a fully connected network on flat observations, with a Gaussian or "
            f"categorical head and one of the activations {sorted(ACTIVATIONS)}",
            got="; ".join(spec.cannot_rebuild) or f"{spec.kind}, activation {spec.activation}",
            do="load snapshots into a model of your own with run.load_into(model, t)",
        )
    if misfit := find_misfit(spec, layout, obs_norm):
        raise PolicyError(
            "the policy that the run describes does not fit its parameters",
            expected="layers that follow each other from the observation to the action",
            got=misfit,
            do="describe the network that was trained (describe_mlp checks it), or restore the "
            "run's zarr.json from a copy",
        )
    tensors = {name: torch.from_numpy(part) for name, part in layout.unflatten(weights).items()}
    layers = [(tensors[weight], tensors[bias]) for weight, bias in spec.layers]
    return layers, tensors["log_std"] if spec.mode == "gaussian" else None


def deviation_layer(
    spec: PolicySpec, layout: ParamLayout, weights: Float32[np.ndarray, "*policy param"]
) -> tuple[Tensor, Tensor] | None:
    """Return (weight, bias) of the layer that gives the deviation; None: there is none."""
    if spec.mode != "squashed_gaussian":
        return None
    tensors = layout.unflatten(weights)
    weight, bias = (torch.from_numpy(tensors[name].copy()) for name in spec.log_std)
    return weight, bias


def normalize(
    observation: np.ndarray, norm: ObsNorm | None, mean: np.ndarray, var: np.ndarray
) -> np.ndarray:
    """Return network inputs, float32; mean and var are broadcast to the observations."""
    if norm is None:
        return np.asarray(observation, np.float32)
    mean, var = mean.astype(norm.dtype), var.astype(norm.dtype)
    inputs = (observation - mean) / np.sqrt(var + norm.epsilon)
    if norm.cast_before_clip:
        inputs = np.float32(inputs)
    if norm.clip_low is not None or norm.clip_high is not None:
        inputs = np.clip(inputs, norm.clip_low, norm.clip_high)
    return np.asarray(inputs, np.float32)


def to_actions(spec: PolicySpec, values: Tensor) -> np.ndarray:
    """Actions for the environment (..., *action): shaped, and clipped or stretched to its bounds.

    Args:
        spec: of the policy.
        values: (..., action) of continuous actions, before tanh; or (...) of choices.
    """
    if not spec.is_continuous:
        return values.numpy()
    if spec.mode != "gaussian":
        values = values.tanh()
    low, high = (_bound(x, spec.action_shape) for x in (spec.action_low, spec.action_high))
    actions = values.numpy().reshape(*values.shape[:-1], *low.shape)
    if spec.mode != "gaussian":
        return np.asarray(low + (0.5 * (actions + 1.0) * (high - low)))
    return np.asarray(np.clip(actions, low, high))


def _bound(values: tuple[float, ...], shape: tuple[int, ...]) -> np.ndarray:
    """Return bounds of an action in float32, or in float64 where float32 would change them."""
    exact = np.array(values, np.float64).reshape(shape)
    short = exact.astype(np.float32)
    return short if np.array_equal(short, exact) else exact
