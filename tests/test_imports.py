"""The arrows between rooms, and what importing costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Each module, and what of ours it may import. A package stands for all in it, `door` for what the
# package itself names. `later`: inside a function, which opens another room when it is called.
FORMAT = "weighttraj.format"
REMOTE = "weighttraj.remote.address"
ALLOWED = {
    "weighttraj.text": [],
    "weighttraj.errors": ["weighttraj.text"],
    "weighttraj.atomic": ["weighttraj.errors", REMOTE],
    "weighttraj.threads": [],
    "weighttraj.progress": [],
    "weighttraj.terminal": ["weighttraj.text"],
    "weighttraj.plugins": ["weighttraj.errors"],
    "weighttraj.engine": ["weighttraj.errors", "weighttraj.engine"],
    "weighttraj.engine.choose": [
        "weighttraj.errors",
        "weighttraj.plugins",
        "weighttraj.engine",
        "later weighttraj.engine.cluster",
    ],
    "weighttraj.remote": [
        "weighttraj.errors",
        "weighttraj.remote",
        "later weighttraj.remote.hub",
    ],
    "weighttraj.format.values": ["weighttraj.errors"],
    "weighttraj.format.layout": ["weighttraj.errors", "weighttraj.format.values"],
    "weighttraj.format.exact": ["weighttraj.errors"],
    "weighttraj.format.schema": [
        "weighttraj.errors",
        "weighttraj.format.exact",
        "weighttraj.format.layout",
    ],
    "weighttraj.format.objects": [
        "weighttraj.atomic",
        "weighttraj.errors",
        "weighttraj.remote.address",
    ],
    "weighttraj.format.remote": [
        "weighttraj.errors",
        "weighttraj.format.objects",
        "weighttraj.remote",
    ],
    "weighttraj.format.codecs": ["weighttraj.errors", "weighttraj.format.schema"],
    "weighttraj.format.decode": [
        "weighttraj.errors",
        "weighttraj.format.codecs",
        "weighttraj.format.objects",
    ],
    "weighttraj.format.encode": [
        "weighttraj.atomic",
        "weighttraj.errors",
        "weighttraj.format.codecs",
        "weighttraj.format.schema",
    ],
    "weighttraj.format.storage": [
        "weighttraj.errors",
        "weighttraj.format.codecs",
        "weighttraj.format.decode",
        "weighttraj.format.objects",
        "weighttraj.format.schema",
        REMOTE,
        "later weighttraj.format.remote",
    ],
    "weighttraj.format.live": [
        "weighttraj.atomic",
        "weighttraj.errors",
        "weighttraj.format.codecs",
        "weighttraj.format.encode",
        "weighttraj.format.objects",
        "weighttraj.format.schema",
        "weighttraj.format.storage",
        REMOTE,
    ],
    "weighttraj.format.packing": [
        "weighttraj.atomic",
        "weighttraj.errors",
        REMOTE,
        "weighttraj.format.live",
        "weighttraj.format.objects",
        "weighttraj.format.schema",
        "weighttraj.format.storage",
    ],
    "weighttraj.format.writer": [
        "weighttraj.atomic",
        "weighttraj.errors",
        REMOTE,
        "weighttraj.format.live",
        "weighttraj.format.schema",
        "weighttraj.format.storage",
        "weighttraj.format.values",
    ],
    "weighttraj.format.returns": [
        "weighttraj.atomic",
        "weighttraj.errors",
        "weighttraj.format.live",
        "weighttraj.format.objects",
        "weighttraj.format.packing",
        "weighttraj.format.schema",
        "weighttraj.format.storage",
        "weighttraj.format.writer",
        REMOTE,
    ],
    "weighttraj.format.catalog": [
        "weighttraj.atomic",
        "weighttraj.errors",
        "weighttraj.format.objects",
        "weighttraj.format.schema",
        "weighttraj.format.storage",
    ],
    "weighttraj.format.tables": [
        "weighttraj.text",
        "weighttraj.atomic",
        "weighttraj.errors",
        "weighttraj.format.objects",
        "weighttraj.format.reader",
    ],
    "weighttraj.format.lint": ["weighttraj.format.reader", REMOTE],
    "weighttraj.format.locate": ["weighttraj.remote"],
    "weighttraj.format.overview": [
        "weighttraj.errors",
        "weighttraj.format.schema",
        "weighttraj.text",
    ],
    "weighttraj.format.reader": [
        "weighttraj.text",
        "weighttraj.errors",
        "weighttraj.format.catalog",
        "weighttraj.format.codecs",
        "weighttraj.format.layout",
        "weighttraj.format.locate",
        "weighttraj.format.objects",
        "weighttraj.format.overview",
        "weighttraj.format.schema",
        "weighttraj.format.storage",
        REMOTE,
        "later weighttraj.collect.into",
        "later weighttraj.format.hdf5",
        "later weighttraj.load.windows",
        "later weighttraj.policies.policy",
        "later weighttraj.remote",
    ],
    "weighttraj.format.export": [
        "weighttraj.atomic",
        "weighttraj.errors",
        "weighttraj.format.objects",
        "weighttraj.format.reader",
        "weighttraj.format.schema",
    ],
    "weighttraj.format.hdf5_store": [
        "weighttraj.errors",
        "weighttraj.format.codecs",
        "weighttraj.format.objects",
        "weighttraj.format.schema",
        "weighttraj.format.storage",
    ],
    "weighttraj.format.hdf5": ["weighttraj.atomic", FORMAT, "weighttraj.errors"],
    "weighttraj.format.integrity": ["weighttraj.atomic", FORMAT, "weighttraj.errors", REMOTE],
    "weighttraj.format": [FORMAT],
    "weighttraj.environments": ["weighttraj.errors", FORMAT],
    "weighttraj.collect": [
        "weighttraj.plugins",
        "weighttraj.atomic",
        "weighttraj.progress",
        "weighttraj.threads",
        "weighttraj.engine",
        "weighttraj.errors",
        "weighttraj.environments",
        FORMAT,
        REMOTE,
        "weighttraj.collect",
        "weighttraj.policies.kernels",
        "weighttraj.policies.policy",
        "weighttraj.policies.simulators",
    ],
    "weighttraj.learning": [],
    "weighttraj.policies": [
        "weighttraj.text",
        "weighttraj.atomic",
        "weighttraj.learning",
        "weighttraj.progress",
        "weighttraj.threads",
        "weighttraj.engine",
        "weighttraj.errors",
        "weighttraj.environments",
        FORMAT,
        REMOTE,
        "weighttraj.policies",
    ],
    "weighttraj.publish.film": [FORMAT, "weighttraj.publish"],
    "weighttraj.publish.episodes": [
        "weighttraj.threads",
        "weighttraj.errors",
        "weighttraj.environments",
        FORMAT,
        "weighttraj.policies",
        "weighttraj.publish",
    ],
    "weighttraj.publish": [
        "weighttraj.text",
        "weighttraj.atomic",
        "weighttraj.errors",
        FORMAT,
        REMOTE,
        "weighttraj.publish",
    ],
    "weighttraj.publish.report": [
        "weighttraj.text",
        "weighttraj.atomic",
        "weighttraj.progress",
        "weighttraj.errors",
        FORMAT,
        "weighttraj.publish",
        "later weighttraj.publish.film",
    ],
    "weighttraj.load.cache": [
        "weighttraj.atomic",
        "weighttraj.errors",
        "door weighttraj.format",
        "weighttraj.format.objects",
    ],
    "weighttraj.load.windows": [
        "weighttraj.errors",
        REMOTE,
        "door weighttraj.format",
        "weighttraj.load.cache",
    ],
    "weighttraj.load.loader": ["weighttraj.errors", "weighttraj.load.windows"],
    "weighttraj.load": ["weighttraj.errors", "weighttraj.load"],
    "weighttraj.registry": ["weighttraj.registry"],
    "weighttraj.registry.local": [
        "weighttraj.errors",
        "door weighttraj.format",
        "weighttraj.format.catalog",
        "weighttraj.format.locate",
    ],
    "weighttraj.registry.search": [
        "weighttraj.errors",
        "door weighttraj.format",
        "weighttraj.format.tables",
        "weighttraj.registry.local",
    ],
    "weighttraj.registry.derive": [
        "weighttraj.atomic",
        "weighttraj.progress",
        "weighttraj.errors",
        "door weighttraj.format",
        "weighttraj.format.catalog",
        "weighttraj.format.locate",
        "weighttraj.format.objects",
        "weighttraj.format.packing",
        "weighttraj.format.storage",
    ],
    "weighttraj.registry.croissant": [
        "weighttraj.text",
        "weighttraj.errors",
        "door weighttraj.format",
        "weighttraj.format.tables",
    ],
    "weighttraj.registry.card": [
        "weighttraj.text",
        "weighttraj.atomic",
        "weighttraj.errors",
        "door weighttraj.format",
        "weighttraj.format.catalog",
        "weighttraj.format.locate",
        "weighttraj.format.objects",
        "weighttraj.format.tables",
        "weighttraj.registry.croissant",
    ],
    "weighttraj.registry.transfer": ["weighttraj.format.catalog", "weighttraj.remote"],
    "weighttraj.registry.download": [
        "weighttraj.atomic",
        "weighttraj.progress",
        "weighttraj.errors",
        "weighttraj.registry.transfer",
        "door weighttraj.format",
        "weighttraj.format.catalog",
        "weighttraj.format.locate",
        "weighttraj.format.objects",
        "weighttraj.format.packing",
        "weighttraj.format.storage",
        "weighttraj.remote",
    ],
    "weighttraj.registry.load": [
        "weighttraj.errors",
        "door weighttraj.format",
        "weighttraj.format.locate",
        "weighttraj.registry.download",
        REMOTE,
    ],
    "weighttraj.registry.upload": [
        "weighttraj.progress",
        "weighttraj.errors",
        "weighttraj.registry.transfer",
        "weighttraj.format.lint",
        "door weighttraj.format",
        "weighttraj.format.catalog",
        "weighttraj.format.locate",
        "weighttraj.format.objects",
        "weighttraj.remote",
    ],
    "weighttraj.__main__": ["door weighttraj.cli"],
    "weighttraj.cli": [
        "door weighttraj",
        "weighttraj.errors",
        "weighttraj.format.lint",
        "weighttraj.format.locate",
        "weighttraj.plugins",
        "weighttraj.registry",
        "weighttraj.remote",
        "weighttraj.terminal",
        "later weighttraj.collect.recipe",
        "later weighttraj.load",
        "later weighttraj.plugins",
        "later weighttraj.publish.gallery",
        "later weighttraj.publish.report",
    ],
    "weighttraj": [f"later {FORMAT}", "later weighttraj.remote"],
}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def rule_of(module: str, rules: dict[str, list[str]]) -> list[str]:
    while module not in rules:
        module = module.rpartition(".")[0]
    return rules[module]


def imports(path: Path) -> set[str]:
    """Modules of ours that a file imports; those inside functions are marked ``later``."""
    tree = ast.parse(path.read_text())
    found = set()
    later = {
        node
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
    }
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # `from package import module` names the module, not the package
            paths = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [p if is_module(p) else node.module for p in paths]
        typing_only = isinstance(node, ast.ImportFrom) and in_type_checking(tree, node)
        mark = "later " if node in later or typing_only else ""
        found |= {mark + n for n in names if n.split(".")[0] in ("weighttraj", "tipl")}
    return found


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def in_type_checking(tree: ast.Module, node: ast.AST) -> bool:
    blocks = [n for n in tree.body if isinstance(n, ast.If)]
    return any(node in ast.walk(b) for b in blocks if ast.unparse(b.test) == "TYPE_CHECKING")


FILES = sorted(ROOT.glob("weighttraj/**/*.py"))


@pytest.mark.parametrize("path", FILES, ids=module_name)
def test_arrows_go_one_way(path: Path) -> None:
    allowed = rule_of(module_name(path), ALLOWED)
    for name in imports(path):
        inside = any(name == rule or name.startswith(f"{rule}.") for rule in allowed)
        assert inside or f"door {name}" in allowed, f"{module_name(path)} imports {name}"


def test_the_table_of_arrows_has_no_dead_lines() -> None:
    names = {module_name(path) for path in FILES}
    for module in ALLOWED:
        assert module in names, module


def test_the_rooms_of_tipl_import_one_way() -> None:
    """The contracts in pyproject.toml, imports inside functions included."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports as f; exit(f())"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


HEAVY_FOR_COMMANDS = ["torch", "zarr", "stable_baselines3", "mujoco", "matplotlib", "gymnasium"]


@pytest.mark.parametrize("command", ["--help", "--version", "zoo", "train --help"])
def test_a_list_of_models_or_commands_loads_nothing_heavy(command: str) -> None:
    said = run(
        f"import sys; sys.argv = ['tipl', *{command.split()}]\n"
        "from tipl.cli import main; main()\n"
        f"print([m for m in {HEAVY_FOR_COMMANDS} if m in sys.modules])"
    )
    assert said.endswith("[]"), said


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
        ("h5py", "from weighttraj.format import hdf5", "files"),
        (
            "safetensors",
            "from weighttraj.format.export import export_safetensors as e; e(None, 0, '')",
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
    assert f"pip install 'weighttraj[{extra}]'" in said
