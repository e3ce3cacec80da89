"""Proves that a policy can be rebuilt: compares the rebuilt policy with the agent, bit by bit.

A copy of the agent's policy acts, never the agent itself. Equal actions with the present weights
prove little, as a branch that starts with zero weights does nothing yet, so the copy is also given
random weights. Equal actions for some observations prove little, as code may treat rare ones in
another way, so the operations from observations to actions are compared, too: see ``operations``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from torch import Tensor, nn
from torch.distributions import Categorical, Normal

from weighttraj.collect.operations import difference, operations
from weighttraj.collect.undisturbed import undisturbed
from weighttraj.errors import WeightTrajError
from weighttraj.format import ParamLayout, PolicySpec
from weighttraj.policies.policy import Policy

PolicyT = TypeVar("PolicyT", bound=BasePolicy)

_OBSERVATIONS = 32
_ON_ARRAYS = ("predict", "obs_to_tensor", "unscale_action")
"""Methods of a policy that handle arrays: what they do to these cannot be listed."""
_THEIR_OWN = ("stable_baselines3", "sb3_contrib")
"""Packages whose methods are compared by their actions alone."""
_SCALES = (None, 0.1, 1.0)
"""Deviations of the random weights of each comparison; None: the present weights."""


def find_difference(policy: BasePolicy, spec: PolicySpec, layout: ParamLayout) -> list[str]:
    """Return why a policy acts otherwise than its description says; an empty list if it does not.

    Neither the policy nor the global random generators change.

    Args:
        policy: of the agent.
        spec: its description.
        layout: order of the parameters that it acts with.
    """
    with undisturbed():
        try:
            twin = _copy(policy)
        except Exception as error:  # the code of a stranger may raise anything
            return [f"it cannot be copied, and so not be compared with the agent: {_line(error)}"]
        try:
            return _differences(twin, spec, layout) or own_methods(policy, _ON_ARRAYS)
        except Exception as error:
            return [f"it cannot be compared with the agent: {_line(error)}"]


def own_methods(owner: object, names: Sequence[str]) -> list[str]:
    """Return a reason for each method that is neither Stable-Baselines3's nor its contributors'.

    Args:
        owner: a policy or a model.
        names: of its methods.
    """
    reasons = []
    for name in names:
        method = getattr(owner, name, None)
        function = getattr(method, "__func__", method)
        module = str(getattr(function, "__module__", "")).partition(".")[0]
        if method is not None and module not in _THEIR_OWN:
            called = getattr(function, "__qualname__", type(function).__name__)
            reasons.append(f"a `{name}` of its own, {called}, which may act otherwise")
    return reasons


def find_difference_of_network(
    network: nn.Sequential, spec: PolicySpec, layout: ParamLayout
) -> str:
    """Return why a network computes something else than its description says; empty: it does not.

    Args:
        network: gives means or logits for observations (batch, number).
        spec: its description.
        layout: order of its parameters, with ``log_std`` if actions are continuous.
    """
    with undisturbed(), torch.no_grad():
        try:
            twin = copy.deepcopy(network).requires_grad_(False).to("cpu")
            shape = spec.observation_shape
            inputs = torch.from_numpy(_wide(np.random.default_rng(0), shape).astype(np.float32))
            for scale in _SCALES:
                _randomise(twin, scale)
                named = {"log_std": torch.zeros(spec.action_shape), **dict(twin.named_parameters())}
                got = _rebuild(spec, layout, named).distribution(inputs)
                outputs = twin(inputs.flatten(1))
                expected = (
                    outputs if isinstance(got, Normal) else Categorical(logits=outputs).logits
                )
                actual = got.mean if isinstance(got, Normal) else got.logits
                if not _same(actual.numpy(), expected.numpy()):
                    distance = _distance(actual.numpy(), expected.numpy())
                    return f"its outputs differ from those of its layers by up to {distance}"
        except Exception as error:  # the code of a stranger may raise anything
            return f"it cannot be compared with its description: {_line(error)}"
    return ""


def acts_with(policy: BasePolicy, names: Sequence[str]) -> bool:
    """Return whether the actions of a policy depend on some of its parameters, or may.

    Args:
        policy: any of Stable-Baselines3's. It is not changed.
        names: of its parameters.
    """
    with undisturbed(), torch.no_grad():
        try:
            twin = _copy(policy)
            space = copy.deepcopy(policy.observation_space)
            space.seed(0)
            observations = [space.sample() for _ in range(4)]
            named = dict(twin.named_parameters())
            generator = torch.Generator().manual_seed(1)
            for scale in (None, 0.1):  # other weights: a branch that starts at zero hides the rest
                _randomise(twin, scale)
                before = _predictions(twin, observations)
                for name in names:
                    named[name].normal_(generator=generator)
                after = _predictions(twin, observations)
                if any(not _same(x, y) for x, y in zip(after, before, strict=True)):
                    return True
        except Exception:  # the code of a stranger may raise anything
            return True
    return False


def _predictions(policy: BasePolicy, observations: Sequence[Any]) -> list[np.ndarray]:
    """Return deterministic and sampled actions."""
    torch.manual_seed(0)
    return [
        np.asarray(policy.predict(observation, deterministic=deterministic)[0])
        for observation in observations
        for deterministic in (True, False)
    ]


def _randomise(module: nn.Module, scale: float | None) -> None:
    """Draw the parameters from a normal distribution; None: leave them as they are."""
    if scale is not None:
        generator = torch.Generator().manual_seed(0)
        for parameter in module.parameters():
            parameter.normal_(std=scale, generator=generator)


def _rebuild(spec: PolicySpec, layout: ParamLayout, named: Mapping[str, Tensor]) -> Policy:
    """Return the policy as it is rebuilt from what a run stores."""
    return Policy(spec, layout, layout.flatten({p.name: named[p.name] for p in layout.params}))


def _copy(policy: PolicyT) -> PolicyT:
    """Return a copy on the CPU, without optimizers, whose hooks may lead to the whole training."""
    memo: dict[int, Any] = {}
    for module in policy.modules():
        for value in vars(module).values():
            if isinstance(value, torch.optim.Optimizer):
                memo[id(value)] = None
    memo |= {id(x): x.detach().clone() for x in _computed(policy, 4)}
    twin = copy.deepcopy(policy, memo)
    twin.requires_grad_(False)
    return twin.to("cpu")


def _computed(value: object, depth: int) -> Iterator[Tensor]:
    """Tensors with a history, such as the noise of an exploration, which torch does not copy."""
    if isinstance(value, Tensor):
        if not value.is_leaf:
            yield value
    elif depth and not isinstance(value, type | torch.optim.Optimizer):
        parts = value if isinstance(value, dict) else getattr(value, "__dict__", {})
        for part in parts.values():
            yield from _computed(part, depth - 1)


@torch.no_grad()
def _differences(twin: BasePolicy, spec: PolicySpec, layout: ParamLayout) -> list[str]:
    generator = torch.Generator().manual_seed(0)
    observations = _observations(twin.observation_space)
    for scale in _SCALES:
        if scale is not None:
            for parameter in twin.parameters():
                parameter.normal_(std=scale, generator=generator)
        rebuilt = _rebuild(spec, layout, dict(twin.named_parameters()))
        for training in (False, True):
            twin.set_training_mode(training)
            for what, got, expected in _pairs(twin, rebuilt, observations):
                if not _same(got, expected):
                    weights = "present" if scale is None else "random"
                    mode = "training" if training else "evaluation"
                    return [
                        f"the rebuilt policy acts otherwise than the agent: {what} differ by up "
                        f"to {_distance(got, expected)}, with {weights} weights, in {mode} mode"
                    ]
    return _other_operations(twin, rebuilt, torch.from_numpy(observations))


def _other_operations(twin: BasePolicy, rebuilt: Policy, observations: Tensor) -> list[str]:
    """Return what the agent computes that the rebuilt policy does not, or the other way round."""
    for training in (False, True):
        twin.set_training_mode(training)
        for what, agents, ours in _computations(twin, rebuilt):
            torch.manual_seed(0)
            got = operations(agents, observations.clone())
            expected = operations(ours, observations.clone())
            if words := difference(got, expected):
                return [
                    "its code may act otherwise for other observations than those that were "
                    f"tried: {what} take {words} than the layers do"
                ]
    return []


_Compute = Callable[[Tensor], Any]


def _computations(twin: Any, rebuilt: Policy) -> Iterator[tuple[str, _Compute, _Compute]]:
    """Yield what is listed: its name, how the agent computes it, how the rebuilt policy does."""

    def act(deterministic: bool) -> _Compute:
        def compute(observations: Tensor) -> Tensor:
            actions = rebuilt.choose(observations.float(), deterministic)
            return actions.tanh() if rebuilt.spec.mode.startswith("squashed") else actions

        return compute

    for deterministic in (True, False):
        kind = "deterministic" if deterministic else "sampled"
        yield f"{kind} actions of predict", _predict(twin, deterministic), act(deterministic)
        if isinstance(twin, ActorCriticPolicy):
            yield (
                f"{kind} actions of the rollout",
                _forward(twin, deterministic),
                act(deterministic),
            )


def _predict(twin: Any, deterministic: bool) -> _Compute:
    return lambda x: twin._predict(x, deterministic=deterministic)


def _forward(twin: Any, deterministic: bool) -> _Compute:
    return lambda x: twin(x, deterministic)[0]


def _pairs(
    twin: BasePolicy, rebuilt: Policy, observations: np.ndarray
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield what is compared: its name, what the rebuilt policy gives, what the agent gives."""
    if isinstance(twin, ActorCriticPolicy):
        yield from _rolled(twin, rebuilt, observations)
    yield from _predicted(twin, rebuilt, observations)


def _predicted(
    twin: BasePolicy, rebuilt: Policy, observations: np.ndarray
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield the actions of ``predict``, for many observations and for one."""
    for deterministic in (True, False):
        for batch in (observations, observations[0]):
            # Our own generators would not do: SB3 samples with the global one.
            torch.manual_seed(0)
            actions, _ = rebuilt.predict(batch, deterministic=deterministic)
            training = twin.training
            torch.manual_seed(0)
            predicted, _ = twin.predict(batch, deterministic=deterministic)
            twin.set_training_mode(training)
            kind = "deterministic" if deterministic else "sampled"
            yield f"{kind} actions of predict", actions, np.asarray(predicted)


def _rolled(
    twin: ActorCriticPolicy, rebuilt: Policy, observations: np.ndarray
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield the distribution over actions, and the actions of a rollout."""
    tensor = torch.from_numpy(observations)
    got = rebuilt.distribution(torch.from_numpy(rebuilt.normalize(observations)))
    expected = twin.get_distribution(tensor).distribution
    for name in ("logits",) if isinstance(got, Categorical) else ("mean", "stddev"):
        yield f"{name} of the action distribution", _numpy(got, name), _numpy(expected, name)
    space = twin.action_space
    for deterministic in (True, False):
        kind = "deterministic" if deterministic else "sampled"
        torch.manual_seed(0)
        actions, _ = rebuilt.predict(observations, deterministic=deterministic)
        torch.manual_seed(0)
        rolled = twin(tensor, deterministic)[0].numpy()
        if isinstance(space, spaces.Box):  # as SB3 does before it steps the environment
            rolled = np.clip(rolled, space.low, space.high)
        yield f"{kind} actions of the rollout", actions, rolled


def _observations(space: spaces.Space[np.ndarray]) -> np.ndarray:
    """Return observations that the policy may meet, of all sizes, (observation, *obs)."""
    rng = np.random.default_rng(0)
    if not isinstance(space, spaces.Box):
        raise TypeError(f"observations in a {type(space).__name__} space")
    wide = _wide(rng, space.shape)
    if np.issubdtype(space.dtype, np.floating):
        return wide.astype(space.dtype)
    low, high = (
        bound.astype(np.float64).clip(-(2.0**31), 2.0**31) for bound in (space.low, space.high)
    )
    return rng.uniform(low, high, wide.shape).astype(space.dtype)


def _wide(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return normal numbers of all sizes, (observation, *obs)."""
    sizes = np.logspace(-3, 3, _OBSERVATIONS).reshape(-1, *(1 for _ in shape))
    return rng.standard_normal((_OBSERVATIONS, *shape)) * sizes


def _numpy(distribution: object, name: str) -> np.ndarray:
    """Return a parameter of a distribution, or nothing if it has none or is of another kind."""
    if type(distribution) not in (Normal, Categorical):
        raise TypeError(f"its actions have the distribution {type(distribution).__name__}")
    value: Tensor = getattr(distribution, name)
    return value.numpy()


def _same(got: np.ndarray, expected: np.ndarray) -> bool:
    """Equal bit by bit; actions of another type count as equal if their values are."""
    return got.shape == expected.shape and np.array_equal(got, expected, equal_nan=True)


def _distance(got: np.ndarray, expected: np.ndarray) -> str:
    if got.shape != expected.shape:
        return f"their shapes {got.shape} and {expected.shape}"
    return f"{np.nanmax(np.abs(got.astype(np.float64) - expected.astype(np.float64))):.2g}"


def _line(error: Exception) -> str:
    """Return the first line of an error."""
    text = error.message if isinstance(error, WeightTrajError) else str(error)
    return f"{type(error).__name__}: {(text.splitlines() or [''])[0]}"[:200]
