from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from tipl.distributed import Ranks
from tipl.errors import TrainError
from tipl.models.gpt import GPT, GPTConfig
from tipl.step import StepConfig, Stepper
from tipl.tokens import TokenRun, TokenSampler

SIZES = GPTConfig(rank=3, max_timestep=29, block_size=5, n_layer=2, n_head=2, n_embd=16)
CONFIG = StepConfig(batch_size=8, warmup=3, learning_rate=1e-2)


def stepper(config: StepConfig = CONFIG, ranks: Ranks | None = None) -> Stepper:
    rng = np.random.default_rng(0)
    runs = [
        TokenRun(
            coefficients=rng.normal(size=(30, 3)).astype(np.float32),
            weights=np.array([3, 2, 1], np.float32),
        )
        for _ in range(2)
    ]
    sampler = TokenSampler(runs, window=5, batch_size=config.batch_size, seed=config.seed)
    torch.manual_seed(0)
    return Stepper(GPT(SIZES), sampler, config, ranks or Ranks())


def gradient(s: Stepper, n: int) -> torch.Tensor:
    s._differentiate(n)
    return s._sums.clone()


@pytest.mark.parametrize("world", [2, 3, 8])
def test_the_shares_of_ranks_add_up_to_the_batch(world: int) -> None:
    # Batch 0 has padding, so shares weigh differently.
    assert not stepper()._sampler.batch(0).mask.all()
    whole = gradient(stepper(), 0)
    shares = [gradient(stepper(ranks=Ranks(rank=r, world=world)), 0) for r in range(world)]
    torch.testing.assert_close(sum(shares), whole, rtol=1e-4, atol=1e-6)


def test_more_ranks_than_windows_are_refused() -> None:
    with pytest.raises(TrainError, match="at most 8 ranks"):
        stepper(ranks=Ranks(rank=0, world=9))


def test_a_step_is_that_of_torch() -> None:
    """Clipping and AdamW as torch's own, on a gradient that is clipped."""
    ours, theirs = stepper(), stepper()
    optimizer = torch.optim.AdamW(theirs.model.parameters(), weight_decay=1e-4)
    for n in range(5):
        ours.step(n)
        theirs._differentiate(n)
        optimizer.param_groups[0]["lr"] = 1e-2 * min(1, (n + 1) / 3)
        norm = torch.nn.utils.clip_grad_norm_(theirs.model.parameters(), 0.25)
        assert norm > 0.25
        optimizer.step()
    expected = theirs.model.state_dict()
    for name, tensor in ours.model.state_dict().items():
        if "qkv.bias" not in name:  # no gradient reaches that of the keys, but for rounding
            torch.testing.assert_close(tensor, expected[name], rtol=1e-4, atol=1e-5)


def test_dropout_is_drawn_in_training() -> None:
    still = stepper()
    still.model.config = replace(SIZES, dropout=0.0)
    assert not torch.equal(gradient(still, 0), gradient(stepper(), 0))


def test_bfloat16_is_near_float32() -> None:
    exact, rough = stepper(), stepper(replace(CONFIG, dtype="bfloat16"))
    rough.try_out()
    for n in range(3):
        assert rough.step(n) == pytest.approx(exact.step(n), rel=0.05)
    assert {p.dtype for p in rough.model.parameters()} == {torch.float32}


def test_a_precision_that_the_device_lacks_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def autocast(*_: object, **__: object) -> None:
        raise RuntimeError("no bfloat16 here")

    monkeypatch.setattr(torch, "autocast", autocast)
    with pytest.raises(TrainError, match=r"no bfloat16 here(.|\n)*--dtype float32"):
        stepper(replace(CONFIG, dtype="bfloat16")).try_out()


COMPILE = """
from dataclasses import replace
from tests.tipl import test_step  # types are not checked in this process
from tests.tipl.test_step import CONFIG, SIZES, stepper
test_step.SIZES = replace(SIZES, n_layer=1, n_head=1)
compiled, plain = stepper(replace(CONFIG, compile=True)), stepper()
compiled.try_out()
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


def test_compiled_it_is_the_same() -> None:
    done = compile_here()
    if "cannot be compiled here" in done.stderr:
        pytest.skip("no C++ compiler")
    assert done.stdout.strip() == "equal", done.stderr


def test_a_missing_compiler_is_told() -> None:
    done = compile_here(CXX="no-such-compiler")
    assert "TrainError: the network cannot be compiled here" in done.stderr
    assert "install what is missing" in done.stderr
