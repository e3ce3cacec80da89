"""``tipl train KIND``: a command for each kind that the registry knows how to train."""

from __future__ import annotations

import contextlib
import math
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn, get_type_hints

from tipl.training.checkpoint import read_log
from tipl.training.parallel import rank_here
from weighttraj.remote.address import new_path
from weighttraj.terminal import Output, say

BARS = "▁▂▃▄▅▆▇█"
WIDTH = 20
"""Largest number of bars, about."""
ERRORS = {
    "wpe": "WPE on training runs",
    "validation_wpe": "WPE on validation runs",
    "error": "error on training runs",
    "validation_error": "error on validation runs",
}
"""Errors in a log, and what they are called."""


def trainer(train: Callable[..., Any]) -> Callable[..., None]:
    """Return the command of a function that trains: its config gives the options.

    Args:
        train: a function of (config, console), the first argument being a dataclass with ``out``.
    """

    def command(config: Any) -> None:
        new_path(config.out)
        with _stopped_by_sigterm():
            found = train(config, console=Output())
        if rank_here() == 0:
            what = f"{len(found)} baselines" if isinstance(found, list) else "model"
            for line in curves(read_log(config.out)):
                say(line)
            say(f"{what} in {config.out}")

    command.__annotations__["config"] = get_type_hints(train)["config"]
    command.__doc__ = train.__doc__
    return command


def curves(log: Sequence[Mapping[str, float]]) -> list[str]:
    """Return a line for each error of a training's log: its curve, its first and its last value.

    The bars are on a logarithmic scale, from the smallest value to the largest one.
    """
    return [
        _curve(name, [(line["batch"], line[key]) for line in log if key in line])
        for key, name in ERRORS.items()
        if sum(key in line for line in log) > 1
    ]


def _curve(name: str, points: list[tuple[float, float]]) -> str:
    step = max(1, len(points) // WIDTH)
    heights = [math.log(max(value, 1e-30)) for _, value in points[::step]]
    low, span = min(heights), max(max(heights) - min(heights), 1e-9)
    bars = "".join(BARS[round((height - low) / span * (len(BARS) - 1))] for height in heights)
    first, last = (f"{value:.3g} at batch {batch:,.0f}" for batch, value in (points[0], points[-1]))
    return f"{name} {bars} {first}, {last}"


@contextlib.contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Treat SIGTERM, with which `torchrun` and schedulers end a process, as Ctrl-C meanwhile.

    The handler before is put back at the end: processes forked later from a caller of ``main``
    would inherit this one, and ``multiprocessing`` ends its workers by SIGTERM.
    """

    def stop(*_: object) -> NoReturn:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # some send it twice
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread gets signals
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGTERM) is stop:  # else the process is ending
            signal.signal(signal.SIGTERM, before)
