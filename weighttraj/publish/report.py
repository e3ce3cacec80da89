"""One page that shows what a data set of weight trajectories holds. Opens from disk, as it is."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from weighttraj.atomic import refuse_existing, replace_file
from weighttraj.errors import StoreExistsError, WeightTrajError, needs
from weighttraj.progress import LoggedProgress
from weighttraj.publish import figures
from weighttraj.publish.curves import (
    KINDS,
    NAMES,
    best_returns,
    curves,
    filled,
    final_return,
)
from weighttraj.publish.source import (
    Source,
    facts,
    lead,
    number,
    open_source,
    run_rows,
    settings,
    size,
)
from weighttraj.publish.svg import Picture, power
from weighttraj.publish.walk import Walk, rank_for, walk
from weighttraj.run import Run
from weighttraj.text import printable

MARK = '<meta name="generator" content="weighttraj report">'
"""Stands at the top of every page that this module writes, and lets it be written again."""

MAX_PATHS = 6
"""Runs whose paths are shown; of more, evenly spaced ones from the lowest final return up."""

_SHARES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_FILM_STAGES = 3  # as film.STAGES, which needs the simulator
_LEFT_OUT = "It was left out."


def report(
    path: str | Path,
    out: str | Path,
    *,
    film: bool = True,
    seed: int = 0,
    overwrite: bool = False,
    console: Console | None = None,
) -> Path:
    """Write the page of a data set or a run.

    The same data give the same bytes, on the same machine and with the same versions: the film
    plays episodes of MuJoCo.

    Args:
        path: data set (a folder or ``.h5``) or run.
        out: file to be written. A page that this function wrote is replaced.
        film: with a short film of a policy at five moments of training; needs the extra ``sb3``.
        seed: of the film's episodes.
        overwrite: replace whatever file is there.
        console: where progress is shown; None: nowhere.

    Returns:
        The file.

    Raises:
        StoreExistsError: there is another file, or a folder.
        FileNotFoundError: there is no data at the path.
        FormatError: it is none of this format, or there is no snapshot in it yet.
        DamageError: the data are damaged.
    """
    out = Path(out)
    refuse_foreign(out, overwrite)
    source = open_source(path)
    with _progress(console) as progress:
        page = _page(source, film=film, seed=seed, progress=progress)
    refuse_foreign(out, overwrite)  # it took a while
    out.parent.mkdir(parents=True, exist_ok=True)
    replace_file(out, page.encode())
    return out


def refuse_foreign(out: Path, overwrite: bool) -> None:
    """Only pages of ours are replaced.

    Raises:
        StoreExistsError: there is another file, or a folder.
    """
    if not out.is_file():
        refuse_existing(out)
        return
    with out.open("rb") as file:
        ours = MARK.encode() in file.read(1000)
    if not (ours or overwrite):
        raise StoreExistsError(
            "the file to be written exists, and is no report",
            expected="a new path, or a page that this command wrote",
            got=f"a file of {size(out.stat().st_size)}",
            where=out,
            do="choose another path, or replace it with --overwrite",
        )


def _progress(console: Console | None) -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:.0f} %,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    return LoggedProgress(*columns, console=console)


def _page(source: Source, *, film: bool, seed: int, progress: Progress) -> str:
    runs = [run for run in source.runs if len(run)]
    reading = progress.add_task("reading weights", total=sum(map(len, runs)) or 1)
    playing = progress.add_task("making the film", total=_FILM_STAGES) if film else None
    walks = [walk(run, lambda rows: progress.advance(reading, rows)) for run in runs]
    movie, why_not = None, _LEFT_OUT if not film else "There is no snapshot yet."
    if playing is not None and runs:
        typical = _typical(runs)
        if walks[typical].broken.size:
            why_not = f"Run {runs[typical].id} has weights that are NaN or infinite."
        else:
            movie, why_not = _film(runs[typical], seed, progress, playing)
    return template("report.html.j2").render(
        mark=MARK,
        source=source,
        lead=lead(source),
        facts=facts(source),
        rows=run_rows(source.runs),
        settings=settings(source),
        film=movie,
        why_not=why_not,
        broken=[_broken(run, w) for run, w in zip(runs, walks, strict=True) if w.broken.size],
        **_returns(runs),
        **_weights(runs, walks),
    )


def _broken(run: Run, walk: Walk) -> str:
    """Say which snapshots of a run cannot be shown."""
    return (
        f"Run {run.id}: {walk.broken.size:,} of {len(run):,} snapshots have weights that are NaN "
        f"or infinite, the first at t = {walk.broken[0]:,}. They are left out of the figures of "
        "steps, spectrum and path."
    )


def template(name: str) -> jinja2.Template:
    """Return a template of a page; text that may be a stranger's is escaped in it."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("weighttraj.publish", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
        finalize=shown,
    ).get_template(name)


def shown(value: Any) -> Any:
    """What a page shows of a value: text that may be a stranger's, without control characters."""
    return printable(value, lines=True) if type(value) is str else value


def _returns(runs: Sequence[Run]) -> dict[str, Any]:
    """Return learning curves; those of training episodes only where nothing else is stored."""
    pictures: list[Picture] = []
    table = []
    for kind in KINDS:
        lines = curves(runs, kind) if kind != "training" or not pictures else []
        if lines:
            pictures.append(figures.returns(lines, kind))
            final = [float(line.returns[-1]) for line in lines]
            best = [float(line.returns.max()) for line in lines]
            table.append((kind, len(lines), _quartiles(final), _quartiles(best)))
    return {
        "returns": pictures,
        "played": _played(runs),
        "stored_returns": any(kind != "training" for kind, *_ in table),
        "returns_table": table,
        "final_kind": " or the ".join(dict.fromkeys(NAMES[final_return(r)[1]] for r in runs)),
    }


def _played(runs: Sequence[Run]) -> list[str]:
    """Return how the stored episodes were played, each way once."""
    ways = []
    for run in runs:
        if (said := run.evaluation) is not None:
            episodes = max(said.deterministic.count(mode) for mode in (True, False))
            snapshots = (
                f"of every {said.every}th snapshot" if said.every > 1 else "of every snapshot"
            )
            whose = "its own" if said.normalizer == "own" else "the run's last"
            ways.append(f"{episodes} episodes {snapshots}, each with {whose} normaliser")
    return list(dict.fromkeys(ways))


def _weights(runs: Sequence[Run], walks: Sequence[Walk]) -> dict[str, Any]:
    """Figures and numbers of steps, spectrum and path; None where nothing moved."""
    moved = [i for i, w in enumerate(walks) if w.moved]
    some, phases = [walks[i] for i in moved], [runs[i].phase for i in moved]
    if not some:
        return dict.fromkeys(("steps", "spectrum", "paths")) | {"phases": [], "ranks": []}
    return {
        "steps": figures.step_sizes(some, phases),
        "still_steps": sum(int((w.steps == 0).sum()) for w in some),
        "phases": figures.phase_table(some, phases),
        "spectrum": [figures.spectra(some), figures.tails(some)],
        "sampled": _sampled(some, [len(runs[i]) for i in moved]),
        "ranks": _ranks(some),
        **_paths([runs[i] for i in moved], some),
    }


def _paths(runs: Sequence[Run], walks: Sequence[Walk]) -> dict[str, Any]:
    """Return the paths of some runs, with one scale of colours for all."""
    order = np.argsort([np.nan_to_num(final_return(run)[0]) for run in runs], kind="stable")
    some = sorted(order[np.unique(np.linspace(0, len(runs) - 1, MAX_PATHS).round().astype(int))])
    found = [best_returns(runs[i]) for i in some]
    kinds = {f[1] for f in found if f is not None}
    if len(kinds) == 1 and None not in found:
        what = NAMES[kinds.pop()]
        values = [filled(f[0]) for f in found if f is not None]
    else:
        what, values = "snapshot t", [np.arange(len(runs[i]), dtype=np.float64) for i in some]
    low = min(float(np.nanmin(v)) for v in values)
    high = max(float(np.nanmax(v)) for v in values)
    pictures = [
        figures.path(runs[i].id, walks[i], v, (low, high), what)
        for i, v in zip(some, values, strict=True)
    ]
    scale = {"low": number(low), "high": number(high), "what": what, "ramp": figures.RAMP}
    return {"paths": pictures, "scale": scale, "paths_of": len(runs)}


def _sampled(walks: Sequence[Walk], lengths: Sequence[int]) -> str:
    """Return how many snapshots the spectrum is of."""
    used, there = ([len(w.rows) for w in walks], lengths)
    counts = sorted({f"{u:,} of its {n:,}" for u, n in zip(used, there, strict=True)})
    if all(u == n for u, n in zip(used, there, strict=True)):
        return "all snapshots of each run"
    evenly = "evenly spaced snapshots of each run"
    return f"{counts[0]} snapshots, evenly spaced" if len(counts) == 1 else f"{max(used)} {evenly}"


def _ranks(walks: Sequence[Walk]) -> list[tuple[str, str]]:
    """Return the components that a share needs: of one run, or the fewest and most of several."""
    rows = []
    for share in _SHARES:
        found = [rank_for(w, share) for w in walks]
        known = [rank for rank in found if rank is not None]
        if known:
            text = str(known[0]) if len(set(known)) == 1 else f"{min(known)} to {max(known)}"
            rows.append((power(share), text))
    return rows


def _quartiles(values: Sequence[float]) -> str:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    if len(values) == 1:
        return number(float(middle))
    return f"{number(float(middle))} ({number(float(low))} to {number(float(high))})"


def _typical(runs: Sequence[Run]) -> int:
    """Return the index of the run whose final return is the median."""
    order = np.argsort([np.nan_to_num(final_return(run)[0]) for run in runs], kind="stable")
    return int(order[(len(runs) - 1) // 2])


def _film(run: Run, seed: int, progress: Progress, task: Any) -> tuple[dict[str, Any] | None, str]:
    """Return what the template shows of the film, or why there is none."""
    try:
        with needs("sb3"):
            from weighttraj.publish.film import film
        made = film(run, seed=seed, advance=lambda: progress.advance(task))
    except WeightTrajError as error:
        progress.update(task, completed=_FILM_STAGES)
        return None, str(error)
    rows = [
        {
            "t": f"{e.t:,}",
            "steps": f"{e.num_timesteps:,}",
            "return": number(float(e.rewards.sum())),
            "length": f"{len(e.rewards):,}",
            "end": "terminated" if e.terminated else "truncated",
        }
        for e in made.episodes
    ]
    ends = [f"{r['return']} at t = {r['t']}" for r in rows]
    return {
        "run": made.run,
        "seed": made.seed,
        "why": made.moments.why,
        "slow": f"{made.slow:.2g}" if made.slow > 1 else "",
        "rows": rows,
        "label": f"Film of one episode at each of {len(rows)} moments of training. Returns: "
        + ", ".join(ends),
        "animation": base64.b64encode(made.animation).decode(),
        "still": base64.b64encode(made.still).decode(),
        "width": made.size[0],
        "height": made.size[1],
    }, ""
