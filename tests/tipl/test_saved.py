"""Models that a stranger made: refused before anything of their sizes is allocated."""

from __future__ import annotations

import json
import os
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file
from safetensors.torch import save_file as save_tensors

import tipl
from tests.tipl.lively import lively_causal, lively_gate
from tipl.errors import ModelError
from tipl.models.baselines import WNN, Ema, Extrapolation
from tipl.models.baselines.nowcaster import NowcasterConfig
from tipl.models.stretched import StretchedGate
from tipl.models.tipl import GPT, TIPL, GPTConfig, TIPLConfig
from tipl.registry import load
from tipl.saved import read_arrays

GPT_SIZES = GPTConfig(rank=3, max_timestep=9, block_size=4, n_layer=1, n_embd=8)
NOWCASTER = NowcasterConfig(horizons=(1, 5))
MAKERS: dict[str, Callable[[], tipl.Forecaster]] = {
    "tipl": lambda: TIPL(GPT(GPT_SIZES), TIPLConfig(gpt=GPT_SIZES, every=2)),
    "gate": lively_gate,
    "causal": lively_causal,
    "stretched": lambda: StretchedGate(lively_gate(), {1: 2.0, 2: 1.0, 5: 1.0}),
    "wnn": lambda: WNN(WNN.build(NOWCASTER), NOWCASTER),
}


def changed(folder: Path, path: tuple[str, ...], value: object) -> None:
    """Write another value into config.json."""
    file = folder / "config.json"
    document = json.loads(file.read_text())
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    assert path[-1] in inner
    inner[path[-1]] = value
    file.write_text(json.dumps(document))


@pytest.mark.parametrize("value", [2**70, 2**40, 10**9, -1, 0])
@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("tipl", ("gpt", "n_embd")),
        ("tipl", ("gpt", "n_layer")),
        ("tipl", ("gpt", "max_timestep")),
        ("tipl", ("gpt", "n_head")),
        ("gate", ("network", "lags")),
        ("gate", ("network", "width")),
        ("gate", ("network", "experts")),
        ("causal", ("network", "rank")),
        ("causal", ("network", "n_layer")),
        ("stretched", ("network", "phases")),
        ("wnn", ("width",)),
        ("wnn", ("context",)),
    ],
)
def test_absurd_sizes_are_refused_in_little_memory(
    name: str, path: tuple[str, ...], value: int, tmp_path: Path
) -> None:
    MAKERS[name]().save(tmp_path)
    load(tmp_path)  # what is imported for it counts for nothing
    changed(tmp_path, path, value)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ModelError, match="cannot be loaded"):
        load(tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_parameters_that_are_not_finite_are_refused(
    name: str, value: float, tmp_path: Path
) -> None:
    MAKERS[name]().save(tmp_path)
    assert load(tmp_path).name == tmp_path.name
    file = tmp_path / "model.safetensors"
    save_file({key: np.full_like(array, value) for key, array in load_file(file).items()}, file)
    with pytest.raises(ModelError, match="not finite"):
        load(tmp_path)


def test_a_config_of_many_bytes_is_not_read(tmp_path: Path) -> None:
    lively_gate().save(tmp_path)
    with (tmp_path / "config.json").open("a") as file:
        file.write(" " * 2**21)
    with pytest.raises(ModelError, match="2,097,"):
        load(tmp_path)


def test_deep_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("[" * 100_000)
    with pytest.raises(ModelError, match="no forecaster"):
        load(tmp_path)


@pytest.mark.parametrize(
    "velocity",
    [
        {"kind": "steps", "lags": 2**60},
        {"kind": "ema", "beta": 1.0},
        {"kind": "ema", "beta": -3.0},
        {"kind": "projected-steps"},
    ],
)
def test_a_velocity_that_is_none_is_refused(velocity: dict[str, object], tmp_path: Path) -> None:
    Extrapolation(Ema(0.9)).save(tmp_path)
    changed(tmp_path, ("velocity",), velocity)
    with pytest.raises(ModelError, match="cannot be loaded"):
        load(tmp_path)


def test_loading_moves_no_random_number(tmp_path: Path) -> None:
    lively_gate().save(tmp_path)
    before = torch.get_rng_state()
    load(tmp_path)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_file_is_neither_waited_for_nor_read(
    name: str, kind: str, tmp_path: Path
) -> None:
    lively_gate().save(tmp_path)
    (tmp_path / name).unlink()
    if kind == "pipe":
        os.mkfifo(tmp_path / name)
    elif kind == "folder":
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(ModelError, match=f"{name} .*is no plain file"):
        lively_gate().load(tmp_path)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float8_e5m2])
def test_arrays_of_types_that_numpy_lacks_are_refused(dtype: torch.dtype, tmp_path: Path) -> None:
    save_file({"a": np.zeros(3, np.float32)}, tmp_path / "model.safetensors")
    assert read_arrays(tmp_path, {"a": (3,)})["a"].tolist() == [0, 0, 0]
    save_tensors({"a": torch.zeros(3).to(dtype)}, tmp_path / "model.safetensors")
    with pytest.raises(ModelError):
        read_arrays(tmp_path, {"a": (3,)})
