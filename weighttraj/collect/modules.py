"""What a network of any PyTorch training is, as the metadata of a run says it."""

from __future__ import annotations

import torch
from gymnasium import spaces
from torch import nn

from weighttraj.collect.describe import ACTIVATIONS, describe_head, describe_layout
from weighttraj.collect.proof import find_difference_of_network
from weighttraj.errors import CollectError
from weighttraj.format import ParamLayout, PolicySpec
from weighttraj.format.fit import find_misfit


def describe_mlp(
    actor: nn.Sequential,
    observation_space: spaces.Space[object],
    action_space: spaces.Space[object],
) -> tuple[ParamLayout, PolicySpec]:
    """Return the layout and structure of a policy that is a plain multilayer perceptron.

    With both in ``RunInfo`` a run's policies can be rebuilt and evaluated: ``run.load_policy(t)``.
    The names are those of ``actor.state_dict()``; continuous actions are Gaussian, with one more
    parameter, ``log_std`` (action,).

    >>> actor = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 2))  # doctest: +SKIP
    >>> spaces = env.observation_space, env.action_space  # doctest: +SKIP
    >>> layout, policy = describe_mlp(actor, *spaces)  # doctest: +SKIP

    Args:
        actor: linear layers with one kind of activation between them, and nothing after the last.
        observation_space: of the environment, a ``Box``.
        action_space: of the environment, ``Box`` or ``Discrete``.

    Raises:
        CollectError: the network or a space is something else, they do not fit each other, or the
            network computes something else than its layers do.
    """
    linear = [i for i, module in enumerate(actor) if isinstance(module, nn.Linear)]
    between = [module for module in actor if not isinstance(module, nn.Linear)]
    kinds = {type(module) for module in between}
    alternate = linear == list(range(0, len(actor), 2)) and len(between) == len(linear) - 1
    biased = all(actor[i].bias is not None for i in linear)
    plain = all(repr(module) == repr(type(module)()) for module in between)
    head, reasons = describe_head(action_space)
    box = isinstance(observation_space, spaces.Box)
    if not (alternate and biased and plain and len(kinds) <= 1 and kinds <= ACTIVATIONS.keys()):
        reasons.append("layers that are not linear, activation, linear, ..., linear, with biases")
    if not box:
        reasons.append(f"observations in a {type(observation_space).__name__} space")
    if reasons:
        raise CollectError(
            "the policy cannot be described as a multilayer perceptron",
            expected=f"Linear layers with one of {', '.join(ACTIVATIONS.values())} between them; a "
            "Box of observations; actions in a Box or in Discrete from 0",
            got=f"{'; '.join(reasons)}: {actor}",
            do="write a ParamLayout yourself; the run then has weights, and no policies that act",
        )
    policy = PolicySpec(
        kind="mlp",
        activation=ACTIVATIONS[kinds.pop()] if kinds else "",
        layers=tuple((f"{i}.weight", f"{i}.bias") for i in linear),
        observation_shape=tuple(observation_space.shape or ()),
        **head,
    )
    parameters = dict(actor.named_parameters())
    if isinstance(action_space, spaces.Box):
        parameters |= {"log_std": nn.Parameter(torch.zeros(action_space.shape))}
    layout = describe_layout(parameters, policy)
    problem = find_misfit(policy, layout) or _misfit_of_choices(policy, layout, action_space)
    if problem := problem or find_difference_of_network(actor, policy, layout):
        raise CollectError(
            "the network does not fit its description as a multilayer perceptron",
            expected=f"a network from observations {observation_space} to actions {action_space}, "
            "of plain linear layers",
            got=problem,
            where=actor,
            do="pass the network and the spaces of one training; for another kind of network "
            "write a ParamLayout yourself, the run then has weights, and no policies that act",
        )
    return layout, policy


def _misfit_of_choices(
    policy: PolicySpec, layout: ParamLayout, action_space: spaces.Space[object]
) -> str:
    """Return why the last layer does not choose among the actions; empty: it does."""
    last = policy.layers[-1][1]
    if not isinstance(action_space, spaces.Discrete) or layout[last].size == action_space.n:
        return ""
    return f"there are {action_space.n} actions, and {last} has {layout[last].size} numbers"
