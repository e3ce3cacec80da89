"""What a Stable-Baselines3 model is, as the metadata of a run says it."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from weighttraj.collect.agents import Agent, actor_parameters
from weighttraj.collect.environment import describe_env
from weighttraj.collect.normalizers import Normalizers
from weighttraj.collect.proof import find_difference, own_methods
from weighttraj.collect.settings import Store
from weighttraj.format import Algorithm, Cadence, ParamLayout, PolicySpec, Provenance, RunInfo
from weighttraj.format.layout import Role

Acting = Literal["squashed_gaussian", "squashed", "greedy"]
"""How the network of an off-policy algorithm acts: see ``PolicySpec.acting``."""

PACKAGES = ("torch", "stable-baselines3", "gymnasium", "mujoco", "numpy", "zarr", "weighttraj")

_PPO = (
    "approx_kl",
    "clip_fraction",
    "entropy_loss",
    "explained_variance",
    "policy_gradient_loss",
    "value_loss",
)
_SAC = ("actor_loss", "critic_loss", "ent_coef", "ent_coef_loss")
DIAGNOSTICS = {
    "PPO": _PPO,
    "A2C": ("entropy_loss", "explained_variance", "policy_loss", "value_loss"),
    "MaskablePPO": _PPO,
    "RecurrentPPO": _PPO,
    "TRPO": ("explained_variance", "kl_divergence_loss", "policy_objective", "value_loss"),
    "SAC": _SAC,
    "TQC": _SAC,
    "CrossQ": _SAC,
    "TD3": ("actor_loss", "critic_loss"),
    "DQN": ("loss",),
    "QRDQN": ("loss",),
}
"""What each algorithm logs under ``train/`` after an update."""

HYPERPARAMETERS = (
    "n_steps",
    "batch_size",
    "n_epochs",
    "n_envs",
    "gamma",
    "gae_lambda",
    "ent_coef",
    "vf_coef",
    "max_grad_norm",
    "normalize_advantage",
    "target_kl",
    "use_sde",
    "buffer_size",
    "learning_starts",
    "gradient_steps",
    "tau",
    "policy_delay",
    "target_policy_noise",
    "target_noise_clip",
    "target_update_interval",
    "exploration_fraction",
    "exploration_initial_eps",
    "exploration_final_eps",
)
"""Attributes of a model that are hyper-parameters with plain values."""

ACTIVATIONS: dict[type[nn.Module], str] = {
    nn.Tanh: "tanh",
    nn.ReLU: "relu",
    nn.ELU: "elu",
    nn.LeakyReLU: "leaky_relu",
}
"""Modules between layers, and what they are called in the metadata."""


def diagnostics_of(model: BaseAlgorithm) -> tuple[str, ...]:
    """Return the names that an algorithm, or the one that it derives from, logs after an update."""
    kinds = [kind.__name__ for kind in type(model).__mro__ if kind.__name__ in DIAGNOSTICS]
    return DIAGNOSTICS[kinds[0]] if kinds else ()


def describe_run(
    agent: Agent,
    norm: Normalizers,
    run_id: str,
    store: Store,
) -> RunInfo:
    """Return the metadata of a run, before its training.

    Args:
        agent: what will be trained.
        norm: its normalisers.
        run_id: id of the run.
        store: what is stored, and how often.
    """
    model, on_policy = agent.model, agent.on_policy
    policy = describe_agent(agent, norm.unknown)
    probes = store.probe_observations if policy.observation_shape else 0
    return RunInfo(
        run_id=run_id,
        layout=describe_layout(agent.actor, policy),
        policy=policy,
        env=describe_env(model.env, norm),
        algorithm=describe_algorithm(agent),
        seed=model.seed,
        cadence=describe_cadence(agent, store.every),
        obs_norm=norm.obs_norm,
        ret_norm=norm.read_ret is not None,
        diagnostics=(*diagnostics_of(model), "ep_rew_mean"),
        critic_layout=describe_layout(agent.critic, policy) if store.critic else None,
        optimizer_moments=store.optimizer_moments,
        probe_observations=min(probes, on_policy.n_steps * on_policy.n_envs) if on_policy else 0,
        provenance=describe_provenance(),
        block=store.block,
    )


def describe_layout(parameters: dict[str, nn.Parameter], policy: PolicySpec) -> ParamLayout:
    """Return the order, shape, role and symmetry of the parameters."""
    axes: dict[str, tuple[str, ...]] = {}
    for i, (weight, bias) in enumerate(policy.layers):
        inputs = "observation" if i == 0 else f"hidden_{i - 1}"
        outputs = "action" if i == len(policy.layers) - 1 else f"hidden_{i}"
        axes[weight], axes[bias] = (outputs, inputs), (outputs,)
    if policy.log_std:  # beside the last layer
        axes |= dict(zip(policy.log_std, (axes[n] for n in policy.layers[-1]), strict=True))
    tensors: dict[str, tuple[tuple[int, ...], Role, tuple[str, ...]]] = {}
    for name, parameter in parameters.items():
        shape = tuple(parameter.shape)
        label = "action" if name == "log_std" and policy.layers else "fixed"
        labels = axes.get(name, (label,) * len(shape))
        tensors[name] = (shape, _role(name), labels)
    return ParamLayout.of(tensors)


def describe_agent(agent: Agent, unknown_wrappers: tuple[str, ...]) -> PolicySpec:
    """Return what it takes to rebuild the network that acts, or the reasons why it cannot be."""
    own = own_methods(agent.model, ("predict",))
    if isinstance(agent.network, ActorCriticPolicy):
        return describe_policy(agent.network, unknown_wrappers, own)
    spec, reasons = _off_policy(agent)
    if not reasons:
        layout = describe_layout(agent.actor, spec)
        reasons = find_difference(agent.model.policy, spec, layout) + own
    if reasons:
        spec = replace(spec, acting="", layers=(), log_std=(), activation="")
    reasons += _changing(unknown_wrappers)
    if unknown_wrappers:
        spec = replace(spec, acting="")
    return replace(spec, cannot_rebuild=tuple(reasons))


def _off_policy(agent: Agent) -> tuple[PolicySpec, list[str]]:
    """The acting network of an off-policy algorithm, and the reasons why it is certainly none."""
    network, space = agent.network, agent.network.observation_space
    reasons = _surroundings(network)
    head, odd = describe_head(network.action_space)
    parts = _parts(network)
    if parts is None:
        return PolicySpec(kind="other"), [f"policy class {type(network).__name__}", *reasons]
    acting, net, prefix, last, log_std = parts
    linear, activation, more = _hidden(net)
    names = [f"{agent.prefix}{prefix}.{i}" for i in linear] + [f"{agent.prefix}{last}"]
    layers = tuple((f"{name}.weight", f"{name}.bias") for name in names)
    log_std = tuple(f"{agent.prefix}{name}" for name in log_std)
    reasons += [*odd, *more]
    reasons += _other_parameters(agent.actor, {n for pair in (*layers, log_std) for n in pair})
    reasons += _odd_observations(space)
    spec = PolicySpec(
        kind="other",
        acting=acting,
        activation=activation,
        layers=layers,
        log_std=log_std,
        observation_shape=tuple(space.shape or ()) if isinstance(space, spaces.Box) else (),
        **(head | {"head": "other"}),
    )
    return spec, reasons


def _parts(network: Any) -> tuple[Acting, nn.Sequential, str, str, tuple[str, ...]] | None:
    """How a network acts, its hidden part and the name of that, of the last layer, and the names of
    the parameters of the deviation; None: it is not known how it acts."""
    hidden, mu = getattr(network, "latent_pi", None), getattr(network, "mu", None)
    if isinstance(hidden, nn.Sequential) and isinstance(mu, nn.Linear):  # SAC
        if isinstance(getattr(network, "log_std", None), nn.Linear):
            names = ("log_std.weight", "log_std.bias")
            return "squashed_gaussian", hidden, "latent_pi", "mu", names
    elif isinstance(mu, nn.Sequential) and len(mu) > 1 and type(mu[-1]) is nn.Tanh:  # TD3
        return "squashed", nn.Sequential(*list(mu.children())[:-2]), "mu", f"mu.{len(mu) - 2}", ()
    net = getattr(network, "q_net", None)
    if isinstance(net, nn.Sequential) and len(net):  # DQN
        hidden = nn.Sequential(*list(net.children())[:-1])
        return "greedy", hidden, "q_net", f"q_net.{len(net) - 1}", ()
    return None


def describe_policy(
    policy: ActorCriticPolicy, unknown_wrappers: tuple[str, ...], more: Sequence[str] = ()
) -> PolicySpec:
    """Return what it takes to rebuild the policy, or the reasons why it cannot be.

    A description without reasons is proven: the policy that is rebuilt from it acts as this one.

    Args:
        policy: of the agent.
        unknown_wrappers: those that may change observations or actions.
        more: reasons that were found elsewhere.
    """
    spec, reasons = _network(policy)
    reasons = [*reasons, *more]
    if not reasons:
        reasons = find_difference(policy, spec, describe_layout(actor_parameters(policy), spec))
    if reasons:  # what the layers are for is then unknown
        spec = replace(spec, layers=(), activation="")
    reasons += _changing(unknown_wrappers)
    return replace(spec, kind="other" if reasons else "mlp", cannot_rebuild=tuple(reasons))


def _changing(wrappers: tuple[str, ...]) -> list[str]:
    """Return reasons why a policy cannot act outside its wrappers."""
    change = "which may change observations or actions"
    return [f"environment wrapper {name}, {change}" for name in wrappers]


def _network(policy: ActorCriticPolicy) -> tuple[PolicySpec, list[str]]:
    """Return the policy as a multilayer perceptron, and the reasons why it is certainly none."""
    space = policy.observation_space
    layers, activation, reasons = _mlp(policy)
    head, odd = describe_head(policy.action_space)
    if getattr(policy, "use_sde", False):
        head, odd = {"head": "other"}, ["state-dependent exploration"]
    reasons += odd
    if policy.squash_output:
        reasons.append("actions squashed by tanh")
    reasons += _odd_observations(space)
    if layers and not reasons:
        wanted = {name for pair in layers for name in pair}
        gaussian = {"log_std"} if head["head"] == "gaussian" else set()
        reasons += _other_parameters(actor_parameters(policy), wanted | gaussian)
    spec = PolicySpec(
        kind="mlp",
        activation=activation,
        layers=layers,
        observation_shape=tuple(space.shape or ()) if isinstance(space, spaces.Box) else (),
        **head,
    )
    return spec, reasons


def _odd_observations(space: spaces.Space[Any]) -> list[str]:
    """Return reasons why a multilayer perceptron does not see the observations as they are."""
    reasons = []
    if not isinstance(space, spaces.Box):
        reasons.append(f"observations in a {type(space).__name__} space")
    if is_image_space(space):
        reasons.append("observations that SB3 takes for images and scales")
    return reasons


def _other_parameters(parameters: dict[str, nn.Parameter], wanted: set[str]) -> list[str]:
    """Return reasons why the parameters are not those of a multilayer perceptron."""
    reasons = []
    if more := sorted(parameters.keys() - wanted):
        reasons.append(f"parameters that no multilayer perceptron has: {_few(more)}")
    if missing := sorted(wanted - parameters.keys()):
        reasons.append(
            "parameters that are shared, compiled, parametrised or missing: " + _few(missing)
        )
    if types := sorted({str(p.dtype) for p in parameters.values()} - {"torch.float32"}):
        reasons.append(f"parameters in {', '.join(types)}, which are stored as float32")
    return reasons


def _few(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def describe_head(space: spaces.Space[Any]) -> tuple[dict[str, Any], list[str]]:
    """Fields of ``PolicySpec`` on actions, and reasons why they cannot be drawn."""
    if isinstance(space, spaces.Box):
        head = {
            "head": "gaussian",
            "action_shape": space.shape,
            "action_low": tuple(space.low.reshape(-1).tolist()),
            "action_high": tuple(space.high.reshape(-1).tolist()),
        }
        return head, []
    if isinstance(space, spaces.Discrete):
        starts = int(space.start)
        odd = "discrete actions that do not start at 0, which SB3 does not support"
        return {"head": "categorical"}, [odd] * (starts != 0)
    return {"head": "other"}, [f"actions in {space}"]


def describe_algorithm(agent: Agent, collector: str = "") -> Algorithm:
    """Return the name and hyper-parameters; schedules become tables over the progress that remains.

    Args:
        agent: what is trained.
        collector: who trains in its place; empty: SB3.
    """
    model = agent.model
    values = {n: _plain(getattr(model, n)) for n in HYPERPARAMETERS if hasattr(model, n)}
    for name in ("lr_schedule", "clip_range", "clip_range_vf"):
        schedule = getattr(model, name, None)
        if callable(schedule):
            values[name] = [[p, float(schedule(p))] for p in (1.0, 0.75, 0.5, 0.25, 0.0)]
    values["policy_kwargs"] = _plain(model.policy_kwargs)
    if agent.optimizer is not None:
        defaults = {k: v for k, v in agent.optimizer.defaults.items() if v is not None}
        values["optimizer"] = {"class": type(agent.optimizer).__name__, **_plain(defaults)}
    sb3 = f"stable-baselines3 {importlib.metadata.version('stable-baselines3')}"
    return Algorithm(
        name=type(model).__name__,
        library=f"{collector}, as {sb3}" if collector else sb3,
        hyperparameters=values,
    )


def describe_cadence(agent: Agent, every: int) -> Cadence:
    """Return when snapshots are taken."""
    steps = 1 if agent.unit == "update" else _steps_of_an_update(agent.model)
    return Cadence(every=every, unit=agent.unit, gradient_steps_per_iteration=steps)


def _steps_of_an_update(model: BaseAlgorithm) -> int | None:
    """Return the optimizer's steps between two rollouts; None: it varies, or is not known."""
    train = getattr(type(model), "train", None)
    if train is A2C.train:
        return 1
    if train is not PPO.train or not isinstance(model, PPO) or model.target_kl is not None:
        return None
    return model.n_epochs * -(-model.n_steps * model.n_envs // model.batch_size)


def describe_provenance() -> Provenance:
    """Return versions, machine and command of this process."""
    packages = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            packages[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return Provenance(
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        packages=packages,
        platform=f"{platform.system()} {platform.machine()}",
        cpu=_cpu(),
        threads=torch.get_num_threads(),
        command=" ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        commit=_commit(),
    )


def _mlp(policy: ActorCriticPolicy) -> tuple[tuple[tuple[str, str], ...], str, list[str]]:
    """Return layer names, activation, and reasons why this is no plain MLP."""
    reasons = _surroundings(policy)
    net = getattr(getattr(policy, "mlp_extractor", None), "policy_net", None)
    if not isinstance(net, nn.Sequential) or not isinstance(policy.action_net, nn.Linear):
        return (), "", [*reasons, f"policy class {type(policy).__name__} with no policy_net"]
    linear, activation, odd = _hidden(net)
    prefixes = [f"mlp_extractor.policy_net.{i}" for i in linear] + ["action_net"]
    return tuple((f"{p}.weight", f"{p}.bias") for p in prefixes), activation, [*reasons, *odd]


def _surroundings(policy: BasePolicy) -> list[str]:
    """Return reasons why a network has more to it than its layers."""
    reasons = []
    if not isinstance(policy.features_extractor, FlattenExtractor):
        reasons.append(f"features from {type(policy.features_extractor).__name__}")
    if any(True for _ in policy.buffers()):
        reasons.append("buffers beside the parameters, which are not stored")
    if any(getattr(module, "_compiled_call_impl", None) for module in policy.modules()):
        reasons.append("layers compiled by torch.compile, which may move the last bits")
    return reasons


def _hidden(net: nn.Sequential) -> tuple[list[int], str, list[str]]:
    """Return the places of linear layers, the activation, and reasons why it is no plain MLP."""
    reasons = []
    linear = [i for i, module in enumerate(net) if isinstance(module, nn.Linear)]
    kinds = {type(m) for m in net if not isinstance(m, nn.Linear)}
    known = kinds & ACTIVATIONS.keys()
    changed = [m for m in net if type(m) in known and repr(m) != repr(type(m)())]
    if kinds != known or len(kinds) > 1 or len(net) != 2 * len(linear) or changed:
        names = sorted(kind.__name__ for kind in kinds)
        reasons.append(f"hidden modules {names}, not one activation after each linear layer")
    return linear, next((ACTIVATIONS[kind] for kind in known), ""), reasons


def _role(name: str) -> Role:
    if name == "log_std":
        return "log_std"
    ending = name.rsplit(".", 1)[-1]
    return "weight" if ending == "weight" else "bias" if ending == "bias" else "other"


def _plain(value: Any) -> Any:
    """Return the nearest JSON value: code is named, never stored."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and np.isnan(value):
        return "nan"
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return getattr(value, "__qualname__", type(value).__qualname__)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((s.split(":", 1)[1].strip() for s in lines if s.startswith("model name")), "")


def _commit() -> str:
    try:
        command = ["git", "rev-parse", "HEAD"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
