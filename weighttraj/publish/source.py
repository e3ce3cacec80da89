"""What a page is about: a data set or one run, and the facts at its top."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from weighttraj.errors import FormatError
from weighttraj.format import Algorithm
from weighttraj.format.schema import DatasetInfo
from weighttraj.opening import open_dataset, open_run
from weighttraj.publish.curves import final_return
from weighttraj.remote.address import here
from weighttraj.run import Run
from weighttraj.store.objects import bytes_in

MINUS, DASH = "\u2212", "\u2013"

Facts = list[tuple[str, str]]
"""Labels and values, in the order of the page."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A data set, or a run on its own."""

    path: Path
    """Where it lies."""
    id: str
    """Its id."""
    info: DatasetInfo | None
    """Metadata of the data set; None: a run on its own."""
    runs: list[Run]
    """Runs, at least one."""

    @property
    def kind(self) -> str:
        """What it is, in a word."""
        return "run" if self.info is None else "data set"


def open_source(path: str | Path) -> Source:
    """Open a data set (a folder or ``.h5``) or a run.

    Raises:
        FileNotFoundError: there is neither at the path.
        FormatError: it is none of this format, or a data set that has no run yet.
    """
    path = here(path)
    if not ((path / "dataset.json").is_file() or path.suffix == ".h5"):
        run = open_run(path)
        return Source(path=path, id=run.id, info=None, runs=[run])
    dataset = open_dataset(path)
    if not dataset.runs:
        raise FormatError(
            "there is nothing to report",
            expected="a data set with a run",
            got="none of its runs has been begun",
            where=path,
            do="collect it first: weighttraj collect RECIPE --out DATASET",
        )
    return Source(path=path, id=dataset.info.id, info=dataset.info, runs=dataset.runs)


def facts(source: Source) -> Facts:
    """Return what stands at the top of the page."""
    runs = source.runs
    found: Facts = [
        ("environment", environment_of(runs)),
        ("algorithm", _values(runs, lambda r: _algorithm(r) or "not recorded")),
        ("runs", _runs(source)),
        ("snapshots", _snapshots(runs)),
        ("parameters", _values(runs, lambda r: f"{r.layout.size:,}") + " in each snapshot"),
        ("a snapshot", _values(runs, _cadence)),
        ("status", _status(source)),
        ("profile", _values(runs, lambda r: r.info.profile)),
        ("size on disk", size(bytes_in(source.path))),
    ]
    if source.info is not None:
        found.append(("data version", f"{source.info.version}, {source.info.licence}"))
    found.append(("made with", _versions(runs)))
    return [(label, value) for label, value in found if value]


def run_rows(runs: Iterable[Run]) -> list[dict[str, str]]:
    """Return the table of runs: one line each, in the data set's order."""
    return [
        {
            "id": run.id,
            "seed": DASH if run.info.seed is None else str(run.info.seed),
            "split": run.split or DASH,
            "snapshots": f"{len(run):,}",
            "steps": f"{int(run.num_timesteps[-1]):,}" if len(run) else DASH,
            "return": number(final_return(run)[0]),
            "status": run.info.status,
        }
        for run in runs
    ]


def settings(source: Source) -> str:
    """Return hyper-parameters and environment of the first run, as JSON."""
    info = source.runs[0].info
    said = {
        "algorithm": asdict(info.algorithm) if info.algorithm else None,
        "environment": asdict(info.env) if info.env else None,
        "normaliser": asdict(info.obs_norm) if info.obs_norm else None,
        "recipe": source.info.recipe if source.info else None,
    }
    return json.dumps({k: v for k, v in said.items() if v}, indent=1, ensure_ascii=False)


def lead(source: Source) -> str:
    """Return the page's first sentence."""
    names = _values(source.runs, lambda r: r.info.algorithm.name if r.info.algorithm else "")
    runs, snapshots = len(source.runs), sum(map(len, source.runs))
    return (
        f"{names} on {environment_of(source.runs)}: " if names else ""
    ) + f"{runs} training run{'s' * (runs > 1)}, {snapshots:,} snapshots of the policy's weights."


def environment_of(runs: Iterable[Run]) -> str:
    """Return ids of the environments."""
    return _values(runs, lambda r: r.info.env.id if r.info.env else "not recorded")


def number(value: float) -> str:
    """Write a number for readers: 1,224 or 0.0312; a dash for NaN."""
    if not math.isfinite(value):
        return DASH
    return (f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}").replace("-", MINUS)


def size(count: int) -> str:
    """Write a number of bytes for readers, such as 1.2 MB."""
    for unit, factor in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= factor:
            return f"{count / factor:.3g} {unit}"
    return f"{count} bytes"


def _values(runs: Iterable[Run], value: Callable[[Run], str]) -> str:
    """Return what the runs say, each value once; the first three of many."""
    values = list(dict.fromkeys(value(run) for run in runs))
    more = [f"and {len(values) - 3} more"] if len(values) > 3 else []
    return ", ".join(values[:3] + more)


def _algorithm(run: Run) -> str:
    match run.info.algorithm:
        case None:
            return ""
        case Algorithm(name=name, library=""):
            return name
        case Algorithm(name=name, library=library):
            return f"{name} ({library})"


def _runs(source: Source) -> str:
    counts: dict[str, int] = {}
    for run in source.runs:
        counts[run.split] = counts.get(run.split, 0) + 1
    splits = ", ".join(f"{n} {split}" for split, n in counts.items() if split)
    return f"{len(source.runs)} ({splits})" if splits else str(len(source.runs))


def _snapshots(runs: Iterable[Run]) -> str:
    lengths = [len(run) for run in runs]
    if len(lengths) == 1:
        return f"{lengths[0]:,}"
    if len(set(lengths)) == 1:
        return f"{lengths[0]:,} in each run, {sum(lengths):,} in all"
    return f"{min(lengths):,} to {max(lengths):,} in a run, {sum(lengths):,} in all"


def _cadence(run: Run) -> str:
    cadence = run.info.cadence
    return f"every {cadence.every} gradient steps" if cadence else "at unrecorded times"


def _status(source: Source) -> str:
    done = sum(run.info.status == "complete" for run in source.runs)
    total = len(source.info.runs) if source.info else 1
    status = source.info.status if source.info else source.runs[0].info.status
    return status if done == total else f"{status}: {done} of {total} runs are complete"


def _versions(runs: Iterable[Run]) -> str:
    def versions(run: Run) -> str:
        return ", ".join(f"{name} {v}" for name, v in run.info.provenance.packages.items())

    return _values(runs, versions)
