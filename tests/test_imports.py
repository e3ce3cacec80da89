"""Rooms import one way, and an import costs only what it needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_rooms_import_one_way() -> None:
    """Imports inside functions count too."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports as f; exit(f())"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


HEAVY_FOR_COMMANDS = ["torch", "zarr", "stable_baselines3", "mujoco", "matplotlib", "gymnasium"]


LOADED = """
import sys
from {program}.cli import main
for command in {commands}:
    sys.argv = [{program!r}, *command.split()]
    try:
        main()
    except SystemExit as end:
        assert not end.code, command
    print(f"after {{command}}:", [m for m in {heavy} if m in sys.modules])
"""


def loaded(program: str, commands: list[str], heavy: list[str]) -> list[str]:
    """What a process that gives these commands has loaded after each."""
    said = run(LOADED.format(program=program, commands=commands, heavy=heavy))
    return [line for line in said.splitlines() if line.startswith("after ")]


def test_a_list_of_models_or_commands_loads_nothing_heavy() -> None:
    commands = ["--help", "--version", "zoo", "train --help"]
    expected = [f"after {command}: []" for command in commands]
    assert loaded("tipl", commands, HEAVY_FOR_COMMANDS) == expected


def test_a_look_at_data_sets_loads_no_torch() -> None:
    heavy = ["torch", "stable_baselines3", "mujoco", "matplotlib", "gymnasium"]
    commands = ["--help", "--version", "list --help", "list", "show inverted-pendulum-v4-ppo-v1"]
    expected = [f"after {command}: []" for command in commands]
    assert loaded("weighttraj", commands, heavy) == expected


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, weighttraj; print([m for m in HEAVY if m in sys.modules])"
    heavy = [
        "h5py",
        "pyarrow",
        "torch",
        "stable_baselines3",
        "gymnasium",
        "mujoco",
        "matplotlib",
        "pandas",
        "distributed",
    ]
    assert run(f"HEAVY = {heavy}; {code}") == "[]"


BLOCKED = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Block())
import weighttraj as wt
try:
    {use}
except ImportError as error:
    print(error)
"""


@pytest.mark.parametrize(
    ("missing", "use", "extra"),
    [
        ("stable_baselines3", "wt.collect", "sb3"),
        ("torch", "wt.policies", "sb3"),
        ("h5py", "import weighttraj.tools.hdf5", "files"),
        (
            "safetensors",
            "from weighttraj.tools.export import export_safetensors as e; e(None, 0, '')",
            "files",
        ),
        ("torch", "wt.load", "sb3"),
        ("distributed", "import weighttraj.engine.cluster", "dask"),
        ("matplotlib", "import weighttraj.publish", "report"),
        ("jinja2", "from weighttraj.publish.report import report", "report"),
        ("safetensors", "import tipl", "tipl"),
        ("jinja2", "import tipl", "tipl"),
    ],
)
def test_a_missing_extra_names_the_command(missing: str, use: str, extra: str) -> None:
    said = run(BLOCKED.format(missing=missing, use=use))
    assert missing in said
    assert f"pip install -e '.[{extra}]'" in said
