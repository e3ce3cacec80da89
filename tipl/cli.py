"""The command ``tipl``: finds the module of a subcommand, and imports no other.

``tipl --help`` and ``tipl zoo`` answer without importing torch or zarr.
"""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from tipl.registry import Kind, commands, imported
from weighttraj.errors import WeightTrajError
from weighttraj.terminal import Output, say, while_read

DESCRIPTION = "Train and evaluate models that forecast the weights of policies."
COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")


@dataclass(frozen=True)
class Command:
    """One subcommand."""

    group: str
    """Heading in the help."""
    help: str
    """What it does, in one line."""
    function: str
    """``module:function``; its arguments are the command's options."""


COMMANDS = {
    "zoo": Command("Use", "List the released models.", "tipl.commands.zoo:zoo"),
    "evaluate": Command(
        "Use",
        "Evaluate forecasters on held-out runs beside persistence; write a report.",
        "tipl.commands.evaluate:evaluate",
    ),
    "leaderboard": Command(
        "Use",
        "Compare forecasters over all tasks of several evaluations.",
        "tipl.commands.leaderboard:leaderboard",
    ),
    "check": Command(
        "Use",
        "Run six checks that a causal forecaster should pass.",
        "tipl.commands.evaluate:check",
    ),
    "report": Command(
        "Use",
        "Write the page and figures of a result file again.",
        "tipl.commands.evaluate:report",
    ),
    "live": Command(
        "Use",
        "Let PPO trainings jump ahead to forecast weights; compare ways to jump.",
        "tipl.commands.live:live",
    ),
    "release": Command(
        "Publish", "Add a model to the released models.", "tipl.commands.publish:release"
    ),
    "card": Command("Publish", "Write the card of a released model.", "tipl.commands.publish:card"),
    "push": Command(
        "Publish",
        "Publish a model with its card, on the hub or in an object store.",
        "tipl.commands.publish:push",
    ),
}
"""All subcommands but ``train``: the registry says what can be trained."""
RENAMED = {
    "fit": "train baselines",
    "train-gate": "train gate",
    "train-causal": "train causal",
    "train-drift": "train stretched",
}
"""Earlier names."""


def main() -> None:
    """Run the command line; errors of ours are printed without a traceback."""
    errors = Output(stderr=True)
    try:
        with while_read(), warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: errors.print(
                f"note: {escape(str(message))}"
            )
            _run(sys.argv[1:])
    except (WeightTrajError, OSError) as error:
        errors.print(f"[red]error:[/red] {escape(str(error))}")
        sys.exit(1)
    except KeyboardInterrupt:
        errors.print("stopped; give the same command again to go on")
        sys.exit(130)


def _run(arguments: list[str]) -> None:
    if any(word.startswith(COMPLETION) for word in arguments):
        _complete(arguments)
    elif not arguments or arguments[0] in ("-h", "--help"):
        _help(Output())
    elif arguments[0] == "--version":
        say(_version())
    elif arguments[0] == "train":
        _train(arguments[1:])
    elif arguments[0] in COMMANDS:
        _call(arguments[0], imported(COMMANDS[arguments[0]].function), arguments[1:])
    else:
        _refuse(arguments[0], list(COMMANDS))


def _train(arguments: list[str]) -> None:
    """Run ``tipl train KIND``."""
    if not arguments or arguments[0] in ("-h", "--help"):
        _help(Output(), only="Train")
    elif (kind := commands().get(arguments[0])) is not None:
        _call(f"train {kind.command}", _trainer(kind), arguments[1:])
    else:
        _refuse(f"train {arguments[0]}", [f"train {name}" for name in commands()])


def _trainer(kind: Kind) -> Callable[..., None]:
    from tipl.commands.train import trainer

    return trainer(imported(str(kind.train)))


def _call(name: str, function: Callable[..., None], arguments: Sequence[str]) -> None:
    import tyro

    config = (tyro.conf.OmitArgPrefixes,)
    tyro.cli(function, prog=f"tipl {name}", args=list(arguments), config=config)


def _help(console: Console, only: str | None = None) -> None:
    console.print(f"usage: tipl {'train KIND' if only else 'COMMAND'} [OPTIONS]\n", highlight=False)
    console.print(f"{DESCRIPTION} Each command explains its options with --help.\n")
    lines = {name: (command.group, command.help) for name, command in COMMANDS.items()}
    lines |= {f"train {name}": ("Train", kind.help) for name, kind in commands().items()}
    for group in ("Use", "Train", "Publish"):
        if only in (None, group):
            console.print(f"{group}:", style="bold")
            table = Table.grid(padding=(0, 2))
            for name, (its_group, what) in lines.items():
                if its_group == group:
                    table.add_row(f"  {name}", escape(what))
            console.print(table)
    if only is None:
        console.print("\n--version prints the version.", highlight=False)


def _refuse(name: str, known: Sequence[str]) -> None:
    """Say that there is no such command, and which one may be meant."""
    if name in RENAMED:
        advice = f"it is now called: tipl {RENAMED[name]}"
    elif name.split()[-1:] == ["train"]:
        advice = "name what to train: tipl train tipl, say"
    else:
        near = difflib.get_close_matches(name, known, n=1)
        advice = f"did you mean: tipl {near[0]}" if near else "tipl --help lists all commands"
    errors = Output(stderr=True)
    errors.print(f"[red]error:[/red] there is no command {escape(name)!r}; {advice}")
    sys.exit(2)


def _version() -> str:
    from importlib.metadata import version

    return f"tipl, of weighttraj {version('weighttraj')}"


def _complete(arguments: Sequence[str]) -> None:
    """Print or write the shell's completion, for which every command is imported."""
    import tyro

    app: Any = tyro.extras.SubcommandApp()
    train: Any = tyro.extras.SubcommandApp()
    for name, command in COMMANDS.items():
        app.command(imported(command.function), name=name)
    for name, kind in commands().items():
        train.command(_trainer(kind), name=name)
    app.command(train, name="train")
    app.cli(prog="tipl", args=list(arguments), config=(tyro.conf.OmitArgPrefixes,))


if __name__ == "__main__":
    main()
