"""Threads of ours, and how many of its own torch computes with in them."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from threading import Event

import pytest
import torch

from weighttraj.threads import in_threads, one_torch_thread

TASKS = Path("/proc/self/task")


@pytest.mark.skipif(sys.platform != "linux", reason="counts threads in /proc")
def test_torch_computes_with_one_thread_in_threads_of_ours() -> None:
    def work(_: str, size: int, __: Event) -> int:
        known = {*os.listdir(TASKS)}
        torch.baddbmm(torch.ones(8, 1, 16), torch.ones(8, size, 17), torch.ones(8, 17, 16)).tanh()
        return len({*os.listdir(TASKS)} - known)

    with one_torch_thread():
        assert in_threads(work, ["here"], [5], lambda: None) == [0]
