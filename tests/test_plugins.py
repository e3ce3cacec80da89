"""Modules that users name register their environments, in this process and in workers."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import pytest

import weighttraj as wt
from tests.test_cli import run
from weighttraj.engine import Tell, engine_of
from weighttraj.errors import CollectError
from weighttraj.plugins import import_modules

MODULE = """
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv

gym.register("Theirs-v0", PendulumEnv, max_episode_steps=20)
"""

RECIPE = """
id = "theirs"
[seeds]
train = "0:2"
[ppo]
env_id = "Theirs-v0"
total_timesteps = 64
n_steps = 32
batch_size = 32
n_epochs = 1
[store]
every = 1
probe_observations = 8
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a module that registers an environment."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    (tmp_path / "their_environments.py").write_text(MODULE)
    (tmp_path / "registers_nothing.py").write_text("")
    (tmp_path / "fails.py").write_text("1 / 0")
    (tmp_path / "recipe.toml").write_text(RECIPE)
    return tmp_path


def test_a_module_of_the_current_folder_is_imported(folder: Path) -> None:
    import_modules(["their_environments"])
    assert gym.make("Theirs-v0").spec is not None
    import_modules(["their_environments"])  # again, where it is known
    del gym.registry["Theirs-v0"], sys.modules["their_environments"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("not_there", r"(?s)cannot be imported.*No module named 'not_there'.*--import not_there"),
        ("their_environments.py", r"such as my_envs for my_envs\.py"),
        ("fails", "ZeroDivisionError"),
        ("registers_nothing", "registers no environment"),
        ("", "cannot be imported"),
    ],
)
def test_a_module_that_does_not_help_is_an_error(name: str, message: str, folder: Path) -> None:
    with pytest.raises(CollectError, match=message):
        import_modules([name])
    for left in ("Theirs-v0",):
        gym.registry.pop(left, None)
    for left in ("their_environments", "registers_nothing"):
        sys.modules.pop(left, None)


def test_without_the_module_the_error_names_the_option(folder: Path) -> None:
    said = run("weighttraj", "collect", "recipe.toml", "--out", "theirs")
    assert said.returncode == 1
    assert "--import MODULE" in " ".join(said.stderr.split())


def limit_of(env_id: str, _: Tell) -> int | None:
    return gym.spec(env_id).max_episode_steps


def test_workers_import_the_module_too(folder: Path) -> None:
    with engine_of(2, imports=["their_environments"]) as engine:
        outcomes = list(engine.run(limit_of, ["Theirs-v0"] * 2, lambda: None))
    assert outcomes == [("Theirs-v0", 20)] * 2
    del gym.registry["Theirs-v0"], sys.modules["their_environments"]


def test_commands_that_make_environments_take_the_module(folder: Path) -> None:
    module = ("--import", "their_environments")
    for command in (
        ("collect", "recipe.toml", "--out", "theirs"),
        ("returns", "theirs", "--episodes", 1),
    ):
        done = run("weighttraj", *command, *module)
        assert done.returncode == 0, done.stderr
    assert wt.open("theirs").runs[0].evaluation is not None
