"""What a trainer may hand over as a snapshot: stored exactly, or refused by name."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import weighttraj as wt
from weighttraj.errors import SnapshotError
from weighttraj.format import ObsNorm, ParamLayout, RunInfo
from weighttraj.writer import RunWriter

LAYOUT = ParamLayout.of({"w": ((2, 2), "weight", ("fixed", "fixed"))})
VALUES = np.array([0.5, -1.25, 3.0, 2.0**-10], np.float32)  # bfloat16 and float16 hold them exactly


def writer_at(path: Path, **settings: Any) -> RunWriter:
    return RunWriter(path / "r.zarr", RunInfo(run_id="r", layout=LAYOUT, **settings))


@pytest.mark.parametrize(
    "make",
    [
        lambda: torch.nn.Parameter(torch.tensor(VALUES)),
        lambda: torch.tensor(VALUES).requires_grad_() * 1,
        lambda: torch.tensor(VALUES, dtype=torch.bfloat16),
        lambda: torch.tensor(VALUES, dtype=torch.bfloat16, requires_grad=True),
        lambda: torch.tensor(VALUES, dtype=torch.float16),
        lambda: torch.tensor(VALUES, dtype=torch.float64),
        lambda: torch.tensor(-1j * VALUES).imag.neg(),  # a tensor with its negative bit set
        lambda: torch.tensor(VALUES).repeat_interleave(2)[::2],
        lambda: VALUES.astype(np.float16),
        lambda: VALUES.astype(">f8"),
        lambda: VALUES.tolist(),
    ],
)
def test_real_arrays_and_tensors_are_stored_exactly(make: Any, tmp_path: Path) -> None:
    with writer_at(tmp_path) as writer:
        writer.append(make(), num_timesteps=1)
        value = make() if hasattr(make(), "reshape") else np.array(make())
        writer.append(LAYOUT.flatten({"w": value.reshape(2, 2)}), num_timesteps=2)
    run = wt.open_run(tmp_path / "r.zarr")
    assert np.array_equal(run.weights[:], np.stack([VALUES, VALUES]))
    assert wt.verify(run.path) == []


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (VALUES + 1j, "real numbers"),
        (torch.tensor(VALUES) + 1j, "real numbers"),
        (VALUES.astype(object), "real numbers"),
        (np.array([Fraction(1, 3)] * 4), "real numbers"),
        (["1", "2", "3", "4"], "real numbers"),
        (np.array(["2026-01-01"] * 4, "M8[D]"), "real numbers"),
        (np.ma.masked_array(VALUES, [0, 1, 0, 0]), "real numbers"),
        ([1.0, [2.0, 3.0], 4.0], "cannot be read as an array"),
        (torch.zeros(4, device="meta"), "cannot be read as an array"),
        (np.array([1e300, 0, 0, 0]), "too large for float32"),
        (np.array([np.inf, 0, 0, 0]), "not finite"),
        (torch.tensor([torch.nan, 0, 0, 0], dtype=torch.bfloat16), "not finite"),
        (VALUES.reshape(2, 2), r"expected: \(4,\)\n  got: \(2, 2\)"),
        (VALUES[:3], r"expected: \(4,\)\n  got: \(3,\)"),
        (1.0, r"expected: \(4,\)\n  got: \(\)"),
    ],
)
def test_other_weights_are_refused_by_name(weights: Any, message: str, tmp_path: Path) -> None:
    with writer_at(tmp_path) as writer:
        with pytest.raises(SnapshotError, match=f"(?s){message}.*policy/weights"):
            writer.append(weights, num_timesteps=1)
        writer.append(VALUES, num_timesteps=1)
    assert len(wt.open_run(tmp_path / "r.zarr")) == 1


@pytest.mark.parametrize(
    ("counter", "stored"), [(3, 3), (3.0, 3), (np.int32(3), 3), (torch.tensor(3), 3)]
)
def test_whole_numbers_are_counters(counter: Any, stored: int, tmp_path: Path) -> None:
    with writer_at(tmp_path) as writer:
        writer.append(VALUES, num_timesteps=counter)
    assert wt.open_run(tmp_path / "r.zarr").num_timesteps.tolist() == [stored]


@pytest.mark.parametrize("counter", [1.5, float("nan"), float("inf"), 2.0**63, 2**64, -2, 1j, "1"])
def test_other_counters_are_refused(counter: Any, tmp_path: Path) -> None:
    writer = writer_at(tmp_path)
    for name in ("num_timesteps", "gradient_step", "iteration", "epoch", "phase"):
        values = {"num_timesteps": 1, name: counter}
        with pytest.raises(SnapshotError, match=f"index/{name}"):
            writer.append(VALUES, **values)
    writer.close()


def test_other_values_are_refused_by_name(tmp_path: Path) -> None:
    norm = ObsNorm(source="ours", epsilon=1e-8, shape=(2,))
    writer = writer_at(tmp_path, obs_norm=norm, diagnostics=("loss",), optimizer_moments=True)
    good: dict[str, Any] = {
        "num_timesteps": 0,
        "obs_norm": (torch.zeros(2, requires_grad=True), [1, 1], 3),
        "moments": (torch.zeros(4), np.zeros(4)),
        "train": {"loss": torch.tensor(0.5, requires_grad=True)},
    }
    writer.append(VALUES, **good)
    for change, message in (
        ({"obs_norm": (np.zeros(2), np.full(2, np.nan), 3)}, "obs_norm/var"),
        ({"obs_norm": (np.zeros(2), np.ones(2))}, "tuple of 3: obs_norm/mean"),
        ({"moments": (np.zeros(4),)}, "tuple of 2: optimizer/exp_avg"),
        ({"moments": (np.zeros(4), np.zeros(3))}, "optimizer/exp_avg_sq"),
        ({"train": {"loss": "0.5"}}, "train/loss"),
        ({"train": {"loss": 1j}}, "train/loss"),
        ({"learning_rate": "1e-3"}, "index/learning_rate"),
    ):
        with pytest.raises(SnapshotError, match=message):
            writer.append(VALUES, **(good | change))
    writer.close()
    run = wt.open_run(tmp_path / "r.zarr")
    assert run["train/loss"][:].tolist() == [0.5]


@pytest.mark.parametrize(
    ("tensor", "message"),
    [
        (np.zeros((2, 2), complex), "real numbers"),
        (np.zeros((2, 2), object), "real numbers"),
        ([[0.0, 1.0], [2.0]], "cannot be read as an array"),
        (torch.full((2, 2), 1e39, dtype=torch.float64), "too large for float32"),
        (torch.zeros(4), r"expected: \(2, 2\)\n  got: \(4,\)"),
    ],
)
def test_flatten_refuses_other_tensors_by_name(tensor: Any, message: str) -> None:
    with pytest.raises(SnapshotError, match=f"(?s){message}.*parameter 'w'"):
        LAYOUT.flatten({"w": tensor})
