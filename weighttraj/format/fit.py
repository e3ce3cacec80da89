"""Whether the layers that a run's metadata names fit each other and the run's spaces."""

from __future__ import annotations

import math

from weighttraj.format.layout import ParamLayout
from weighttraj.format.schema import ObsNorm, PolicySpec


def find_misfit(policy: PolicySpec, layout: ParamLayout, obs_norm: ObsNorm | None = None) -> str:
    """Return why a multilayer perceptron cannot act with such parameters; empty: it can.

    Args:
        policy: description of the policy. One that cannot be rebuilt always fits.
        layout: its parameters.
        obs_norm: its normaliser of observations; None: it has none.
    """
    if policy.kind != "mlp" and not policy.acting:
        return ""
    if obs_norm is not None and obs_norm.shape != policy.observation_shape:
        return (
            f"an observation has the shape {policy.observation_shape}, and the statistics of its "
            f"normaliser {obs_norm.shape}"
        )
    shapes = {spec.name: spec.shape for spec in layout.params}
    named = [name for pair in policy.layers for name in pair]
    named += ["log_std"] if policy.mode == "gaussian" else []
    named += policy.log_std
    if missing := [name for name in named if name not in shapes]:
        return f"the layout has no parameter {missing[0]!r}"
    if not policy.layers:
        return "no layers are named"
    size = math.prod(policy.observation_shape)
    given = f"an observation {policy.observation_shape} has {size} numbers"
    for weight, bias in policy.layers:
        if len(shapes[weight]) != 2 or shapes[bias] != shapes[weight][:1]:
            return f"{weight} {shapes[weight]} and {bias} {shapes[bias]} are no layer"
        if shapes[weight][1] != size:
            return f"{given}, and {weight} takes {shapes[weight][1]}"
        size = shapes[weight][0]
        given = f"{weight} gives {size} numbers"
    return _misfit_of_actions(policy, size, shapes, given)


def _misfit_of_actions(
    policy: PolicySpec, size: int, shapes: dict[str, tuple[int, ...]], given: str
) -> str:
    if policy.mode in ("categorical", "greedy"):
        return ""
    if not policy.is_continuous:
        return f"a multilayer perceptron with the head {policy.head!r}"
    if math.prod(policy.action_shape) != size:
        wanted = math.prod(policy.action_shape)
        return f"{given}, and an action {policy.action_shape} has {wanted}"
    if policy.mode == "squashed_gaussian":
        last = shapes[policy.layers[-1][0]]
        if [shapes[name] for name in policy.log_std] != [last, last[:1]]:
            return f"the layer of the deviation {policy.log_std} is not as large as the last one"
    deviations = math.prod(shapes["log_std"]) if policy.mode == "gaussian" else size
    counts = {
        "log_std": deviations,
        "action_low": len(policy.action_low),
        "action_high": len(policy.action_high),
    }
    wrong = [f"{name} has {count}" for name, count in counts.items() if count != size]
    return f"an action has {size} numbers, and {wrong[0]}" if wrong else ""
