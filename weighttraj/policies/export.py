"""One snapshot as a Stable-Baselines3 model, to be loaded without this package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from weighttraj import environments
from weighttraj.atomic import appearing
from weighttraj.errors import CollectError, PolicyError
from weighttraj.policies.policy import load_policy
from weighttraj.policies.rollout import env_of
from weighttraj.run import NormStats, Run

_ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU, "elu": nn.ELU, "leaky_relu": nn.LeakyReLU}
_SHARED = (
    "n_steps",
    "gamma",
    "gae_lambda",
    "ent_coef",
    "vf_coef",
    "max_grad_norm",
    "normalize_advantage",
)
_ARGUMENTS = {"PPO": (*_SHARED, "batch_size", "n_epochs", "target_kl"), "A2C": _SHARED}
_SCHEDULES = {"PPO": ("clip_range", "clip_range_vf"), "A2C": ()}
"""Arguments that are recorded as tables."""


@dataclass(frozen=True, kw_only=True)
class SB3Export:
    """What ``export_sb3`` wrote."""

    model: Path
    """For ``PPO.load`` (or ``A2C.load``, as the run was trained)."""
    vecnormalize: Path | None
    """For ``VecNormalize.load``; None: the policy takes observations as they are."""
    critic: Literal["stored", "fresh"]
    """Whether the critic is the one of that time, or was not stored and is newly initialised."""


def export_sb3(run: Run, t: int, folder: str | Path) -> SB3Export:
    """Write snapshot t as ``model.zip`` and, if observations are normalised, ``vecnormalize.pkl``.

    The actor's parameters are the stored ones bit by bit, and ``PPO.load(...).predict`` acts on
    what ``VecNormalize.load(...)`` makes of raw observations as ``run.load_policy(t)`` does. The
    loaded ``VecNormalize`` is set up for evaluation: statistics stand still, rewards stay raw.

    The rest of the model is what the run tells of it. The critic is the stored one, or a fresh one
    if ``critic`` says so. Learning rate and clip range are constants: the rate of the step that led
    to the snapshot, the range at the start of training. Adam's moments start from zero.

    These are SB3's own formats, which hold pickles: load them from sources that you trust only, and
    with the SB3 version that wrote them. To keep or to share data, use the run itself.

    Args:
        run: the run.
        t: the snapshot; negative ones count from the end.
        folder: to be written; it appears once it is whole.

    Returns:
        The paths, and where the critic comes from.

    Raises:
        StoreExistsError: the folder exists.
        IndexError: there is no such snapshot.
        PolicyError: the policy cannot be rebuilt, its environment here is another than it was
            trained in, or SB3 has no such normaliser.
    """
    folder = Path(folder)
    if run.info.policy.acting:
        raise PolicyError(
            "only policies of PPO and A2C are exported",
            got=f"a policy that acts as {run.info.policy.acting}",
            where=run.path,
            do="load the snapshot into a model of your own with run.load_into(model, t)",
        )
    venv = DummyVecEnv([lambda: _Nowhere(*_spaces(run))])
    normalize = _vec_normalize(run, t, venv)
    model, critic = _model(run, t, venv)
    with appearing(folder) as draft:
        draft.mkdir()
        model.save(draft / "model.zip")
        if normalize is not None:
            normalize.save(str(draft / "vecnormalize.pkl"))
    return SB3Export(
        model=folder / "model.zip",
        vecnormalize=None if normalize is None else folder / "vecnormalize.pkl",
        critic=critic,
    )


class _Nowhere(gym.Env[Any, Any]):
    """Spaces without an environment: SB3 asks for nothing else, and no file keeps it."""

    def __init__(self, observation: spaces.Space[Any], action: spaces.Space[Any]) -> None:
        self.observation_space = observation
        self.action_space = action


def _spaces(run: Run) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    """Spaces of observations and actions: the environment's, or the recorded ones without it."""
    recorded = _recorded_spaces(run)
    info = run.info.env
    try:
        if info is None:
            return recorded
        env = environments.remake(env_of(run))
    except (CollectError, PolicyError):  # not registered here, or it cannot be made again
        return recorded
    observation, action = env.observation_space, env.action_space
    env.close()
    if isinstance(recorded[1], spaces.Box) and not recorded[1].is_bounded():
        action = recorded[1]  # a wrapper of the training clips actions
    same_action = type(action) is type(recorded[1]) and action == _cast(recorded[1], action)
    if observation.shape != recorded[0].shape or not same_action:
        raise PolicyError(
            "the environment is not the one that the policy was trained in",
            expected=f"observations {recorded[0].shape}, actions {recorded[1]}",
            got=f"observations {observation.shape}, actions {action}",
            where=f"{run.path}, environment {info.id}",
            do="install the version of the environment that run.info.provenance names",
        )
    return observation, action


def _recorded_spaces(run: Run) -> tuple[spaces.Box, spaces.Space[Any]]:
    policy = load_policy(run, 0).spec  # raises PolicyError if it describes no network
    observation = spaces.Box(-np.inf, np.inf, policy.observation_shape, np.float32)
    if policy.head == "gaussian":
        low, high = (
            np.array(x, np.float32).reshape(policy.action_shape)
            for x in (policy.action_low, policy.action_high)
        )
        return observation, spaces.Box(low, high, dtype=np.float32)
    return observation, spaces.Discrete(run.layout[policy.layers[-1][1]].size)


def _cast(recorded: spaces.Space[Any], like: spaces.Space[Any]) -> spaces.Space[Any]:
    """Return a recorded space with the environment's type of numbers, which does not matter."""
    if isinstance(recorded, spaces.Box) and isinstance(like, spaces.Box):
        return spaces.Box(recorded.low, recorded.high, dtype=like.dtype)
    return recorded


def _vec_normalize(run: Run, t: int, venv: DummyVecEnv) -> VecNormalize | None:
    norm, stats = run.info.obs_norm, run.obs_norm(t)
    if norm is None or stats is None:
        return None
    high = np.inf if norm.clip_high is None else norm.clip_high
    low = -np.inf if norm.clip_low is None else norm.clip_low
    if low != -high:
        raise PolicyError(
            "SB3's VecNormalize clips to the same bound below and above",
            expected="clip_low = -clip_high",
            got=f"clip_low {low}, clip_high {high}",
            where=run.path,
            do="normalise with run.load_policy(t).normalize instead",
        )
    hyper = run.info.algorithm.hyperparameters if run.info.algorithm else {}
    normalize = VecNormalize(
        venv,
        training=False,
        norm_reward=False,
        clip_obs=high,
        epsilon=norm.epsilon,
        gamma=float(hyper.get("gamma", 0.99)),
    )
    normalize.obs_rms = _running(stats, norm.dtype)  # type: ignore[assignment]  # else a Dict's
    rewards = run.ret_norm(t)
    if rewards is not None:
        normalize.ret_rms = _running(rewards, "float64")
    return normalize


def _running(stats: NormStats, dtype: str) -> RunningMeanStd:
    """SB3's statistics, in the type in which the trainer kept them: it moves the last bits."""
    running = RunningMeanStd(shape=stats.mean.shape)
    running.mean, running.var = stats.mean.astype(dtype), stats.var.astype(dtype)
    running.count = stats.count
    return running


def _model(
    run: Run, t: int, venv: DummyVecEnv
) -> tuple[OnPolicyAlgorithm, Literal["stored", "fresh"]]:
    name = run.info.algorithm.name if run.info.algorithm else ""
    kind: type[PPO | A2C] = A2C if name == "A2C" else PPO
    arguments = _arguments(run, t, kind.__name__)
    try:
        with torch.random.fork_rng(devices=[]):  # the caller's random numbers go on as they were
            torch.manual_seed(run.info.seed or 0)
            model: OnPolicyAlgorithm = kind("MlpPolicy", venv, device="cpu", **arguments)
    except (TypeError, ValueError, AssertionError) as error:
        raise PolicyError(
            f"the recorded hyper-parameters make no {kind.__name__}",
            got=f"{arguments}: {error}",
            where=run.path,
            do="rebuild it yourself from run.load_policy(t)",
        ) from error
    model.seed = run.info.seed  # not as an argument: that would seed the caller's generators
    model.num_timesteps = int(run["index/num_timesteps"][t])
    actor, critic = _actor(run, t), _critic(run, t)
    own = model.policy.state_dict()
    stored = bool(critic) and all(n in own and own[n].shape == w.shape for n, w in critic.items())
    model.policy.load_state_dict({**own, **actor, **(critic if stored else {})})
    return model, "stored" if stored else "fresh"


def _actor(run: Run, t: int) -> dict[str, torch.Tensor]:
    """Return the actor's parameters, under SB3's names."""
    tensors = run.layout.unflatten(run.weights[t])
    spec = run.info.policy
    named: dict[str, np.ndarray] = {}
    for i, (weight, bias) in enumerate(spec.layers):
        last = i == len(spec.layers) - 1
        prefix = "action_net" if last else f"mlp_extractor.policy_net.{2 * i}"
        named |= {f"{prefix}.weight": tensors[weight], f"{prefix}.bias": tensors[bias]}
    if spec.head == "gaussian":
        named["log_std"] = tensors["log_std"]
    return {name: torch.from_numpy(value.copy()) for name, value in named.items()}


def _critic(run: Run, t: int) -> dict[str, torch.Tensor]:
    """Return the critic's parameters at t; empty: not stored."""
    layout = run.info.critic_layout
    if layout is None:
        return {}
    tensors = layout.unflatten(run["critic/weights"][t])
    return {name: torch.from_numpy(value.copy()) for name, value in tensors.items()}


def _arguments(run: Run, t: int, kind: str) -> dict[str, Any]:
    """Return arguments of the algorithm, as far as the run tells."""
    hyper = run.info.algorithm.hyperparameters if run.info.algorithm else {}
    arguments = {name: hyper[name] for name in _ARGUMENTS[kind] if name in hyper}
    tables = {"learning_rate": "lr_schedule", **{name: name for name in _SCHEDULES[kind]}}
    for name, table in tables.items():
        if hyper.get(table):
            arguments[name] = float(hyper[table][0][1])
    rate = float(run["index/learning_rate"][t])
    if np.isfinite(rate):
        arguments["learning_rate"] = rate
    policy = {
        "net_arch": {"pi": _units(run), "vf": _critic_units(run)},
        "activation_fn": _ACTIVATIONS.get(run.info.policy.activation, nn.Tanh),
        "optimizer_kwargs": _adam(hyper),
    }
    return {**arguments, "policy_kwargs": policy}


def _units(run: Run) -> list[int]:
    """Return units of the actor's hidden layers."""
    return [run.layout[bias].size for _, bias in run.info.policy.layers[:-1]]


def _critic_units(run: Run) -> list[int]:
    """Return units of the critic's hidden layers; the actor's, if the critic is not stored."""
    layout = run.info.critic_layout
    if layout is None:
        return _units(run)
    hidden = [p for p in layout.params if p.name.startswith("mlp_extractor.value_net.")]
    return [p.size for p in hidden if p.role == "bias"]


def _adam(hyper: dict[str, Any]) -> dict[str, Any]:
    optimizer = hyper.get("optimizer", {})
    if not isinstance(optimizer, dict) or optimizer.get("class") != "Adam":
        return {}
    names = ("betas", "eps", "weight_decay")
    return {name: optimizer[name] for name in names if name in optimizer}
