"""Finds the network of a Stable-Baselines3 model that acts, and the optimizer that steps it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from weighttraj.errors import CollectError

Unit = Literal["gradient_step", "update"]
"""What counts as a step: one of the optimizer, or all that happens between two rollouts."""

_ACTING = ("actor", "q_net", "quantile_net")
"""Attributes of an off-policy algorithm's policy that hold the network that acts."""
_CRITIC = (
    "value_net.",
    "mlp_extractor.value_net.",
    "vf_features_extractor.",
    "lstm_critic.",  # of sb3_contrib's recurrent policies
    "critic.",
)
_NOT_BY_OPTIMIZER = {
    "TRPO": "a line search moves the policy; the optimizer steps the critic only",
    "ARS": "random search moves the policy; there is no optimizer",
}
"""Algorithms whose policy is moved by no optimizer, and how it is moved. Others are found out
when they train: see ``watch``."""
SUPPORTED = (
    "algorithms whose optimizer steps the policy: PPO, A2C, SAC, TD3, DDPG, DQN, and MaskablePPO, "
    "RecurrentPPO, TQC, CrossQ, QR-DQN of sb3_contrib; with unit='update' any algorithm"
)
_BY_UPDATES = (
    "record a snapshot of each update with unit='update', or write snapshots yourself with "
    "weighttraj.RunWriter"
)


@dataclass(frozen=True, kw_only=True)
class Agent:
    """What is recorded of a model."""

    model: BaseAlgorithm
    """The model."""
    network: BasePolicy
    """The network that acts: the whole policy, or its actor or Q-network."""
    prefix: str
    """Of the network's parameters, among those of the policy: ``actor.`` or nothing."""
    actor: dict[str, nn.Parameter]
    """Parameters that it acts with, by their name in the policy, in the order of the vector."""
    critic: dict[str, nn.Parameter]
    """Parameters that only the critic uses; empty: there is none."""
    optimizer: torch.optim.Optimizer | None
    """The optimizer whose steps are counted; None: updates are counted."""
    unit: Unit
    """What is counted."""

    @property
    def has_rollouts(self) -> bool:
        """Whether training alternates between rollouts and updates."""
        return not isinstance(self.model, OffPolicyAlgorithm)

    @property
    def on_policy(self) -> OnPolicyAlgorithm | None:
        """The model, if it keeps rollouts in a buffer."""
        return self.model if isinstance(self.model, OnPolicyAlgorithm) else None

    @property
    def learning_rate(self) -> float:
        """The counted optimizer's learning rate; NaN: updates are counted."""
        return float("nan") if self.optimizer is None else self.optimizer.param_groups[0]["lr"]

    def has_other_parameters(self) -> bool:
        """Say whether the network was given other parameter objects than those recorded."""
        now = actor_parameters(self.network, self.prefix)
        return now.keys() != self.actor.keys() or any(
            now[n] is not p for n, p in self.actor.items()
        )


def find_agent(model: BaseAlgorithm, unit: Unit = "gradient_step") -> Agent:
    """Return what is recorded of a model.

    Raises:
        CollectError: no single optimizer steps the network that acts.
    """
    policy = model.policy
    name = next((n for n in _ACTING if isinstance(getattr(policy, n, None), BasePolicy)), "")
    prefix = f"{name}." if name else ""
    network = getattr(policy, name) if name else policy
    actor = actor_parameters(network, prefix)
    optimizer = None
    if unit == "gradient_step":
        _refuse_known(model)
        optimizer = _optimizer_of(model, actor)
    return Agent(
        model=model,
        network=network,
        prefix=prefix,
        actor=actor,
        critic=critic_parameters(policy),
        optimizer=optimizer,
        unit=unit,
    )


def actor_parameters(network: nn.Module, prefix: str = "") -> dict[str, nn.Parameter]:
    """Return the parameters that a network acts with, in the order of the flat vector.

    Args:
        network: an on-policy algorithm's policy, or the acting network of an off-policy one.
        prefix: put before each name.
    """
    named = {f"{prefix}{name}": p for name, p in network.named_parameters()}
    return {name: p for name, p in named.items() if not name.startswith(_CRITIC)}


def critic_parameters(policy: nn.Module) -> dict[str, nn.Parameter]:
    """Return the parameters that only the critic uses; targets are none of them."""
    return {name: p for name, p in policy.named_parameters() if name.startswith(_CRITIC)}


def _refuse_known(model: BaseAlgorithm) -> None:
    kinds = [kind.__name__ for kind in type(model).__mro__ if kind.__name__ in _NOT_BY_OPTIMIZER]
    if kinds:
        raise CollectError(
            f"the steps of {type(model).__name__}'s policy are no steps of an optimizer",
            expected=SUPPORTED,
            got=f"{kinds[0]}: {_NOT_BY_OPTIMIZER[kinds[0]]}",
            where=type(model).__name__,
            do=_BY_UPDATES,
        )


def _optimizer_of(model: BaseAlgorithm, actor: dict[str, nn.Parameter]) -> torch.optim.Optimizer:
    """Return the one optimizer that holds all acting parameters that are trained."""
    optimizers = dict(_optimizers(model))
    trained = {id(p): name for name, p in actor.items() if p.requires_grad}
    held = {
        name: {id(p) for group in optimizer.param_groups for p in group["params"]} & trained.keys()
        for name, optimizer in optimizers.items()
    }
    holders = [name for name, ids in held.items() if ids]
    if len(holders) == 1 and held[holders[0]] == trained.keys():
        return optimizers[holders[0]]
    missing = [n for i, n in trained.items() if not any(i in ids for ids in held.values())]
    raise CollectError(
        f"no single optimizer steps the policy of {type(model).__name__}",
        expected=SUPPORTED,
        got=f"{len(holders)} optimizers of the acting network's parameters: "
        f"{', '.join(holders) or 'none'}"
        + (f"; {len(missing)} parameters are in none, such as {missing[0]}" if missing else ""),
        where=type(model).__name__,
        do=_BY_UPDATES,
    )


def _optimizers(model: BaseAlgorithm) -> Iterator[tuple[str, torch.optim.Optimizer]]:
    """Yield the optimizers of a model and of its policy's modules, each once, with its name."""
    seen: set[int] = set()
    owners: list[tuple[str, Any]] = [(f"policy.{n}", m) for n, m in model.policy.named_modules()]
    for prefix, owner in (*owners, ("", model)):
        for name, value in vars(owner).items():
            values = value if isinstance(value, list | tuple) else [value]
            for i, optimizer in enumerate(values):
                if isinstance(optimizer, torch.optim.Optimizer) and id(optimizer) not in seen:
                    seen.add(id(optimizer))
                    index = f"[{i}]" if values is value else ""
                    yield f"{prefix}.{name}{index}".replace("..", ".").lstrip("."), optimizer
