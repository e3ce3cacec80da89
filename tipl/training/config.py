"""How a network is trained: the settings that every model of ours shares."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from tipl.errors import TrainError
from tipl.settings import check_settings

C = TypeVar("C", bound=Any)

MAY_DIFFER = ("out", "data", "device", "compile", "threads")
"""Settings that may always change when a training goes on: they move roundings at most."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Settings of the training loop."""

    n_batches: int
    """Number of batches in the whole training."""
    batch_size: int
    """Number of examples in a batch, over all processes."""
    learning_rate: float
    """Highest learning rate of AdamW."""
    warmup: int | None = None
    """Number of batches over which the learning rate rises linearly; unset: a tenth of all."""
    schedule: Literal["constant", "linear", "cosine"] = "cosine"
    """Learning-rate schedule after the warm-up: constant, or falling to 0."""
    weight_decay: float = 1e-3
    """Weight decay of AdamW, on all parameters."""
    grad_clip: float = 1.0
    """Largest norm of the gradient; a longer one is scaled down."""
    ema: float = 0.0
    """Decay of an exponential moving average of the weights, which is then validated and saved in
    place of the last weights; 0: no average."""
    keep: Literal["last", "best"] = "best"
    """Which state becomes the model: the last, or the one with the smallest validation error. The
    state before training is a candidate."""
    save_every: int = 200
    """Number of batches from one checkpoint, validation and line of the log to the next."""
    seed: int = 0
    """Seed of the initialisation, the batches and dropout."""
    device: str = "cpu"
    """Torch device. ``cuda`` under `torchrun`: one GPU for each process."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of products: bfloat16 by autocast; the parameters stay float32."""
    compile: bool = False
    """Whether to compile the network with torch.compile: needs a C++ compiler, and Triton for
    cuda."""
    threads: int = 1
    """Number of CPU threads of each process. More threads help only on idle cores."""

    def check(self) -> None:
        """Refuse numbers that make no training.

        Raises:
            TrainError: a number is too small or too large.
        """
        from_1 = ("n_batches", "batch_size", "save_every", "threads")
        from_0 = ("learning_rate", "weight_decay", "grad_clip", "ema", "seed")
        least = dict.fromkeys(from_1, 1) | dict.fromkeys(from_0, 0)
        check_settings(vars(self) | {"warmup": self.warmup or 0}, least | {"warmup": 0}, TrainError)
        if self.ema >= 1:
            raise TrainError(
                "an average with this decay never moves",
                expected="ema below 1",
                got=self.ema,
                do="choose a smaller --ema: 0.999, say",
            )

    @property
    def may_differ(self) -> tuple[str, ...]:
        """Settings that may change when a training goes on."""
        fixed_rate = self.schedule == "constant" and self.warmup is not None
        length = ("n_batches",) if fixed_rate else ()
        return (*MAY_DIFFER, *length, *(("save_every",) if self.keep == "last" else ()))

    def learning_rate_at(self, n: int) -> float:
        """Return the learning rate of batch n."""
        warmup = self.n_batches // 10 if self.warmup is None else self.warmup
        done = n / self.n_batches
        after = {
            "constant": 1.0,
            "linear": 1 - done,
            "cosine": 0.5 * (1 + math.cos(math.pi * done)),
        }
        return self.learning_rate * min(1.0, (n + 1) / max(1, warmup)) * after[self.schedule]


def flat(config: Any) -> dict[str, Any]:
    """Return the settings of nested dataclasses in one dict, named as the command's options are.

    >>> @dataclass
    ... class Outer:
    ...     data: Path
    ...     training: LoopConfig
    >>> settings = LoopConfig(n_batches=3, batch_size=2, learning_rate=0.1)
    >>> flat(Outer(Path("d"), settings))["n_batches"]
    3
    """
    found: dict[str, Any] = {}
    for name, value in asdict(config).items():
        found |= value if isinstance(value, dict) else {name: _plain(value)}
    return found


def defaults_of(config: Any) -> dict[str, Any]:
    """Return the settings of a config of the same type in which only data and folder are given."""
    return flat(type(config)(data=config.data, out=config.out))


def change(config: C, **settings: Any) -> C:
    """Return a config with some settings changed, which are named as the command's options are.

    >>> @dataclass(frozen=True)
    ... class Outer:
    ...     data: Path
    ...     training: LoopConfig
    >>> outer = Outer(Path("d"), LoopConfig(n_batches=3, batch_size=2, learning_rate=0.1))
    >>> change(outer, n_batches=7).training.n_batches
    7

    Raises:
        TypeError: there is no such setting.
    """
    for field in fields(config):
        inner = getattr(config, field.name)
        if field.name not in settings and is_dataclass(inner):
            mine = {f.name for f in fields(inner)} & settings.keys()
            if mine:
                changed = replace(inner, **{name: settings.pop(name) for name in mine})  # type: ignore[type-var]
                config = replace(config, **{field.name: changed})
    return replace(config, **settings)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return str(value) if isinstance(value, Path) else value
