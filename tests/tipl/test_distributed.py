"""Two processes that train one model, started by `torchrun`'s module as a user would."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from tipl import TrainConfig, change, train
from tipl.training.config import flat
from tipl.training.parallel import Ranks, device_here, launched, open_ranks, rank_here

N_BATCHES, SAVED, KILLED = 40, 20, 27


def config(data: Path, out: Path) -> TrainConfig:
    return change(
        TrainConfig(data=data, out=out),
        rank=8,
        n_batches=N_BATCHES,
        batch_size=9,  # no equal shares
        warmup=3,
        block_size=5,
        n_layer=1,
        n_embd=16,
        save_every=10,
        dropout=0.0,  # each process draws dropout for its own windows
    )


def torchrun(data: Path, out: Path, *program: str) -> subprocess.CompletedProcess[str]:
    settings = flat(config(data, out))
    names = ("data", "out", "rank", "n_batches", "batch_size", "warmup", "block_size", "n_layer")
    options: list[str] = []
    for name in (*names, "n_embd", "save_every", "dropout"):
        options += [f"--{name.replace('_', '-')}", str(settings[name])]
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    return subprocess.run(
        [sys.executable, "-W", "ignore", *launcher, *program, "train", "tipl", *options],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"},
    )


def assert_near(one: Path, two: Path) -> None:
    """The same but for rounding."""
    expected = load_file(two / "model.safetensors")
    for name, tensor in load_file(one / "model.safetensors").items():
        if "qkv.bias" not in name:  # no gradient reaches that of the keys, but for rounding
            torch.testing.assert_close(tensor, expected[name], rtol=1e-3, atol=1e-5, msg=name)


def batches(out: Path) -> list[int]:
    return [json.loads(line)["batch"] for line in (out / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def alone(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The training in one process."""
    out = tmp_path_factory.mktemp("alone")
    train(config(small_dataset, out))
    return out


ENDING = """
import pathlib
from tipl import cli

cli.main()
print(*(task.read_text() for task in pathlib.Path("/proc/self/task").glob("*/comm")))
"""


@pytest.fixture(scope="module")
def together(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The training in two processes that nothing disturbs."""
    out = tmp_path_factory.mktemp("together")
    program = out.with_suffix(".py")
    program.write_text(ENDING)
    done = torchrun(small_dataset, out, str(program))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(f"model in {out}") == 1
    assert "gloo" not in done.stdout, "threads that outlive their group abort a process at its end"
    return out


def test_two_ranks_train_the_model_of_one(alone: Path, together: Path) -> None:
    assert_near(together, alone)
    assert batches(together) == batches(alone) == [10, 20, 30, 40]
    for a, b in zip(
        (together / "log.jsonl").read_text().splitlines(),
        (alone / "log.jsonl").read_text().splitlines(),
        strict=True,
    ):
        assert json.loads(a)["wpe"] == pytest.approx(json.loads(b)["wpe"], rel=1e-4)


DYING = f"""
import os, signal
from tipl import cli
from tipl.training.loop import _Loop

step = _Loop.step

def dying(self, n):
    if n == {KILLED} and os.environ["RANK"] == "1":
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self, n)

_Loop.step = dying
cli.main()
"""


def test_a_killed_rank_ends_the_others_and_the_same_command_goes_on(
    small_dataset: Path, alone: Path, together: Path, tmp_path: Path
) -> None:
    (tmp_path / "dying.py").write_text(DYING)
    out = tmp_path / "model"
    done = torchrun(small_dataset, out, str(tmp_path / "dying.py"))
    assert done.returncode != 0
    # Whichever comes first: the broken connection, or SIGTERM from `torchrun`.
    said = " ".join((done.stdout + done.stderr).split())
    assert "give the same command again to go on" in said, done
    assert batches(out) == [10, 20]
    assert int(load_file(out / "state.safetensors")["n"]) == SAVED
    shutil.copytree(out, tmp_path / "copy")

    done = torchrun(small_dataset, out, "-m", "tipl")
    assert done.returncode == 0, done.stderr
    whole = load_file(together / "model.safetensors")
    for name, tensor in load_file(out / "model.safetensors").items():
        assert torch.equal(tensor, whole[name]), name
    assert batches(out) == [10, 20, 30, 40]

    # One process goes on with what two began.
    train(config(small_dataset, tmp_path / "copy"))
    assert_near(tmp_path / "copy", alone)


def test_without_torchrun_there_is_one_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RANK", "3")  # a scheduler's, say
    monkeypatch.setenv("WORLD_SIZE", "8")
    assert (launched(), rank_here(), device_here("cuda")) == (False, 0, "cuda")
    with open_ranks("cpu") as ranks:
        assert ranks == Ranks(rank=0, world=1)
        assert ranks.from_first(lambda: 7) == 7
        assert ranks.sum(torch.tensor(3.0)).item() == 3


@pytest.mark.parametrize("world", [1, 2, 5, 9])
def test_shares_make_up_the_batch(world: int) -> None:
    shares = [range(9)[Ranks(rank=r, world=world).share(9)] for r in range(world)]
    assert [i for share in shares for i in share] == list(range(9))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
