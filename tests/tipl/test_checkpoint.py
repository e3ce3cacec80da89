from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest
import torch
from torch import nn

from tipl.errors import TrainError
from tipl.training.checkpoint import (
    append_log,
    cut_log,
    keep_settings,
    read_state,
    restore,
    save_state,
)


def trained(steps: int) -> tuple[nn.Module, torch.optim.Optimizer]:
    torch.manual_seed(0)
    model = nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(model.parameters(), fused=True)
    for _ in range(steps):
        model(torch.ones(1, 3)).sum().backward()
        optimizer.step()
    return model, optimizer


def test_a_state_comes_back(tmp_path: Path) -> None:
    assert restore(read_state(tmp_path), *trained(0)) == 0
    save_state(tmp_path, *trained(4), 4)
    model, optimizer = trained(0)
    assert restore(read_state(tmp_path), model, optimizer) == 4
    expected_model, expected = trained(4)
    for name, tensor in expected_model.state_dict().items():
        assert torch.equal(model.state_dict()[name], tensor)
    for i, state in expected.state_dict()["state"].items():
        for name, tensor in state.items():
            assert torch.equal(optimizer.state_dict()["state"][i][name], tensor)
    assert [p.name for p in tmp_path.iterdir()] == ["state.safetensors"]


def test_a_damaged_state_is_refused(tmp_path: Path) -> None:
    save_state(tmp_path, *trained(1), 1)
    file = tmp_path / "state.safetensors"
    file.write_bytes(file.read_bytes()[:40])
    with pytest.raises(TrainError, match="the checkpoint is damaged"):
        read_state(tmp_path)


def test_settings_are_kept_and_others_refused(tmp_path: Path) -> None:
    out = tmp_path / "model"
    keep_settings(out, {"rank": 3, "device": "cpu"}, ("device",))
    keep_settings(out, {"rank": 3, "device": "cuda"}, ("device",))
    assert json.loads((out / "train.json").read_text()) == {"rank": 3, "device": "cuda"}
    with pytest.raises(TrainError, match=r"expected: {'rank': 3}\n  got: {'rank': 4}"):
        keep_settings(out, {"rank": 4, "device": "cpu"}, ("device",))


def test_a_setting_that_came_later_is_what_it_is_by_default(tmp_path: Path) -> None:
    @dataclass
    class Settings:
        rank: int
        sees: tuple[str, ...] = ()

    keep_settings(tmp_path, {"rank": 3}, ())
    keep_settings(tmp_path, asdict(Settings(3)), (), asdict(Settings(0)))
    (tmp_path / "train.json").write_text('{"rank": 3}')
    with pytest.raises(TrainError, match=r"expected: {'sees': \[\]}\n  got: {'sees': \['all'\]}"):
        keep_settings(tmp_path, asdict(Settings(3, ("all",))), (), asdict(Settings(0)))


def test_the_log_is_cut_to_what_was_saved(tmp_path: Path) -> None:
    cut_log(tmp_path, 0)
    assert not list(tmp_path.iterdir())
    for n in (10, 20, 30):
        append_log(tmp_path, {"batch": n, "wpe": 1 / n})
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"batch": 4')
    cut_log(tmp_path, 20)
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["batch"] for line in lines] == [10, 20]
