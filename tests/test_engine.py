"""Tasks done in this process, in several, and on a real Dask cluster; workers that are killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import dask
import distributed
import pytest

from tests.chores import die, die_once, halve, ignore, wait_for_ever, whose
from weighttraj.engine import Engine, engine_of
from weighttraj.errors import EngineError


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a Dask scheduler with two workers."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=":0"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(params=["serial", "processes", "cluster"])
def engine(request: pytest.FixtureRequest) -> Iterator[Engine]:
    cluster = request.param == "cluster"
    address = request.getfixturevalue("scheduler") if cluster else None
    with engine_of(2 if request.param == "processes" else 1, address) as made:
        yield made


several = pytest.mark.parametrize("engine", ["processes", "cluster"], indirect=True)


def test_every_task_has_its_outcome(engine: Engine) -> None:
    told: set[tuple[object, ...]] = set()
    outcomes = dict(engine.run(halve, range(5), lambda *message: told.add(message)))
    assert isinstance(outcomes.pop(3), ZeroDivisionError)
    assert outcomes == {0: 0.0, 1: 0.5, 2: 1.0, 4: 2.0}
    assert told == {(i, "halved") for i in (0, 1, 2, 4)}


def test_no_tasks_are_done_at_once(engine: Engine) -> None:
    assert list(engine.run(halve, [], ignore)) == []


@several
def test_what_a_killed_worker_did_is_done_again(engine: Engine, tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a", "mortal", "b", "c")]
    outcomes = dict(engine.run(die_once, paths, ignore))
    assert outcomes == {path: path.name for path in paths}
    assert (tmp_path / "mortal").exists()


@several
def test_a_worker_that_dies_for_good_costs_its_task_alone(engine: Engine) -> None:
    """Also where the others wait behind it, one such task at each worker."""
    outcomes = dict(engine.run(die, ["mortal", "mortal too", "a", "b", "c"], ignore))
    for name in ("mortal", "mortal too"):
        error = outcomes.pop(name)
        assert isinstance(error, EngineError)
        assert "times in a row" in str(error)
    assert outcomes == {name: name for name in "abc"}


@several
def test_workers_are_other_processes_and_are_kept(engine: Engine) -> None:
    pids = {pid for _, pid in engine.run(whose, range(8), ignore)}
    assert os.getpid() not in pids
    assert 1 <= len(pids) <= 2


@several
def test_who_stops_listening_stops_the_tasks(engine: Engine, tmp_path: Path) -> None:
    path = tmp_path / "alive"
    outcomes = engine.run(wait_for_ever, [path], _Impatient())
    with pytest.raises(ImpatienceError):
        next(outcomes)
    time.sleep(1)
    size = path.stat().st_size
    time.sleep(0.5)
    assert path.stat().st_size == size


class ImpatienceError(Exception):
    pass


class _Impatient:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> None:
        self.calls += 1
        if self.calls == 5:
            raise ImpatienceError


SCRIPT = """
import sys
from pathlib import Path
from tests.chores import ignore, wait_for_ever
from weighttraj.engine import engine_of
if __name__ == "__main__":
    with engine_of(2, sys.argv[2] if len(sys.argv) > 2 else None) as engine:
        tasks = [Path(sys.argv[1]) / name for name in "ab"]
        list(engine.run(wait_for_ever, tasks, ignore))
"""


@pytest.mark.parametrize("scheduler_argument", [[], ["local"]], ids=["processes", "local cluster"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT], ids=lambda n: n.name)
def test_workers_end_with_who_began_them(
    tmp_path: Path, scheduler_argument: list[str], number: signal.Signals
) -> None:
    """A kill reaches the first process alone, Ctrl-C the whole group."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = str(Path(__file__).parents[1])
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path), *scheduler_argument],
        env={**os.environ, "PYTHONPATH": root},
        stderr=subprocess.PIPE,
        start_new_session=True,
        text=True,
    )
    paths = [tmp_path / name for name in "ab"]
    deadline = time.monotonic() + 60
    while not all(path.exists() for path in paths) and time.monotonic() < deadline:
        time.sleep(0.05)
    if number == signal.SIGKILL:
        os.kill(process.pid, number)
    else:
        os.killpg(process.pid, number)
        time.sleep(0.1)
        os.killpg(process.pid, number)
    said = process.communicate(timeout=60)[1]
    time.sleep(1)
    sizes = [path.stat().st_size for path in paths]
    time.sleep(1)
    assert [path.stat().st_size for path in paths] == sizes
    if number == signal.SIGINT:
        assert said.count("Traceback") == 1, said  # this process's own
        assert said.strip().endswith("KeyboardInterrupt")


def test_a_worker_with_several_threads_is_refused() -> None:
    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=2,
            host="127.0.0.1",
            dashboard_address=":0",
        ) as cluster,
        engine_of(scheduler=cluster.scheduler_address) as engine,
    ):
        ((_, error),) = engine.run(halve, [1], ignore)
    assert isinstance(error, EngineError)
    assert "--nthreads 1" in str(error)


def test_nobody_at_the_address_is_one_clear_error() -> None:
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(EngineError, match="no Dask scheduler answers"),
        engine_of(1, "tcp://127.0.0.1:1"),
    ):
        pass


def test_no_workers_is_refused() -> None:
    with pytest.raises(EngineError, match="workers at least 1"), engine_of(0):
        pass
