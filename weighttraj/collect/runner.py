"""From a recipe to a data set: runs spread over workers, and on again where it stopped."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal, cast

from filelock import Timeout
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from weighttraj.atomic import lock_of, refuse_link
from weighttraj.collect.costs import measured
from weighttraj.collect.recipe import Recipe
from weighttraj.collect.settings import parse_seeds
from weighttraj.collect.tasks import Failure, Report, Task, blocks_of, collect_block
from weighttraj.dataset import Dataset
from weighttraj.engine import Engine, engine_of
from weighttraj.errors import CollectError, RecipeError, ReplayError, WeightTrajError
from weighttraj.format import DatasetInfo, RunEntry, RunInfo
from weighttraj.opening import open_dataset
from weighttraj.plugins import import_modules
from weighttraj.progress import LoggedProgress
from weighttraj.remote.address import new_path
from weighttraj.store.catalog import MANIFEST, read_dataset_info, write_dataset_info
from weighttraj.store.zarr_run import PACKED, read_info
from weighttraj.tools.repair import seal


def collect(
    recipe: Recipe,
    out: str | Path,
    *,
    seeds: list[int] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    imports: Sequence[str] = (),
    console: Console | None = None,
) -> Dataset:
    """Collect the runs of a recipe that do not exist yet.

    Complete runs are left alone. An interrupted run is repeated from its seed: as long as it
    repeats its committed snapshots it is continued after the last of them; if it does not (another
    machine, other versions), it starts over under a new id and the old one stays on disk.

    Args:
        recipe: what to collect.
        out: folder of the data set.
        seeds: only these; seeds that the recipe does not name belong to no split.
        workers: processes; 1 means this one. Each trains one run at a time, or a population.
        scheduler: address of a Dask scheduler whose workers do it instead, or ``local``; see
            ``weighttraj.engine``. The bytes are the same.
        imports: modules that register environments; every worker imports them.
        console: where progress is shown; None: nowhere.

    Raises:
        CollectError: the folder holds another data set, or a run failed.
        EngineError: there are no workers, or no scheduler answers.
        RecipeError: there can be no such runs, or none are asked for.
        KeyboardInterrupt: it was stopped; what was committed stays.
    """
    import_modules(imports)
    recipe.check()
    wanted = set(recipe.splits() if seeds is None else parse_seeds(seeds))
    if not wanted:
        raise RecipeError(
            "there is nothing to collect",
            expected="seeds, in the recipe's [seeds] or from --seeds",
            where=f"recipe {recipe.id!r}",
            do="name seeds in one of them",
        )
    out = new_path(out).absolute()
    console = console or Console(quiet=True)
    # The engine is closed first: then the seconds of its processes are known.
    with (
        measured(out, lambda: _packed_seeds(out)),
        engine_of(workers, scheduler, imports) as engine,
    ):
        out.mkdir(parents=True, exist_ok=True)
        with _lock(out, console):
            info = _prepare(recipe, out, seeds)
        entries = [run for run in info.runs if run.seed in wanted]
        tasks, failures = _plan(recipe, out, entries, console)
        failures += _run(tasks, engine, console)
        with _lock(out, console):
            again = [
                _start_over(out, task, error, console) for task, error in _mismatches(failures)
            ]
        failures = [f for f in failures if not isinstance(f[1], ReplayError)]
        failures += _run(again, engine, console)
    with _lock(out, console):
        _settle(out)
    if failures:
        raise CollectError(
            f"{len(failures)} of {len(wanted)} runs failed; the others are whole",
            got="\n".join(f"seed {task.seed}: {error}" for task, error in failures),
            where=out,
            do="mend the cause and give the same command again: it goes on where it stopped",
        )
    return open_dataset(out)


def _prepare(recipe: Recipe, out: Path, seeds: list[int] | None) -> DatasetInfo:
    """Write ``dataset.json`` with every run that will be there."""
    document = json.loads(json.dumps(asdict(recipe))) | {"seeds": recipe.seeds.by_split()}
    old = None
    info = DatasetInfo(
        id=recipe.id, version=recipe.version, licence=recipe.licence, recipe=document
    )
    if (out / "dataset.json").exists():
        old = read_dataset_info(out)
        # Keys that are younger than the data set were at what is today their default.
        default = _flat(json.loads(json.dumps(asdict(Recipe(id="")))))
        before, now = (default | _flat(recipe) for recipe in (old.recipe, document))
        changed = sorted(k for k in before | now if before.get(k) != now.get(k))
        other = [k for k in changed if not k.startswith("seeds.") and k != "collect.population"]
        if other:
            raise CollectError(
                "the folder holds a data set of another recipe",
                expected={key: before.get(key) for key in other},
                got={key: now.get(key) for key in other},
                where=out,
                do="choose another folder with --out",
            )
        info = replace(old, recipe=document) if changed else old
    elif out.exists() and any(not path.name.startswith(".") for path in out.iterdir()):
        raise CollectError(
            "the folder is not empty and holds no data set",
            expected="a new or empty folder, or one with dataset.json",
            got=sorted(p.name for p in out.iterdir())[:5],
            where=out,
            do="choose another folder with --out",
        )
    splits = recipe.splits()
    known = {run.seed: run for run in info.runs}
    for seed in sorted({*splits, *(seeds or ())}):
        if seed not in known:
            name = f"seed{seed:04d}"
            known[seed] = RunEntry(id=name, path=f"runs/{name}.zarr", seed=seed)
        split = cast(Literal["train", "validation", "test", ""], splits.get(seed, ""))
        known[seed] = replace(known[seed], split=split)
    runs = tuple(_settled(out, run) for run in known.values())
    info = replace(info, runs=runs)
    if info != old:
        (out / MANIFEST).unlink(missing_ok=True)
        info = replace(info, status="collecting")
        write_dataset_info(out, info)
    return info


def _settled(out: Path, entry: RunEntry) -> RunEntry:
    """The entry of a run, packed if it is finished; its folder goes once the file is listed."""
    folder = entry.path.removesuffix(PACKED)
    packed = f"{folder}{PACKED}"
    for name in (folder, packed):
        refuse_link(out / name, out)  # what a link leads to is not written, nor removed
    if not (out / packed).is_file():
        return entry
    if entry.path == packed and (out / folder).is_dir():
        shutil.rmtree(out / folder)
        (out / f"{folder}.lock").unlink(missing_ok=True)
    return replace(entry, path=packed)


def _packed_seeds(out: Path) -> list[int]:
    """Return the seeds of the runs that are finished; none if there is no data set yet."""
    if not (out / "dataset.json").is_file():
        return []
    runs = read_dataset_info(out).runs
    files = {run.seed: f"{run.path.removesuffix(PACKED)}{PACKED}" for run in runs}
    return [seed for seed, name in files.items() if seed is not None and (out / name).is_file()]


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """``{"ppo": {"gamma": 0.9}}`` as ``{"ppo.gamma": 0.9}``."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat


def _run(tasks: list[Task], engine: Engine, console: Console) -> list[Failure]:
    """Do the tasks; return those that failed."""
    if not tasks:
        return []
    failures: list[Failure] = []
    with _progress(tasks, console) as report:
        blocks = blocks_of(tasks, engine.workers)
        for block, outcome in engine.run(collect_block, blocks, report):
            if isinstance(outcome, Exception):
                failures += [(task, outcome) for task in block]
            else:
                failures += outcome
    return failures


@contextlib.contextmanager
def _progress(tasks: list[Task], console: Console) -> Iterator[Report]:
    """One bar a run."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("environment steps,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with LoggedProgress(*columns, console=console) as progress:
        config = tasks[0].recipe.ppo
        total = config.n_iterations * config.n_steps
        bars = {t.seed: progress.add_task(f"seed {t.seed}", total=total) for t in tasks}
        yield lambda seed, steps: progress.update(bars[seed], completed=steps)


def _plan(
    recipe: Recipe, out: Path, entries: list[RunEntry], console: Console
) -> tuple[list[Task], list[Failure]]:
    """Return runs that are still to be made, and those that cannot be read."""
    tasks: list[Task] = []
    unreadable: list[Failure] = []
    for entry in entries:
        task = Task(recipe=recipe, seed=cast(int, entry.seed), path=out / entry.path)
        try:
            info = read_info(task.path) if task.path.exists() else None
        except (WeightTrajError, FileNotFoundError) as error:
            unreadable.append((task, error))
            continue
        console.print(f"seed {task.seed}: {_progress_of(info)}")
        if not entry.path.endswith(PACKED):
            tasks.append(task)
    return tasks, unreadable


def _progress_of(info: RunInfo | None) -> str:
    if info is None:
        return "to be collected"
    if info.status == "complete":
        return f"complete, {info.n_committed} snapshots"
    return (
        f"interrupted after {info.n_committed} committed snapshots: repeating the seed, "
        "comparing them, continuing after the last"
    )


def _mismatches(failures: list[Failure]) -> list[tuple[Task, ReplayError]]:
    return [(task, error) for task, error in failures if isinstance(error, ReplayError)]


def _start_over(out: Path, task: Task, error: ReplayError, console: Console) -> Task:
    """Give a run that could not be continued a new id in the data set."""
    info = read_dataset_info(out)
    old = next(run for run in info.runs if run.seed == task.seed)
    n = 2
    while list(out.glob(f"runs/seed{task.seed:04d}-{n}.zarr*")):
        n += 1
    name = f"seed{task.seed:04d}-{n}"
    new = replace(old, id=name, path=f"runs/{name}.zarr")
    write_dataset_info(out, replace(info, runs=tuple(new if r is old else r for r in info.runs)))
    console.print(
        f"seed {task.seed}: {error}\n"
        f"seed {task.seed}: starting over as {name}; what it had committed stays in {old.path}",
        markup=False,
    )
    return replace(task, path=out / new.path)


@contextlib.contextmanager
def _lock(out: Path, console: Console) -> Iterator[None]:
    """Held while ``dataset.json`` is read and written: several may collect into one data set."""
    place = out.resolve()  # as of who evaluates it
    lock = lock_of(place.with_name(f".{place.name}.lock"))
    try:
        lock.acquire(timeout=1)
    except Timeout:
        said = f"waiting for another process, which is changing {out}: its returns, say"
        console.print(said, markup=False)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def _settle(out: Path) -> None:
    """List the packed runs, drop their folders, and seal the data set if it has all its runs."""
    info = read_dataset_info(out)
    info = replace(info, runs=tuple(_settled(out, run) for run in info.runs))
    done = all(run.path.endswith(PACKED) for run in info.runs)
    now = replace(info, status="complete" if done else "collecting")
    if now != read_dataset_info(out):
        write_dataset_info(out, now)
    for run in info.runs:
        _settled(out, run)
    if done and not (out / MANIFEST).is_file():
        seal(out)
