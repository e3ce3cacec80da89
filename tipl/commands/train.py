"""``tipl train KIND``: a command for each kind that the registry knows how to train."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any, NoReturn, get_type_hints

from tipl.training.parallel import rank_here
from weighttraj.remote.address import new_path
from weighttraj.terminal import Output, say


def trainer(train: Callable[..., Any]) -> Callable[..., None]:
    """Return the command of a function that trains: its config gives the options.

    Args:
        train: a function of (config, console), the first argument being a dataclass with ``out``.
    """

    def command(config: Any) -> None:
        new_path(config.out)
        signal.signal(signal.SIGTERM, _stop)
        found = train(config, console=Output())
        if rank_here() == 0:
            what = f"{len(found)} baselines" if isinstance(found, list) else "model"
            say(f"{what} in {config.out}")

    command.__annotations__["config"] = get_type_hints(train)["config"]
    command.__doc__ = train.__doc__
    return command


def _stop(*_: object) -> NoReturn:
    """Treat SIGTERM, with which `torchrun` and schedulers end a process, as Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # some send it twice
    raise KeyboardInterrupt
