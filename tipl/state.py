"""The folder of a training: its settings, its log, and a state from which it goes on."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from tipl.errors import TrainError
from weighttraj.atomic import replace_file


def keep_settings(
    out: Path, settings: dict[str, Any], may_differ: Collection[str], config: object = None
) -> None:
    """Keep the settings beside the model, and refuse to go on with others.

    Args:
        out: folder of the model; made if it is not there.
        settings: what JSON can hold.
        may_differ: settings that can change from one start to the next.
        config: the dataclass that they come from. A training that began before one of its settings
            existed did what the default now does.

    Raises:
        TrainError: the folder holds a training with other settings.
    """
    file, settings = out / "train.json", json.loads(json.dumps(settings))
    if file.exists():
        known = {k: getattr(type(config), k, None) for k in settings}
        old = json.loads(json.dumps(known, default=str)) | json.loads(
            file.read_text(encoding="utf-8")
        )
        other = {k: v for k, v in settings.items() if old[k] != v and k not in may_differ}
        if other:
            raise TrainError(
                "the folder holds a training with other settings or data",
                expected={k: old[k] for k in other},
                got=other,
                where=out,
                do="choose another --out, or delete the folder",
            )
    out.mkdir(parents=True, exist_ok=True)
    replace_file(file, json.dumps(settings, indent=1).encode())


def save_state(out: Path, model: nn.Module, optimizer: torch.optim.Optimizer, n: int) -> None:
    """Everything that a later process needs to go on, in one file, replaced atomically."""
    tensors = {f"model.{name}": t for name, t in model.state_dict().items()}
    for i, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{i}.{name}": t for name, t in state.items()}
    tensors["n"] = torch.tensor(n)
    replace_file(out / "state.safetensors", save(tensors))


def read_state(out: Path) -> dict[str, Tensor]:
    """What ``save_state`` kept; empty before that.

    Raises:
        TrainError: the file is damaged.
    """
    file = out / "state.safetensors"
    if not file.exists():
        return {}
    try:
        return load_file(file)
    except SafetensorError as error:
        raise TrainError(
            "the saved state is damaged",
            expected="the file as it was written",
            got=error,
            where=file,
            do="restore it from a copy, or delete the folder to begin anew",
        ) from error


def restore(tensors: dict[str, Tensor], model: nn.Module, optimizer: torch.optim.Optimizer) -> int:
    """Put a state into the model and the optimizer; returns the batches done so far."""
    if not tensors:
        return 0
    named = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
    model.load_state_dict(named, strict=True)
    states: dict[int, dict[str, Tensor]] = {}
    for key, tensor in tensors.items():
        if key.startswith("optimizer."):
            _, i, name = key.split(".", 2)
            states.setdefault(int(i), {})[name] = tensor
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": states, "param_groups": groups})
    return int(tensors["n"])


def append_log(out: Path, line: dict[str, Any]) -> None:
    """One more line of log.jsonl."""
    with (out / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def cut_log(out: Path, n: int) -> None:
    """Drop what is logged of batches after the first n: it will be logged again."""
    file = out / "log.jsonl"
    if not file.exists():
        return
    kept = [x for x in read_log(out) if x["batch"] <= n]
    replace_file(file, "".join(f"{json.dumps(x)}\n" for x in kept).encode())


def read_log(out: Path) -> list[dict[str, float]]:
    """The lines of log.jsonl; without one that a process was writing when it died."""
    file = out / "log.jsonl"
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    found = []
    for line in lines:
        with contextlib.suppress(ValueError):
            found.append(json.loads(line))
    return found
