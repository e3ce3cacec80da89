"""The training loop, on the Transformer of TIPL and random coefficients."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file, save_file
from torch import Tensor

from tipl.errors import TrainError
from tipl.models.tipl.data import TokenRun, TokenSampler, Windows
from tipl.models.tipl.network import GPT, GPTConfig
from tipl.models.tipl.train import weight_prediction_error
from tipl.training import Learner, LoopConfig, train_network
from tipl.training.checkpoint import read_log, read_state
from tipl.training.loop import _Loop
from tipl.training.parallel import Ranks

SIZES = GPTConfig(rank=3, max_timestep=29, block_size=5, n_layer=2, n_head=2, n_embd=16)
CONFIG = LoopConfig(
    n_batches=6, batch_size=8, warmup=3, learning_rate=1e-2, schedule="constant", grad_clip=0.25,
    save_every=2, keep="last",
)  # fmt: skip


def runs(seed: int) -> list[TokenRun]:
    rng = np.random.default_rng(seed)
    return [
        TokenRun(
            coefficients=rng.normal(size=(30, 3)).astype(np.float32),
            weights=np.array([3, 2, 1], np.float32),
        )
        for _ in range(2)
    ]


class Small(Learner[Windows]):
    """Windows of random coefficients; other runs for validation."""

    measure = "wpe"

    def __init__(self, config: LoopConfig, sizes: GPTConfig = SIZES) -> None:
        torch.manual_seed(0)
        self.network: GPT = GPT(sizes)
        self._sampler, self._held_out = (
            TokenSampler(runs(seed), window=5, batch_size=config.batch_size, seed=config.seed)
            for seed in (0, 1)
        )

    def batch(self, n: int) -> Windows:
        return self._sampler.batch(n)

    def loss(self, network: Callable[..., Tensor], batch: Windows) -> tuple[Tensor, Tensor]:
        predicted = network(batch.tokens, batch.timesteps, batch.mask).float()
        return weight_prediction_error(predicted, batch), batch.mask.sum()

    def validation(self) -> list[Windows]:
        return self._held_out.tiles(100)

    def save(self, out: Path) -> None:
        save_file(self.network.state_dict(), out / "model.safetensors")


def loop(config: LoopConfig = CONFIG, ranks: Ranks | None = None, dropout: float = 0.0) -> Any:
    learner = Small(config, replace(SIZES, dropout=dropout))
    made = _Loop(learner, config, Path("nowhere"), ranks or Ranks(), Console(quiet=True))
    made._network = learner.network.train()
    return made


def gradient(made: Any, n: int) -> Tensor:
    made._differentiate(n)
    return torch.cat([p.grad.ravel() for p in made._learner.network.parameters()])


def trained(out: Path, config: LoopConfig = CONFIG) -> dict[str, Tensor]:
    train_network(lambda *_: Small(config), config, out)
    return load_file(out / "model.safetensors")


def test_more_ranks_than_examples_are_refused() -> None:
    with pytest.raises(TrainError, match="at most 8 ranks"):
        loop(ranks=Ranks(rank=0, world=9))


def test_a_step_is_that_of_torch() -> None:
    """Clipping and AdamW as torch's own, on a gradient that is clipped."""
    ours, theirs = loop(), loop()
    network = theirs._learner.network
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-3)
    for n in range(5):
        ours.step(n)
        batch = theirs._learner.batch(n)
        error, count = theirs._learner.loss(network, batch)
        optimizer.zero_grad()
        (error / count).backward()
        optimizer.param_groups[0]["lr"] = 1e-2 * min(1, (n + 1) / 3)
        norm = torch.nn.utils.clip_grad_norm_(network.parameters(), 0.25)
        assert norm > 0.25
        optimizer.step()
    expected = network.state_dict()
    for name, tensor in ours._learner.network.state_dict().items():
        if "qkv.bias" not in name:  # no gradient reaches that of the keys, but for rounding
            torch.testing.assert_close(tensor, expected[name], rtol=1e-4, atol=1e-5)


def test_dropout_is_a_function_of_seed_and_batch() -> None:
    assert not torch.equal(gradient(loop(), 0), gradient(loop(dropout=0.5), 0))
    first, again = loop(dropout=0.5), loop(dropout=0.5)
    gradient(first, 3)
    assert torch.equal(gradient(first, 5), gradient(again, 5))
    other = loop(replace(CONFIG, seed=1), dropout=0.5)
    assert not torch.equal(gradient(other, 5), gradient(again, 5))


def test_the_learning_rate_rises_and_falls() -> None:
    config = replace(CONFIG, n_batches=10, warmup=2, learning_rate=1.0)
    rates = {
        name: [replace(config, schedule=name).learning_rate_at(n) for n in (0, 1, 5, 9)]  # type: ignore[arg-type]
        for name in ("constant", "linear", "cosine")
    }
    assert rates["constant"] == [0.5, 1, 1, 1]
    assert rates["linear"] == pytest.approx([0.5, 0.9, 0.5, 0.1])
    assert rates["cosine"] == pytest.approx([0.5, 0.97553, 0.5, 0.02447], abs=1e-5)
    assert replace(config, warmup=None, n_batches=100).learning_rate_at(0) == 0.1


@pytest.mark.parametrize("ema", [0.0, 0.5])
def test_an_interrupted_training_ends_as_an_undisturbed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ema: float
) -> None:
    config = replace(CONFIG, ema=ema)
    whole = trained(tmp_path / "whole", config)
    step = _Loop.step

    def stopped(self: Any, n: int) -> float:
        if n == 5:
            raise KeyboardInterrupt
        return step(self, n)

    with monkeypatch.context() as patch:
        patch.setattr(_Loop, "step", stopped)
        with pytest.raises(KeyboardInterrupt):
            trained(tmp_path / "broken", config)
    again = trained(tmp_path / "broken", config)
    assert all(torch.equal(whole[name], again[name]) for name in whole)


def test_the_average_of_the_weights_is_what_is_saved(tmp_path: Path) -> None:
    config = replace(CONFIG, ema=0.5, n_batches=3, save_every=1)
    made = Small(config)
    means = {name: p.detach().clone() for name, p in made.network.named_parameters()}
    for n in range(1, 4):
        trained(tmp_path, replace(config, n_batches=n))
        now = read_state(tmp_path)
        for name, mean in means.items():
            mean.lerp_(now[f"model.{name}"], 0.5)
    saved = trained(tmp_path, config)
    for name, mean in means.items():
        torch.testing.assert_close(saved[name], mean)
        torch.testing.assert_close(now[f"average.{name}"], mean)
    assert not torch.equal(saved["head.weight"], now["model.head.weight"])


def test_the_best_state_on_validation_runs_is_kept(tmp_path: Path) -> None:
    trained(tmp_path, replace(CONFIG, keep="best", learning_rate=1.0))
    errors = [line["validation_wpe"] for line in read_log(tmp_path)]
    network = Small(CONFIG)
    network.network.load_state_dict(load_file(tmp_path / "model.safetensors"))
    network.network.eval()
    with torch.no_grad():
        parts = [network.loss(network.network, part) for part in network.validation()]
    error = sum(error for error, _ in parts) / sum(count for _, count in parts)
    assert float(error) == pytest.approx(min(errors), rel=1e-5)
    assert errors.index(min(errors)) < len(errors) - 1


def test_a_decay_of_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrainError, match="ema below 1"):
        trained(tmp_path / "model", replace(CONFIG, ema=1.0))
    assert not (tmp_path / "model").exists()


def test_bfloat16_is_near_float32() -> None:
    exact, rough = loop(), loop(replace(CONFIG, dtype="bfloat16"))
    rough._try_out()
    for n in range(3):
        assert rough.step(n) == pytest.approx(exact.step(n), rel=0.05)
    assert {p.dtype for p in rough._learner.network.parameters()} == {torch.float32}


def test_a_precision_that_the_device_lacks_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def autocast(*_: object, **__: object) -> None:
        raise RuntimeError("no bfloat16 here")

    monkeypatch.setattr(torch, "autocast", autocast)
    with pytest.raises(TrainError, match=r"no bfloat16 here(.|\n)*--dtype float32"):
        loop(replace(CONFIG, dtype="bfloat16"))._try_out()


COMPILE = """
from dataclasses import replace
from tests.tipl import test_loop  # types are not checked in this process
from tests.tipl.test_loop import CONFIG, SIZES, loop
test_loop.SIZES = replace(SIZES, n_layer=1, n_head=1)
compiled, plain = loop(replace(CONFIG, compile=True)), loop()
compiled._network = compiled._wrapped()
compiled._try_out()
for n in range(3):
    a, b = compiled.step(n), plain.step(n)
    assert abs(a - b) < 1e-4 * b, (a, b)
print("equal")
"""


def compile_here(**env: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMPILE],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **env},
    )


@pytest.mark.long
def test_compiled_it_is_the_same() -> None:
    done = compile_here()
    if "cannot be compiled here" in done.stderr:
        pytest.skip("no C++ compiler")
    assert done.stdout.strip() == "equal", done.stderr


def test_a_missing_compiler_is_told() -> None:
    done = compile_here(CXX="no-such-compiler")
    assert "TrainError: the network cannot be compiled here" in done.stderr
    assert "install what is missing" in done.stderr
