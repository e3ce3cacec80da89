"""Loads a stored snapshot into a model of the user's own, whatever its network is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from gymnasium import wrappers as gw
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn

from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.proof import acts_with
from weighttraj.errors import PolicyError
from weighttraj.run import NormStats, Run

Target = BaseAlgorithm | nn.Module | Mapping[str, Tensor]
"""What a snapshot is loaded into: a Stable-Baselines3 model, any module, or named tensors."""


def load_into(
    run: Run, target: Target, t: int = -1, *, normalizer: bool = True, keep_buffers: bool = False
) -> None:
    """Do what ``Run.load_into`` says."""
    module = target.policy if isinstance(target, BaseAlgorithm) else target
    stored = _stored(run, t)
    tensors: dict[str, Tensor] = {
        **(dict(module.named_parameters()) if isinstance(module, nn.Module) else module)
    }
    if isinstance(module, nn.Module) and not keep_buffers:
        _check_buffers(run, module)
    critic = run.info.critic_layout
    if critic is not None and all(spec.name in tensors for spec in critic.params):
        rows = run["critic/weights"][t]
        stored |= {name: torch.from_numpy(x.copy()) for name, x in critic.unflatten(rows).items()}
    _check_tensors(run, stored, tensors)
    _check_rest(run, stored, tensors, module)
    write = _writer_of_statistics(run, target, t) if normalizer else _nothing
    _copy(run, stored, tensors)
    write()
    if getattr(target, "use_sde", False):  # the exploration noise depends on the weights
        module.reset_noise()  # type: ignore[operator,union-attr]


def _stored(run: Run, t: int) -> dict[str, Tensor]:
    parts = run.layout.unflatten(np.asarray(run.weights[t]))
    return {name: torch.from_numpy(part.copy()) for name, part in parts.items()}


def _check_buffers(run: Run, module: nn.Module) -> None:
    if names := [name for name, _ in module.named_buffers()]:
        raise PolicyError(
            "the model has buffers, which no run stores, and may act with them",
            expected="a model that has parameters only",
            got=names[:8],
            where=run.path,
            do="if they are constants, or you have loaded them, pass keep_buffers=True",
        )


def _check_tensors(run: Run, stored: dict[str, Tensor], tensors: dict[str, Tensor]) -> None:
    """Check that each stored parameter has its place."""
    wrong = []
    for name, value in stored.items():
        if name not in tensors:
            wrong.append(f"{name}: missing")
        elif tensors[name].shape != value.shape or tensors[name].dtype != value.dtype:
            tensor = tensors[name]
            wrong.append(
                f"{name}: {tuple(tensor.shape)} {tensor.dtype}, stored {tuple(value.shape)} "
                f"{value.dtype}"
            )
    if wrong:
        raise PolicyError(
            "the model is another network than the one that was trained",
            expected="parameters with the names, shapes and types of run.layout",
            got="; ".join(wrong[:8]) + (f"; and {len(wrong) - 8} more" if len(wrong) > 8 else ""),
            where=run.path,
            do="make the model with the policy and the settings of the training",
        )


def _check_rest(
    run: Run, stored: dict[str, Tensor], tensors: dict[str, Tensor], module: object
) -> None:
    """Check that the model does not act with parameters that the run does not store."""
    rest = [name for name in tensors if name not in stored]
    if not rest or (isinstance(module, BasePolicy) and not acts_with(module, rest)):
        return
    raise PolicyError(
        "the model has parameters that the run does not store, and may act with them",
        expected=f"the {len(stored)} parameters of run.layout",
        got=f"also {', '.join(rest[:8])}",
        where=run.path,
        do="pass the part of the model that the run holds, or its tensors by name",
    )


def _writer_of_statistics(run: Run, target: Target, t: int) -> Callable[[], None]:
    """What writes the normaliser's statistics into the target, once everything is checked."""
    spec, stats = run.info.obs_norm, run.obs_norm(t)
    env = target.get_env() if isinstance(target, BaseAlgorithm) else None
    found = find_normalizers(env) if env is not None else None
    theirs = found.obs_norm if found is not None else None
    if theirs is None and env is not None and _normalizes(env):
        raise _no_statistics(run, "a normaliser whose statistics no run stores")
    if spec is None and theirs is None:
        return _nothing
    if spec is None or stats is None:
        raise _no_statistics(run, f"a normaliser of observations, {theirs}")
    if found is None or theirs is None or found.live_obs is None:
        raise PolicyError(
            "the policy acts on normalised observations, and the target has no normaliser",
            expected=f"a Stable-Baselines3 model whose environment has {spec.source}",
            got=type(target).__name__,
            where=run.path,
            do="pass such a model, or normalizer=False and normalise observations yourself: "
            "clip((obs - mean) / sqrt(var + epsilon)), with run.obs_norm(t) and run.info.obs_norm",
        )
    # The type of the statistics is set with them; before the first observation it is unknown.
    names = [f.name for f in fields(spec) if f.name != "dtype"]
    if wrong := [n for n in names if getattr(spec, n) != getattr(theirs, n)]:
        raise PolicyError(
            "the observation normaliser is another one than that of the training",
            expected={name: getattr(spec, name) for name in wrong},
            got={name: getattr(theirs, name) for name in wrong},
            where=run.path,
            do="make it with the settings of the training",
        )
    statistics = found.live_obs()
    return lambda: _write(statistics, stats, spec.dtype)


def _no_statistics(run: Run, got: str) -> PolicyError:
    return PolicyError(
        "the target normalises observations, and the run stores no statistics for it",
        expected="an environment without a normaliser of observations",
        got=got,
        where=run.path,
        do="take the normaliser away; or set its statistics yourself and pass normalizer=False",
    )


def _normalizes(env: VecEnv) -> bool:
    """Return whether observations are normalised, also by a class that is not known."""
    vec: Any = env
    while hasattr(vec, "venv"):
        if isinstance(vec, VecNormalize) and vec.norm_obs:
            return True
        vec = vec.venv
    return any(env.env_is_wrapped(gw.NormalizeObservation))


def _write(statistics: Any, stats: NormStats, dtype: str) -> None:
    statistics.mean, statistics.var = stats.mean.astype(dtype), stats.var.astype(dtype)
    statistics.count = stats.count


def _nothing() -> None:
    pass


@torch.no_grad()
def _copy(run: Run, stored: dict[str, Tensor], tensors: dict[str, Tensor]) -> None:
    """Write the parameters; put back what was there if that fails."""
    before = {name: tensors[name].detach().clone() for name in stored}
    try:
        for name, value in stored.items():
            tensors[name].copy_(value)
        torn = [n for n, value in stored.items() if not torch.equal(tensors[n].cpu(), value)]
        if torn:
            raise PolicyError(
                "parameters of the model share memory, and the stored ones are not equal",
                got=torn,
                where=run.path,
                do="make the model with the policy and the settings of the training",
            )
    except BaseException:
        for name, value in before.items():
            tensors[name].copy_(value)
        raise
