"""Real short trainings, shared by the tests; shapes and types are checked.

Importing this file stays cheap: pytest imports it in the process that only hands out the tests.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock
from jaxtyping import install_import_hook

import tests.typecheck

install_import_hook(tests.typecheck.checked_modules(), "tests.typecheck.typecheck")

import weighttraj as wt  # noqa: E402

MEMORY = Path("/dev/shm")  # noqa: S108


def pytest_configure() -> None:
    """Let the tests write into memory where it has room: flushing to a disk takes a third longer.

    ``PYTEST_DEBUG_TEMPROOT`` names another place. A shell ignores Ctrl-C in its background jobs,
    and their children inherit that: tests of Ctrl-C would wait for ever.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > 4 << 30:
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Bit-equality holds at a fixed thread count only."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True, scope="session")
def cache_of_the_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test writes into the cache of the user who runs it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WEIGHTTRAJ_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of what is made once for all worker processes, each under its lock."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    path = root / "shared"
    path.mkdir(exist_ok=True)
    return path


@pytest.fixture(scope="session")
def full_run(shared: Path) -> wt.Run:
    """Three iterations of CleanRL's PPO at the paper's cadence, all stored. Do not write to it."""
    import torch

    from weighttraj.collect import PPOConfig, WeightTrajectoryCallback, make_ppo

    path = shared / "full/run.zarr"
    with FileLock(shared / "full.lock"):
        if not path.exists():
            torch.set_num_threads(1)
            config = PPOConfig(total_timesteps=3 * 2048)
            callback = WeightTrajectoryCallback(path, critic=True, optimizer_moments=True)
            make_ppo(config, seed=1).learn(config.total_timesteps, callback=callback)
    return wt.open_run(path)


@pytest.fixture(scope="session")
def small_dataset(shared: Path) -> Path:
    """Two training runs and two test runs of 49 snapshots. Do not write to it."""
    from tests.small import SMALL_RECIPE
    from weighttraj.collect import collect

    with FileLock(shared / "small.lock"), tests.typecheck.unchecked():
        collect(SMALL_RECIPE, shared / "small")
    return shared / "small"


@pytest.fixture(scope="session")
def few_released(shared: Path) -> Path:
    """Five runs of the released data, which released models are for. Do not write to it."""
    from weighttraj.registry import create

    path = shared / "few/inverted-pendulum-v4-ppo-v1"
    with FileLock(shared / "few.lock"):
        if not path.exists():
            path.parent.mkdir()
            chosen = wt.open("inverted-pendulum-v4-ppo-v1").select(seed=[0, 7, 30, 40, 41])
            splits = {run.id: run.split for run in chosen}
            create([str(run.path) for run in chosen], path, splits=splits)
    return path


@pytest.fixture(scope="session")
def brief_released(shared: Path, few_released: Path) -> Path:
    """Their first 241 snapshots, for what trains on all of them. Do not write to it."""
    path = shared / f"brief/{few_released.name}"
    with FileLock(shared / "brief.lock"):
        if not path.exists():
            steps = (0, 100_000)
            wt.download(few_released.as_uri(), path, steps=steps, arrays=["eval", "probe"])
    return path


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 64 KiB; ``grow`` makes it larger."""
    path = tmp_path / "disk"
    path.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(path)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("no small disk can be mounted here")
    yield path
    subprocess.run(["umount", "-l", str(path)], check=True)  # noqa: S607


@pytest.fixture
def reader(tmp_path: Path, few_released: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a reader of our pages stands: a home of their own, fewer runs, shorter recipes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(few_released.parent))
    short = "n_steps = 64\nbatch_size = 16\nn_epochs = 2\ncritic_arch = [8, 8]"
    for name, changes in {
        "demo": {"51_200": f"768\n{short}", "every = 64": "every = 2\nblock = 8"},
        "inverted-pendulum-v4-ppo-v1": {"800_000": "2_048"},
    }.items():
        recipe = (Path(__file__).parents[1] / f"datasets/{name}/recipe.toml").read_text()
        for long, shorter in changes.items():
            assert long in recipe
            recipe = recipe.replace(long, shorter)
        copy = tmp_path / f"datasets/{name}/recipe.toml"
        copy.parent.mkdir(parents=True)
        copy.write_text(recipe)
    return tmp_path
