"""The command ``weighttraj``. Options and their help come from the functions' signatures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.markup import escape
from rich.prompt import Confirm
from rich.table import Table
from tyro.conf import Positional

import weighttraj as wt
from weighttraj import registry
from weighttraj.errors import RegistryError, WeightTrajError
from weighttraj.locate import COLLECTED, clone, locate
from weighttraj.overview import status_of
from weighttraj.plugins import import_modules
from weighttraj.remote import RemotePath, here, is_remote
from weighttraj.terminal import Output, say, while_read
from weighttraj.tools.lint import lint_returns

Imports = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        name="import",
        metavar="MODULE ...",
        help="Modules that register environments (my_envs for my_envs.py); each worker imports "
        "them.",
    ),
]
Scheduler = Annotated[
    str | None,
    tyro.conf.arg(
        help="Address of a Dask cluster, tcp://host:port, or `local` for one with --workers "
        "processes on this machine."
    ),
]

# What an argument is called in the help.
DataOrRun = Annotated[Positional[str], tyro.conf.arg(metavar="DATA_OR_RUN")]
Data = Annotated[Positional[str], tyro.conf.arg(metavar="DATASET")]
OneRun = Annotated[Positional[str], tyro.conf.arg(metavar="RUN")]
Address = Annotated[Positional[str], tyro.conf.arg(metavar="ADDRESS")]

app = tyro.extras.SubcommandApp()
console = Output()
errors = Output(stderr=True)


@app.command(name="collect")
def _collect(
    recipe: Annotated[Positional[Path], tyro.conf.arg(metavar="RECIPE")],
    out: Path | None = None,
    seeds: str | None = None,
    workers: int = 1,
    scheduler: Scheduler = None,
    imports: Imports = (),
) -> None:
    """Train the runs of a recipe and store their snapshots; continue if it was stopped.

    Args:
        recipe: Recipe, a TOML file such as datasets/demo/recipe.toml.
        out: Folder of the data set; unset: data/<id of the recipe>.
        seeds: Only these seeds: 3, a range 0:50 (the end excluded), or several: 0:4,30:32; unset:
            all seeds of the recipe.
        workers: Number of processes; each trains one run, or one population, at a time.
    """
    from weighttraj.collect.settings import parse_seeds

    import_modules(imports)  # the recipe may name an environment of theirs
    read = wt.collect.read_recipe(here(recipe))
    out = out or Path(COLLECTED) / read.id
    dataset = wt.collect.collect(
        read,
        out,
        seeds=None if seeds is None else parse_seeds(seeds),
        workers=workers,
        scheduler=scheduler,
        imports=imports,
        console=console,
    )
    say(dataset)
    say(f"data set in {out}")


@app.command(name="returns")
def _returns(
    path: DataOrRun,
    episodes: int = 10,
    every: int = 10,
    first: int = 0,
    learning: int = 0,
    mode: Literal["both", "deterministic", "sampled"] = "both",
    seed: int = 0,
    workers: int = 1,
    scheduler: Scheduler = None,
    imports: Imports = (),
    replace: bool = False,
) -> None:
    """Play the stored policies and store their returns in the runs; continue if it was stopped.

    Args:
        path: Data set (path or id) or run.
        episodes: Episodes for each action mode; the same seeds for every policy.
        every: Evaluate every N-th snapshot, and the last one.
        first: Also evaluate each of the first N snapshots; policies change most at the start.
        learning: Also evaluate every N-th snapshot of the learning phase, up to 95 % of the way
            from the first to the final return; 0: none.
        mode: Take deterministic actions (the mode of the distribution), sampled ones, or both.
        seed: Seed of the first episode.
        workers: Number of processes; each has one thread.
        replace: Replace stored returns of other episodes or of other versions of the physics.
    """
    config = wt.policies.ReturnsConfig(
        episodes=episodes,
        every=every,
        first=first,
        learning=learning,
        modes=("deterministic", "sampled") if mode == "both" else (mode,),
        seed=seed,
    )
    dataset = wt.policies.fill_returns(
        locate(path),
        config,
        workers=workers,
        scheduler=scheduler,
        imports=imports,
        replace=replace,
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
def _show(path: DataOrRun) -> None:
    """Print what a data set or a run holds.

    Args:
        path: Data set (path, id or address) or run.
    """
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
    """List the local data sets by id. `show ID` prints the path of one."""
    table = Table(title="data sets")
    for column in ("id", "status", "runs", "MB"):
        justify: Literal["left", "right"] = "right" if column in ("runs", "MB") else "left"
        table.add_column(column, justify=justify, overflow="fold", no_wrap=column == "id")
    for dataset in registry.local_datasets():
        try:
            info = dataset.info
            said = [status_of(info), info.part or str(len(info.runs))]
        except WeightTrajError as error:
            said = [f"damaged: {error.message.splitlines()[0]}", "-"]
        table.add_row(*map(escape, [dataset.id, *said, f"{dataset.size / 1e6:.1f}"]))
    console.print(table)


@app.command(name="search")
def _search(
    query: Annotated[Positional[str], tyro.conf.arg(metavar="CONDITION")],
    columns: tuple[str, ...] = ("dataset", "run_id", "split", "seed", "final_return"),
) -> None:
    """Find runs in all local data sets by environment, return and hyper-parameters.

    Args:
        query: Condition, such as "env == 'HalfCheetah-v4' and final_return > 3000"
        columns: Columns of the table; others are env, algorithm, n_snapshots, n_params, ...
    """
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


@app.command(name="create")
def _create(
    out: Annotated[Positional[Path], tyro.conf.arg(metavar="FOLDER")],
    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN [RUN ...]")],
    split: tuple[str, ...] = (),
    version: str = "1",
    licence: str = "CC-BY-4.0",
) -> None:
    """Make a data set from runs of your own; the runs themselves stay.

    Args:
        out: Folder of the new data set; its name is the id.
        runs: Finished runs: folders or packed files.
        split: Split of each run: run0=train run1=test; other runs are in no split.
        version: Version of the data.
        licence: Licence of the data, as an SPDX identifier.
    """
    pairs = [text.rpartition("=") for text in split]
    if wrong := [text for text in split if not text.rpartition("=")[0]]:
        raise RegistryError(
            "a part does not say which run is in it",
            expected="RUN_ID=train, RUN_ID=validation or RUN_ID=test",
            got=" ".join(wrong),
            do="give --split run0=train run1=test",
        )
    splits = {run: part for run, _, part in pairs}
    say(
        registry.create(runs, out, splits=splits, version=version, licence=licence, console=console)
    )


@app.command(name="combine")
def _combine(
    paths: Annotated[Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATASET [DATASET ...]")],
    out: Path,
) -> None:
    """Join the runs of several data sets in a new one; the old ones stay.

    Args:
        paths: Data sets: paths or ids.
        out: Folder of the new data set.
    """
    say(registry.combine(paths, out, console=console))


@app.command(name="select")
def _select(path: Data, seeds: str, out: Path) -> None:
    """Make a data set from some runs of another one; it records which part of it.

    Args:
        path: Data set: path or id.
        seeds: Seeds of the runs, such as 0:4,30,40:44.
        out: Folder of the new data set.
    """
    from weighttraj.collect.settings import parse_seeds

    say(registry.select(path, out, seeds=parse_seeds(seeds), console=console))


@app.command(name="split")
def _split(
    path: Data,
    out: Path,
    fractions: tuple[float, float, float] = (0.6, 0.2, 0.2),
    seed: int = 0,
) -> None:
    """Make a data set with the same runs and another split.

    Args:
        path: Data set: path or id.
        out: Folder of the new data set.
        fractions: Shares of the runs for train, validation and test.
        seed: Seed of the draw.
    """
    say(registry.split(path, out, fractions=fractions, seed=seed, console=console))


@app.command(name="download")
def _download(
    address: Address,
    out: Path | None = None,
    runs: tuple[str, ...] | None = None,
    steps: tuple[int, int] | None = None,
    arrays: tuple[str, ...] | None = None,
    revision: str | None = None,
) -> None:
    """Download a data set or a part of it; continue if it was stopped.

    Args:
        address: hf://organisation/name, s3://bucket/prefix, gs://, az://, https://, file://.
        out: New folder; unset: a folder in which `wt.open` finds it by its id.
        runs: Download only these runs, by id.
        steps: Download only snapshots from one environment step to another.
        arrays: Download only these groups beside the weights: critic, optimizer, probe, train,
            ret_norm, eval.
        revision: Branch, tag or commit, on the hub.
    """
    dataset = registry.download(
        address, out, runs=runs, steps=steps, arrays=arrays, revision=revision, console=console
    )
    say(f"{len(dataset)} runs in {dataset.path}")


@app.command(name="card")
def _card(path: Data) -> None:
    """Write the card and croissant.json of a data set; prose in an existing card stays.

    Args:
        path: Data set: path or id.
    """
    say(f"card in {registry.write_card(path)}")


@app.command(name="upload")
def _upload(
    path: Data,
    address: Address,
    despite_lint: bool = False,
    private: bool = False,
) -> None:
    """Publish a data set at an address, whole or not at all; continue if it was stopped.

    Args:
        path: Data set (path or id). It must be complete and have a card and a licence.
        address: hf://organisation/name, s3://bucket/prefix, gs://, az://, file://.
        despite_lint: Publish although `lint` reports something; say why in the card.
        private: Make a new repository on the hub private.
    """
    place = registry.upload(
        path, address, despite_lint=despite_lint, private=private, console=console
    )
    say(f"published: {place}")


@app.command(name="delete")
def _delete(name: Data, yes: bool = False) -> None:
    """Remove a data set from this machine; this cannot be undone.

    Args:
        name: Id, as `list` shows it.
        yes: Do not ask.
    """
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


@app.command(name="verify")
def _verify(
    path: DataOrRun,
    deep: bool = False,
    replay: int = 0,
    seed: int | None = None,
    imports: Imports = (),
) -> None:
    """Check that data are complete and undamaged; exit with 1 if they are not.

    Args:
        path: Data set (path or id) or run.
        deep: Decode every array, also if the manifest has the checksum of its file.
        replay: Number of snapshots of a run to train again and compare; 0: none.
        seed: Seed of the run that is trained again; unset: the first run.
    """
    import_modules(imports)
    place = locate(path)
    problems = wt.verify(place, deep=deep, console=console)
    if replay and not problems:
        problems += wt.collect.replay(place, replay, seed=seed)
    _finish(place, problems, f"whole{_state_of(place)}")


@app.command(name="lint")
def _lint(path: DataOrRun) -> None:
    """Look for suspicious data: duplicates, gaps, jumps; exit with 1 if there are any.

    Args:
        path: Data set (path or id) or run.
    """
    place = locate(path)
    findings = [str(finding) for finding in wt.lint(place, console=console)]
    _finish(place, findings, "nothing suspicious")


@app.command(name="repair")
def _repair(path: DataOrRun, cut: bool = False) -> None:
    """Repair what can be repaired without training, and print what is left to do.

    Args:
        path: Data set (path or id) or run.
        cut: Remove damaged snapshots and later ones; `collect` trains them again.
    """
    place = locate(path)
    for step in wt.repair(place, cut=cut):
        say(step)
    _finish(place, wt.verify(place, console=console), f"whole{_state_of(place)}")


@app.command(name="pack")
def _pack(
    path: OneRun,
    profile: Literal["default", "archive"] = "default",
    out: Path | None = None,
) -> None:
    """Write a finished run into one zip file; the run itself stays.

    Args:
        path: Finished run.
        profile: `default` is for every Zarr v3 reader; `archive` is smaller and needs PCodec.
        out: New file; unset: the path of the run with .zip.
    """
    say(wt.pack(path, profile=profile, out=out))


@app.command(name="report")
def _report(
    path: Annotated[Positional[str | None], tyro.conf.arg(metavar="[DATA_OR_RUN]")] = None,
    all: bool = False,
    cards: Path | None = None,
    out: Path | None = None,
    film: bool = True,
    seed: int = 0,
    overwrite: bool = False,
    imports: Imports = (),
) -> None:
    """Write a page about a data set or a run: returns, step sizes, spectrum, an animation.

    Args:
        path: Data set (path or id) or run.
        all: Write a gallery: a page for each local data set and each model card, and an index.
        cards: Folder of the model cards, with --all; unset: cards/models of the clone.
        out: New page, or folder with --all; replaces an earlier report; unset: report.html or
            gallery.
        film: Add a short animation of a policy at five moments of its training.
        seed: Seed of the episodes in the animation.
        overwrite: Replace any existing file.
    """
    import_modules(imports)
    if all:
        _gallery(cards, out or Path("gallery"), film)
        return
    if path is None:
        errors.print("[red]error:[/red] name a data set, or give --all for all that are here")
        raise SystemExit(2)
    from weighttraj.publish.report import report

    page = out or Path("report.html")
    say(report(locate(path), page, film=film, seed=seed, overwrite=overwrite, console=console))


def _gallery(cards: Path | None, out: Path, film: bool) -> None:
    from weighttraj.publish.gallery import gallery

    own = clone()
    cards = cards or (own.parent / "cards/models" if own else Path("none"))
    datasets = {dataset.id: dataset.path for dataset in registry.local_datasets()}
    models = sorted(cards.glob("*.md"))
    say(gallery(datasets, out, cards=models, film=film, console=console))


@app.command(name="export")
def _export(
    path: DataOrRun,
    to: Literal["hdf5", "npy", "safetensors", "sb3"],
    out: Path,
    t: int = -1,
) -> None:
    """Write a run, a snapshot or a data set for other programs.

    Args:
        path: Run; for hdf5 also a data set.
        to: hdf5: one file with everything; npy: weights.npy and tables; safetensors: one snapshot;
            sb3: one snapshot as a model that PPO.load reads, and its VecNormalize.
        out: File (hdf5, safetensors) or folder (npy, sb3) to be written.
        t: Index of the snapshot; unset: the last.
    """
    if to == "hdf5":
        say(wt.export_hdf5(locate(path), out))
        return
    run = wt.open_run(path)
    if to == "npy":
        say(wt.export_npy(run, out))
    elif to == "safetensors":
        say(wt.export_safetensors(run, t, out))
    else:
        say(wt.policies.export_sb3(run, t, out))


@app.command(name="import")
def _import(file: Annotated[Positional[str], tyro.conf.arg(metavar="FILE")], out: Path) -> None:
    """Make a data set from an HDF5 file of `export`; every checksum is verified.

    Args:
        file: HDF5 file that `export` wrote.
        out: Folder of the new data set.
    """
    say(wt.open(wt.import_hdf5(here(file), out)))


@app.command(name="cache")
def _cache(clear: bool = False) -> None:
    """Print the folder and the size of the cache of decoded runs.

    Args:
        clear: Remove all decoded runs.
    """
    from weighttraj.load import cache_folder, cache_size, clear_cache

    size = clear_cache() if clear else cache_size()
    say(f"{cache_folder()}: {size / 1e6:.1f} MB{' removed' if clear else ''}")


def _state_of(path: Path) -> str:
    """Return what remains to be said of something whole: it may not be finished."""
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
            app.cli(
                prog="weighttraj",
                description="Record, store and load the weights of policies in training. Each "
                "command explains its options with --help. --version prints the version.",
            )
    except (WeightTrajError, OSError) as error:
        errors.print(f"[red]error:[/red] {escape(str(error))}")
        sys.exit(1)
    except KeyboardInterrupt:
        errors.print("stopped; give the same command again to go on")
        sys.exit(130)


if __name__ == "__main__":
    main()
