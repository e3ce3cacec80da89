"""The command ``weighttraj``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.markup import escape
from rich.prompt import Confirm
from rich.table import Table

import weighttraj as wt
from weighttraj import registry
from weighttraj.errors import RegistryError, WeightTrajError
from weighttraj.locate import COLLECTED, clone, locate
from weighttraj.plugins import import_modules
from weighttraj.remote import RemotePath, here, is_remote
from weighttraj.terminal import Output, say, while_read
from weighttraj.tools.lint import lint_returns

Imports = Annotated[tuple[str, ...], tyro.conf.arg(name="import", metavar="MODULE ...")]
"""Modules that register environments, of the option --import."""

app = tyro.extras.SubcommandApp()
console = Output()
errors = Output(stderr=True)


@dataclass(frozen=True, kw_only=True)
class _Collect:
    recipe: tyro.conf.Positional[Path]
    """Recipe, a TOML file such as datasets/demo/recipe.toml."""
    out: Path | None = None
    """Folder of the data set. Default: data/<id of the recipe>."""
    seeds: str | None = None
    """Only these seeds: 3, a range 0:50 (the end excluded), or several: 0:4,30:32. Default: the
    recipe's."""
    workers: int = 1
    """Processes, each with one thread, that train a run, or a population, at a time."""
    scheduler: str | None = None
    """Let a Dask cluster do it: tcp://host:port, or local for one of --workers on this machine."""
    imports: Imports = ()
    """Modules that register environments (my_envs for my_envs.py); each worker imports them."""


@app.command(name="collect")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _collect(args: _Collect) -> None:
    """Collect the data set of a recipe, or go on where it stopped."""
    from weighttraj.collect.settings import parse_seeds
    from weighttraj.plugins import import_modules

    import_modules(args.imports)  # the recipe may name an environment of theirs
    recipe = wt.collect.read_recipe(here(args.recipe))
    out = args.out or Path(COLLECTED) / recipe.id
    seeds = None if args.seeds is None else parse_seeds(args.seeds)
    dataset = wt.collect.collect(
        recipe,
        out,
        seeds=seeds,
        workers=args.workers,
        scheduler=args.scheduler,
        imports=args.imports,
        console=console,
    )
    say(dataset)
    say(f"data set in {out}")


@dataclass(frozen=True, kw_only=True)
class _Returns:
    path: tyro.conf.Positional[str]
    """Data set (path or id) or run."""
    episodes: int = 10
    """Episodes for each action mode; the same seeds for every policy."""
    every: int = 10
    """Evaluate every so many-th snapshot, and the last one."""
    first: int = 0
    """Also each of the first N snapshots: policies change most at the start."""
    learning: int = 0
    """Also every N-th snapshot of the learning phase, until the return has come 95 % of the way
    from its first to its final value; 0: none."""
    mode: Literal["both", "deterministic", "sampled"] = "both"
    """How the policies act: the distribution's mode, samples, or both in turn."""
    seed: int = 0
    """Seed of the first episode."""
    workers: int = 1
    """Processes, each with one thread."""
    scheduler: str | None = None
    """Let a Dask cluster do it: tcp://host:port, or local for one of --workers on this machine."""
    imports: Imports = ()
    """Modules that register environments (my_envs for my_envs.py); each worker imports them."""
    replace: bool = False
    """Evaluate anew what has returns of other episodes or other versions of the physics."""


@app.command(name="returns")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _returns(args: _Returns) -> None:
    """Evaluate stored policies: their returns J(pi) become part of the runs; or go on."""
    config = wt.policies.ReturnsConfig(
        episodes=args.episodes,
        every=args.every,
        first=args.first,
        learning=args.learning,
        modes=("deterministic", "sampled") if args.mode == "both" else (args.mode,),
        seed=args.seed,
    )
    dataset = wt.policies.fill_returns(
        locate(args.path),
        config,
        workers=args.workers,
        scheduler=args.scheduler,
        imports=args.imports,
        replace=args.replace,
        console=console,
    )
    for run in dataset:
        if run.evaluation is not None:
            say(f"{run.id}: mean return of the last snapshot {_last_return(run)}")
        for finding in lint_returns(run):
            errors.print(f"[yellow]look:[/yellow] {escape(str(finding))}")


def _last_return(run: wt.Run) -> str:
    modes = {True: "deterministic", False: "sampled"}
    stored = run.evaluation.deterministic if run.evaluation else ()
    values = {modes[m]: run.mean_return(m) for m in (True, False) if m in stored}
    return ", ".join(
        f"{value[np.isfinite(value)][-1]:.1f} ({mode})"
        for mode, value in values.items()
        if np.isfinite(value).any()
    )


@app.command(name="show")
def _show(
    path: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(help="data set (path, id or address) or run")
    ],
) -> None:
    """Print what a data set or a run holds."""
    if is_remote(path):
        is_run = RemotePath.parse(path).name.removesuffix(".zip").endswith(".zarr")
    else:
        place = locate(path)
        is_run = not (place / "dataset.json").is_file() and place.suffix != ".h5"
    if not is_run:
        say(wt.open(path))
        return
    run = wt.open_run(path)
    say(run)
    for array in run.arrays.values():
        say(f"  {array!r}")


@app.command(name="list")
def _list() -> None:
    """List the data sets that can be named by an id here. `show ID` says where one lies."""
    table = Table(title="data sets")
    for column in ("id", "status", "runs", "MB"):
        justify: Literal["left", "right"] = "right" if column in ("runs", "MB") else "left"
        table.add_column(column, justify=justify, overflow="fold", no_wrap=column == "id")
    for dataset in registry.local_datasets():
        try:
            info = dataset.info
            said = [info.status, info.part or str(len(info.runs))]
        except WeightTrajError as error:
            said = [f"damaged: {error.message.splitlines()[0]}", "-"]
        table.add_row(*map(escape, [dataset.id, *said, f"{dataset.size / 1e6:.1f}"]))
    console.print(table)


@app.command(name="search")
def _search(
    query: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            help="a condition, such as \"env == 'HalfCheetah-v4' and final_return > 3000\""
        ),
    ],
    columns: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            help="what is shown of each run; also env, algorithm, n_snapshots, n_params, ..."
        ),
    ] = ("dataset", "run_id", "split", "seed", "final_return"),
) -> None:
    """Find runs of all data sets that are here, by their environment, return, hyper-parameters."""
    found = registry.search(query, damaged=_left_out)
    table = Table(title=f"{len(found)} runs")
    shown = list(columns)
    if len(found) and (unknown := [column for column in columns if column not in found.columns]):
        raise RegistryError(
            "the runs have no such columns",
            expected=", ".join(found.columns),
            got=", ".join(unknown),
            do="choose among these",
        )
    for column in shown:
        table.add_column(column, overflow="fold", no_wrap=column in ("dataset", "run_id"))
    for row in found[shown].itertuples(index=False) if len(found) else ():
        table.add_row(*(escape(_text(value)) for value in row))
    console.print(table)


def _left_out(error: WeightTrajError) -> None:
    errors.print(f"[yellow]left out:[/yellow] {escape(str(error))}")


def _text(value: object) -> str:
    return f"{value:.1f}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, kw_only=True)
class _Create:
    out: tyro.conf.Positional[Path]
    """Folder of the new data set; its name becomes the data set's id."""
    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Finished runs: folders or packed files."""
    split: tuple[str, ...] = ()
    """Parts of the data set: run0=train run1=test; other runs are in no part."""
    version: str = "1"
    """Version of the data."""
    licence: str = "CC-BY-4.0"
    """Licence of the data, as an SPDX identifier."""


@app.command(name="create")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _create(args: _Create) -> None:
    """Make a data set of runs of your own; these stay."""
    pairs = [text.rpartition("=") for text in args.split]
    if wrong := [text for text in args.split if not text.rpartition("=")[0]]:
        raise RegistryError(
            "a part does not say which run is in it",
            expected="RUN_ID=train, RUN_ID=validation or RUN_ID=test",
            got=" ".join(wrong),
            do="give --split run0=train run1=test",
        )
    splits = {run: part for run, _, part in pairs}
    made = registry.create(
        args.runs,
        args.out,
        splits=splits,
        version=args.version,
        licence=args.licence,
        console=console,
    )
    say(made)


@app.command(name="combine")
def _combine(
    paths: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(help="data sets: paths or ids")
    ],
    out: Annotated[Path, tyro.conf.arg(help="folder of the new data set")],
) -> None:
    """Make one data set of the runs of several; these stay."""
    say(registry.combine(paths, out, console=console))


@app.command(name="select")
def _select(
    path: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="data set: path or id")],
    seeds: Annotated[str, tyro.conf.arg(help="seeds of the runs, such as 0:4,30,40:44")],
    out: Annotated[Path, tyro.conf.arg(help="folder of the new data set")],
) -> None:
    """Make a data set of some runs of another one; it says which part it is of what."""
    from weighttraj.collect.settings import parse_seeds

    say(registry.select(path, out, seeds=parse_seeds(seeds), console=console))


@app.command(name="split")
def _split(
    path: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="data set: path or id")],
    out: Annotated[Path, tyro.conf.arg(help="folder of the new data set")],
    fractions: Annotated[
        tuple[float, float, float], tyro.conf.arg(help="of the runs: training, validation, test")
    ] = (0.6, 0.2, 0.2),
    seed: Annotated[int, tyro.conf.arg(help="of the draw")] = 0,
) -> None:
    """Divide the runs of a data set anew, in a new data set."""
    say(registry.split(path, out, fractions=fractions, seed=seed, console=console))


@dataclass(frozen=True, kw_only=True)
class _Download:
    address: tyro.conf.Positional[str]
    """hf://organisation/name, s3://bucket/prefix, gs://, az://, https://, file://."""
    out: Path | None = None
    """Folder to be made. Default: where it is found by its name from then on."""
    runs: tuple[str, ...] | None = None
    """Only these runs, by id."""
    steps: tuple[int, int] | None = None
    """Only snapshots from one environment step to another one."""
    arrays: tuple[str, ...] | None = None
    """Beside the weights only these groups: critic, optimizer, probe, train, ret_norm, eval."""
    revision: str | None = None
    """Branch, tag or commit, on the hub."""


@app.command(name="download")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _download(args: _Download) -> None:
    """Bring a data set here, or a part of it; stopped, the same command goes on."""
    dataset = registry.download(
        args.address,
        args.out,
        runs=args.runs,
        steps=args.steps,
        arrays=args.arrays,
        revision=args.revision,
        console=console,
    )
    say(f"{len(dataset)} runs in {dataset.path}")


@app.command(name="card")
def _card(
    path: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="data set: path or id")],
) -> None:
    """Write the card of a data set, or the facts into the one that is there; and croissant.json."""
    say(f"card in {registry.write_card(path)}")


@dataclass(frozen=True, kw_only=True)
class _Upload:
    path: tyro.conf.Positional[str]
    """Data set (path or id): complete, with a card and a licence."""
    address: tyro.conf.Positional[str]
    """hf://organisation/name, s3://bucket/prefix, gs://, az://, file://."""
    despite_lint: bool = False
    """Publish what looks suspicious; say why in the card."""
    private: bool = False
    """Of a new repository on the hub: only its organisation sees it."""


@app.command(name="upload")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _upload(args: _Upload) -> None:
    """Publish a data set, whole or not at all; stopped, the same command goes on."""
    place = registry.upload(
        args.path,
        args.address,
        despite_lint=args.despite_lint,
        private=args.private,
        console=console,
    )
    say(f"published: {place}")


@app.command(name="delete")
def _delete(
    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="id, as `list` shows it")],
    yes: Annotated[bool, tyro.conf.arg(help="do not ask")] = False,
) -> None:
    """Remove a data set from this machine. There is no way back."""
    place = registry.find(name).path
    if not yes and not _sure(f"remove {name}, all in {place}, from this machine?"):
        raise SystemExit(1)
    say(f"removed {registry.delete(name)}")


def _sure(question: str) -> bool:
    try:
        return Confirm.ask(escape(question), console=console)
    except EOFError:  # nobody is there to be asked
        say("not removed: give --yes where nobody can be asked")
        return False


@dataclass(frozen=True, kw_only=True)
class _Verify:
    path: tyro.conf.Positional[str]
    """Data set (path or id) or run."""
    deep: bool = False
    """Decode every array, also where the manifest vouches for the bytes."""
    replay: int = 0
    """Train so many snapshots of a run again and compare them."""
    seed: int | None = None
    """Which run is trained again. Default: the first."""
    imports: Imports = ()
    """Modules that register environments (my_envs for my_envs.py); each worker imports them."""


@app.command(name="verify")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _verify(args: _Verify) -> None:
    """Is it whole? Exit with 1 if something is missing, damaged or not what it says."""
    import_modules(args.imports)
    path = locate(args.path)
    problems = wt.verify(path, deep=args.deep, console=console)
    if args.replay and not problems:
        problems += wt.collect.replay(path, args.replay, seed=args.seed)
    _finish(path, problems, f"whole{_state_of(path)}")


@app.command(name="lint")
def _lint(
    path: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="data set (path or id) or run")],
) -> None:
    """Is it what it says it is? Look for duplicates, gaps, jumps; exit with 1 on findings."""
    place = locate(path)
    _finish(
        place, [str(finding) for finding in wt.lint(place, console=console)], "nothing suspicious"
    )


@dataclass(frozen=True, kw_only=True)
class _Repair:
    path: tyro.conf.Positional[str]
    """Data set (path or id) or run."""
    cut: bool = False
    """Drop damaged snapshots and those after them; collecting again makes them anew."""


@app.command(name="repair")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _repair(args: _Repair) -> None:
    """Mend what can be mended without training, and say what is left to do."""
    path = locate(args.path)
    for step in wt.repair(path, cut=args.cut):
        say(step)
    _finish(path, wt.verify(path, console=console), f"whole{_state_of(path)}")


@dataclass(frozen=True, kw_only=True)
class _Pack:
    path: tyro.conf.Positional[str]
    """Finished run."""
    profile: Literal["default", "archive"] = "default"
    """``default``: any Zarr v3 reader; ``archive``: smallest, lossless too, needs PCodec."""
    out: Path | None = None
    """File to be written. Default: the run's path and .zip."""


@app.command(name="pack")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _pack(args: _Pack) -> None:
    """Write a finished run into one file; the run itself stays."""
    say(wt.pack(args.path, profile=args.profile, out=args.out))


@dataclass(frozen=True, kw_only=True)
class _Report:
    path: tyro.conf.Positional[str | None] = None
    """Data set (path or id) or run."""
    all: bool = False
    """A gallery: pages of all data sets that `list` shows, of models by their cards, an index."""
    cards: Path | None = None
    """With --all: folder of the cards of models. Default: cards/models of the clone."""
    out: Path | None = None
    """Page to be written, which opens from disk; with --all a folder. An earlier report is
    replaced. Default: report.html, or gallery."""
    film: bool = True
    """A short film of a policy at five moments of its training."""
    seed: int = 0
    """Of the film's episodes."""
    overwrite: bool = False
    """Replace the file, whatever it is."""
    imports: Imports = ()
    """Modules that register environments (my_envs for my_envs.py); each worker imports them."""


@app.command(name="report")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _report(args: _Report) -> None:
    """Write a page that shows what a data set or a run holds: returns, steps, spectrum, film."""
    import_modules(args.imports)
    if args.all:
        _gallery(args)
        return
    if args.path is None:
        errors.print("[red]error:[/red] name a data set, or give --all for all that are here")
        raise SystemExit(2)
    from weighttraj.publish.report import report

    say(
        report(
            locate(args.path),
            args.out or Path("report.html"),
            film=args.film,
            seed=args.seed,
            overwrite=args.overwrite,
            console=console,
        )
    )


def _gallery(args: _Report) -> None:
    from weighttraj.publish.gallery import gallery

    own = clone()
    cards = args.cards or (own.parent / "cards/models" if own else Path("none"))
    datasets = {dataset.id: dataset.path for dataset in registry.local_datasets()}
    out = args.out or Path("gallery")
    models = sorted(cards.glob("*.md"))
    say(gallery(datasets, out, cards=models, film=args.film, console=console))


@dataclass(frozen=True, kw_only=True)
class _Export:
    path: tyro.conf.Positional[str]
    """Run; for hdf5 also a data set."""
    to: Literal["hdf5", "npy", "safetensors", "sb3"]
    """hdf5: one file with everything; npy: weights.npy and tables; safetensors: one snapshot;
    sb3: one snapshot as a model that PPO.load reads, and its VecNormalize."""
    out: Path
    """File (hdf5, safetensors) or folder (npy, sb3) to be written."""
    t: int = -1
    """Which snapshot. Default: the last."""


@app.command(name="export")
@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def _export(args: _Export) -> None:
    """Write a run for other programs."""
    if args.to == "hdf5":
        say(wt.export_hdf5(locate(args.path), args.out))
        return
    run = wt.open_run(args.path)
    if args.to == "npy":
        say(wt.export_npy(run, args.out))
    elif args.to == "safetensors":
        say(wt.export_safetensors(run, args.t, args.out))
    else:
        say(wt.policies.export_sb3(run, args.t, args.out))


@app.command(name="import")
def _import(
    file: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="HDF5 file of an export")],
    out: Annotated[Path, tyro.conf.arg(help="folder of the data set to be written")],
) -> None:
    """Make a data set of an HDF5 file that `export` wrote; every digest is checked."""
    say(wt.open(wt.import_hdf5(here(file), out)))


@app.command(name="cache")
def _cache(
    clear: Annotated[bool, tyro.conf.arg(help="remove every decoded run")] = False,
) -> None:
    """Where decoded runs are kept for training, and how large that is."""
    from weighttraj.load import cache_folder, cache_size, clear_cache

    size = clear_cache() if clear else cache_size()
    say(f"{cache_folder()}: {size / 1e6:.1f} MB{' removed' if clear else ''}")


def _state_of(path: Path) -> str:
    """What remains to be said of something whole: it may not be finished."""
    if not (path / "dataset.json").is_file():
        info = wt.open_run(path).info
        if info.status == "complete":
            return ""
        return (
            f" so far; {info.n_committed} snapshots are committed, and the run is not finished "
            f"({info.status})"
        )
    dataset = wt.open(path)
    if dataset.info.status == "complete":
        return ""
    done = sum(run.info.status == "complete" for run in dataset)
    return f" so far; {done} of {len(dataset.info.runs)} runs are complete"


def _finish(path: Path, problems: list[str], otherwise: str) -> None:
    for problem in problems:
        say(problem)
    say(f"{path}: {f'{len(problems)} problems' if problems else otherwise}")
    if problems:
        raise SystemExit(1)


def main() -> None:
    """Run the command line; errors of ours are printed without a traceback."""
    try:
        with while_read():
            if sys.argv[1:] == ["--version"]:
                say(f"weighttraj {wt.__version__}")
                return
            app.cli(prog="weighttraj", description="Policy weight trajectories as data.")
    except (WeightTrajError, OSError) as error:
        errors.print(f"[red]error:[/red] {escape(str(error))}")
        sys.exit(1)
    except KeyboardInterrupt:
        errors.print("stopped; give the same command again to go on")
        sys.exit(130)


if __name__ == "__main__":
    main()
