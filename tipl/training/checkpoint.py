"""The folder of a training: its settings, its log, and a state from which it goes on."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from tipl.errors import TrainError
from weighttraj.atomic import appending, replace_file

Weights = dict[str, Tensor]
"""Parameters by name."""


def keep_settings(
    out: Path,
    settings: Mapping[str, Any],
    may_differ: Collection[str],
    defaults: Mapping[str, Any] | None = None,
) -> None:
    """Write the settings of a training beside the model; refuse to go on with other ones.

    Args:
        out: folder of the model.
        settings: all settings, for JSON.
        may_differ: names of the settings that may change when the training goes on.
        defaults: values of settings that did not exist yet when the training began.

    Raises:
        TrainError: the folder holds a training with other settings.
    """
    file, settings = out / "train.json", json.loads(json.dumps(settings))
    if file.exists():
        old = json.loads(json.dumps(defaults or {})) | json.loads(file.read_text(encoding="utf-8"))
        other = {k: v for k, v in settings.items() if old.get(k) != v and k not in may_differ}
        if other:
            raise TrainError(
                "the folder holds a training with other settings or data",
                expected={k: old.get(k) for k in other},
                got=other,
                where=out,
                do="choose another --out, or delete the folder",
            )
    out.mkdir(parents=True, exist_ok=True)
    replace_file(file, json.dumps(settings, indent=1).encode())


def save_state(
    out: Path,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    n: int,
    average: Weights | None = None,
) -> None:
    """Write all that a later process needs to go on after n batches into one file, atomically."""
    tensors = {f"model.{name}": t for name, t in model.state_dict().items()}
    for i, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{i}.{name}": t for name, t in state.items()}
    tensors |= {f"average.{name}": t for name, t in (average or {}).items()}
    tensors["n"] = torch.tensor(n)
    replace_file(out / "state.safetensors", save(tensors))


def read_state(out: Path) -> Weights:
    """Return what ``save_state`` wrote; nothing if it has not written yet."""
    file = out / "state.safetensors"
    if not file.exists():
        return {}
    try:
        return load_file(file)
    except SafetensorError as error:
        raise TrainError(
            "the checkpoint is damaged",
            expected="the file as it was written",
            got=error,
            where=file,
            do="restore it from a copy, or delete the folder to start again",
        ) from error


def restore(
    tensors: Weights,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    average: Weights | None = None,
) -> int:
    """Put a state into the model, the optimizer and the average; return the batches done."""
    if not tensors:
        return 0
    model.load_state_dict(_named(tensors, "model."), strict=True)
    if average is not None:
        average.update(_named(tensors, "average."))
    states: dict[int, Weights] = {}
    for key, tensor in _named(tensors, "optimizer.").items():
        i, name = key.split(".", 1)
        states.setdefault(int(i), {})[name] = tensor
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": states, "param_groups": groups})
    return int(tensors["n"])


def append_log(out: Path, line: Mapping[str, Any]) -> None:
    """Append one line to log.jsonl."""
    with appending(out / "log.jsonl", root=out) as file:
        file.write(f"{json.dumps(line)}\n".encode())


def cut_log(out: Path, n: int) -> None:
    """Drop the lines about batches after the first n: they will be written again."""
    file = out / "log.jsonl"
    if not file.exists():
        return
    kept = [x for x in read_log(out) if x["batch"] <= n]
    replace_file(file, "".join(f"{json.dumps(x)}\n" for x in kept).encode())


def read_log(out: Path) -> list[dict[str, float]]:
    """Return the lines of log.jsonl, without one that a process was writing when it died."""
    file = out / "log.jsonl"
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    found = []
    for line in lines:
        with contextlib.suppress(ValueError):
            found.append(json.loads(line))
    return found


def _named(tensors: Weights, prefix: str) -> Weights:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
