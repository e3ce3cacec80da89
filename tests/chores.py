"""Tasks for engines; light, because every worker imports them."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from weighttraj.engine import Tell


def ignore(*_: object) -> None:
    pass


def halve(number: int, tell: Tell) -> float:
    if number == 3:
        raise ZeroDivisionError
    tell(number, "halved")
    return number / 2


def die_once(path: Path, _: Tell) -> str:
    if path.name == "mortal" and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def die(name: str, _: Tell) -> str:
    if "mortal" in name:
        os.kill(os.getpid(), signal.SIGKILL)
    return name


def whose(_: int, __: Tell) -> int:
    return os.getpid()


def wait_for_ever(path: Path, tell: Tell) -> None:
    while True:
        with path.open("a") as file:
            file.write(".")
        tell()
        time.sleep(0.05)
