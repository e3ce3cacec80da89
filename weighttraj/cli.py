"""The command ``weighttraj``."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape

import weighttraj as wt
from weighttraj.errors import WeightTrajError

app = tyro.extras.SubcommandApp()
console = Console()


@dataclass(frozen=True, kw_only=True)
class _Collect:
    recipe: tyro.conf.Positional[Path]
    """Recipe, a TOML file such as datasets/demo/recipe.toml."""
    out: Path | None = None
    """Folder of the data set. Default: data/<id of the recipe>."""
    seeds: str | None = None
    """Only these seeds: 3, or a range 0:50 (the end excluded). Default: the recipe's."""
    workers: int = 1
    """Runs that are trained at the same time, each in a process with one thread."""


@app.command(name="collect")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _collect(args: _Collect) -> None:
    """Collect the data set of a recipe, or go on where it stopped."""
    from weighttraj.collect.recipe import parse_seeds

    recipe = wt.collect.read_recipe(args.recipe)
    out = args.out or Path("data") / recipe.id
    seeds = None if args.seeds is None else parse_seeds(args.seeds)
    dataset = wt.collect.collect(recipe, out, seeds=seeds, workers=args.workers, console=console)
    print(dataset)
    print(f"data set in {out}")


@app.command(name="show")
def _show(
    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="data set or run")],
) -> None:
    """Print what a data set or a run holds."""
    if (path / "dataset.json").is_file():
        print(wt.open(path))
        return
    run = wt.open_run(path)
    print(run)
    for array in run.arrays.values():
        print(f"  {array!r}")


@app.command(name="verify")
def _verify(
    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="data set or run")],
) -> None:
    """Read every byte of a data set or run; exit with 1 if something is missing or damaged."""
    problems = wt.verify(path)
    for problem in problems:
        print(problem)
    print(f"{path}: {len(problems)} problems" if problems else f"{path}: whole")
    if problems:
        raise SystemExit(1)


def main() -> None:
    """Run the command line; errors of ours are printed without a traceback."""
    try:
        app.cli(prog="weighttraj", description="Policy weight trajectories as data.")
    except (WeightTrajError, FileNotFoundError) as error:
        console.print(f"[red]error:[/red] {escape(str(error))}", style=None)
        sys.exit(1)
    except BrokenPipeError:  # the reader of our output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        console.print("stopped; give the same command again to go on")
        sys.exit(130)


if __name__ == "__main__":
    main()
