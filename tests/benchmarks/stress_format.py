"""Kills, flipped bits, lost objects and mutated metadata, in numbers: are the promises kept?

nice python -W ignore tests/benchmarks/stress_format.py --kills 200 --flips 10000 \
    --deletions 200 --fuzz 10000 --seed 0

Prints one JSON line of counts, and exits with 1 if a promise was broken. Each case follows from
the seed, its part and its number: `--only flips --first 4711 --flips 1` does one of them again.
The small versions in tests/store/test_faults.py call the same functions.
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import torch
from hypothesis import strategies as st
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import weighttraj as wt
from tests.small import SMALL_RECIPE
from weighttraj.atomic import DRAFT
from weighttraj.collect import collect
from weighttraj.collect.settings import Seeds
from weighttraj.errors import WeightTrajError
from weighttraj.format import ParamLayout, RunInfo
from weighttraj.store.catalog import read_dataset_info, write_dataset_info
from weighttraj.store.live import LiveStore
from weighttraj.store.zarr_run import checksum
from weighttraj.writer import RunWriter

ALLOWED = (WeightTrajError, FileNotFoundError)
"""What reading and verifying may raise."""

RECIPE = replace(
    SMALL_RECIPE,
    ppo=replace(SMALL_RECIPE.ppo, total_timesteps=384),
    seeds=Seeds(train=[0], test=[1]),
    store=replace(SMALL_RECIPE.store, critic=True, optimizer_moments=True),
)
"""25 snapshots a run, in blocks of 8."""

TOML = """
id = "small"
[ppo]
total_timesteps = 384
n_steps = 64
batch_size = 16
n_epochs = 2
critic_arch = [8, 8]
[seeds]
train = [0]
test = [1]
[store]
every = 2
block = 8
probe_observations = 4
critic = true
optimizer_moments = true
"""
"""The same recipe for the command line."""

MORE_MEMORY = 3 << 30
"""Bytes that a case may allocate beyond what its process has."""

SECONDS = 60
"""A case that takes longer hangs."""


@dataclass
class Result:
    """What became of some cases."""

    counts: Counter[str] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)
    """Broken promises, each with its case."""

    def __iadd__(self, other: Result) -> Result:
        self.counts += other.counts
        self.broken += other.broken
        return self


# What is to be damaged


def make_samples(dataset: Path, folder: Path) -> None:
    """Sealed data sets of both profiles, and run folders, from the first two runs of a data set."""
    runs = wt.open(dataset).runs[:2]
    for profile in ("default", "archive"):
        out = folder / profile
        (out / "runs").mkdir(parents=True)
        for run in runs:
            wt.pack(run.path, profile=profile, out=out / "runs" / f"{run.id}.zarr.zip")
        info = read_dataset_info(dataset)
        write_dataset_info(out, replace(info, runs=info.runs[:2]))
        wt.seal(out)
    live_copy(runs[0], folder / "complete.zarr", 25, 6, "complete")
    live_copy(runs[0], folder / "crashed.zarr", 21, 5, "crashed")
    wide = ParamLayout.of({"w": ((20_000,), "other", ("fixed",))})
    rows = np.random.default_rng(7).normal(size=(6, 20_000)).astype(np.float32)
    with RunWriter(folder / "wide.zarr", RunInfo(run_id="wide", layout=wide, block=4)) as writer:
        for t, row in enumerate(rows):
            writer.append(row, num_timesteps=t)
    for lock in folder.rglob("*.lock"):
        lock.unlink()


def live_copy(run: wt.Run, path: Path, n: int, iterations: int, status: Any) -> None:
    """The first rows of a run, as they lay while it was collected."""
    counts = {"time": n, "iteration": iterations}
    empty = replace(run.info, n_committed=0, n_committed_iterations=0, profile="default")
    store = LiveStore.create(path, empty)
    for spec in store.specs.values():
        rows = run[spec.name][: counts[spec.axis]]
        for start in range(0, len(rows), run.info.block):
            store.write(spec.name, start, rows[start : start + run.info.block])
    store.commit(replace(empty, status=status, n_committed=n, n_committed_iterations=iterations))


def contents(path: Path) -> dict[str, Any]:
    """All that the public API says of a data set or run, bit for bit."""
    if path.suffix == ".zarr":
        return run_contents(wt.open_run(path))
    dataset = wt.open(path)
    return {"": dataset.info} | {run.id: (run.split, run_contents(run)) for run in dataset}


def run_contents(run: wt.Run) -> dict[str, Any]:
    found: dict[str, Any] = {name: array[:].tobytes() for name, array in run.arrays.items()}
    # Columns and single rows take another way.
    found["columns"] = run.weights[:, 1:3].tobytes()
    found["row"] = run["index/num_timesteps"][len(run) - 1].tobytes()
    return found | {"info": run.info}


def judge(path: Path, truth: dict[str, Any]) -> tuple[str, list[str]]:
    """What reading a damaged sample gives, and the promises that are broken."""
    broken = []
    try:
        if not wt.verify(path):
            broken.append("verify finds nothing")
    except ALLOWED:
        pass
    except Exception as error:
        broken.append(f"verify raises {error!r} at {_place(error)}")
    try:
        outcome = "right" if contents(path) == truth else "wrong"
    except ALLOWED:
        outcome = "refused"
    except Exception as error:
        outcome = "other error"
        broken.append(f"reading raises {error!r} at {_place(error)}")
    return outcome, [*broken, *(["reads wrong numbers"] if outcome == "wrong" else [])]


def _place(error: BaseException) -> str:
    """The innermost line of ours that an exception passed."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "weighttraj" in f.filename]
    return f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"


class Hangs(BaseException):
    """A case took too long."""


@contextmanager
def bounded(seconds: int = SECONDS) -> Iterator[None]:
    """A case that takes much memory or time fails instead of taking the machine with it.

    Args:
        seconds: 0: as long as it likes; pytest has an alarm of its own.
    """

    def stop(*_: object) -> None:
        raise Hangs

    now = int(re.findall(r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text())[0]) << 10
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + MORE_MEMORY, before[1]))
    if seconds:
        old = signal.signal(signal.SIGALRM, stop)
        signal.alarm(seconds)
    try:
        yield
    finally:
        if seconds:
            signal.alarm(0)
            signal.signal(signal.SIGALRM, old)
        resource.setrlimit(resource.RLIMIT_AS, before)


@functools.cache
def own_samples(samples: Path, _pid: int) -> dict[str, tuple[Path, dict[str, Any]]]:
    """Copies that only this process damages, and what they hold."""
    own = Path(tempfile.mkdtemp(dir=samples.parent))
    shutil.copytree(samples, own / "samples")
    return {p.name: (p, contents(p)) for p in sorted((own / "samples").iterdir())}


def files_of(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file() and p.stat().st_size)


# The parts: each does the cases from `first` on


def flips(samples: Path, seed: int, first: int, n: int) -> Result:
    """One flipped bit anywhere in a data set or run."""
    own, result = own_samples(samples, os.getpid()), Result()
    for case in range(first, first + n):
        rng = np.random.default_rng([seed, 1, case])
        name = str(rng.choice(list(own)))
        path, truth = own[name]
        files = files_of(path)
        sizes = np.array([p.stat().st_size for p in files], float)
        # Small files are hit as often as large ones, half of the time.
        chances = sizes / sizes.sum() if rng.random() < 0.5 else np.full(len(files), 1 / len(files))
        file = files[rng.choice(len(files), p=chances)]
        whole = file.read_bytes()
        place, bit = int(rng.integers(len(whole))), int(rng.integers(8))
        damaged = bytearray(whole)
        damaged[place] ^= 1 << bit
        file.write_bytes(damaged)
        try:
            with bounded():
                outcome, broken = judge(path, truth)
        except Hangs:
            outcome, broken = "hangs", ["hangs"]
        file.write_bytes(whole)
        result.counts[f"flips {outcome}"] += 1
        where = f"{name}/{file.relative_to(path)} byte {place} bit {bit}"
        result.broken += [f"flips case {case}: {where}: {what}" for what in broken]
    return result


def deletions(samples: Path, seed: int, first: int, n: int) -> Result:
    """An object deleted, cut, emptied, swapped, duplicated, replaced or added."""
    own, result = own_samples(samples, os.getpid()), Result()
    for case in range(first, first + n):
        rng = np.random.default_rng([seed, 2, case])
        name = str(rng.choice(list(own)))
        kind = str(rng.choice(list(DAMAGES)))
        path, truth = own[name]
        where = DAMAGES[kind](path, rng)
        if where is not None:
            try:
                with bounded():
                    outcome, broken = judge(path, truth)
            except Hangs:
                outcome, broken = "hangs", ["hangs"]
            result.broken += [f"deletions case {case}: {name}: {where}: {s}" for s in broken]
            result.counts[f"{kind} {outcome}"] += 1
        shutil.rmtree(path)
        shutil.copytree(samples / name, path)
    return result


def _delete(path: Path, rng: np.random.Generator) -> str:
    file = _pick(path, rng)
    file.unlink()
    return f"delete {file.relative_to(path)}"


def _delete_folder(path: Path, rng: np.random.Generator) -> str:
    folders = sorted(p for p in path.rglob("*") if p.is_dir())
    folder = folders[rng.integers(len(folders))]
    shutil.rmtree(folder)
    return f"delete folder {folder.relative_to(path)}"


def _truncate(path: Path, rng: np.random.Generator) -> str:
    file = _pick(path, rng)
    size = int(rng.integers(1, file.stat().st_size))
    os.truncate(file, size)
    return f"truncate {file.relative_to(path)} to {size}"


def _empty(path: Path, rng: np.random.Generator) -> str:
    file = _pick(path, rng)
    os.truncate(file, 0)
    return f"empty {file.relative_to(path)}"


def _extend(path: Path, rng: np.random.Generator) -> str:
    file = _pick(path, rng)
    with file.open("ab") as more:
        more.write(bytes(rng.integers(0, 256, int(rng.integers(1, 9)), np.uint8)))
    return f"extend {file.relative_to(path)}"


def _folder(path: Path, rng: np.random.Generator) -> str:
    file = _pick(path, rng)
    file.unlink()
    file.mkdir()
    return f"folder for {file.relative_to(path)}"


def _link(path: Path, rng: np.random.Generator) -> str:
    """The object itself, but outside of the folder."""
    file = _pick(path, rng)
    outside = Path(tempfile.mkdtemp(dir=path.parent.parent)) / file.name
    file.rename(outside)
    file.symlink_to(outside)
    return f"link for {file.relative_to(path)}"


def _swap(path: Path, rng: np.random.Generator) -> str | None:
    pair = _pair(path, rng)
    if pair is None:
        return None
    one, other = pair
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    return f"swap {one.relative_to(path)} and {other.relative_to(path)}"


def _duplicate(path: Path, rng: np.random.Generator) -> str | None:
    pair = _pair(path, rng)
    if pair is None:
        return None
    shutil.copyfile(*pair)
    return f"{pair[0].relative_to(path)} over {pair[1].relative_to(path)}"


def _add(path: Path, rng: np.random.Generator) -> str | None:
    if path.name == "crashed.zarr":  # may have rows that it never committed
        return None
    file = _pick(path, rng)
    shutil.copyfile(file, file.with_name("77"))
    return f"add {file.with_name('77').relative_to(path)}"


def _pick(path: Path, rng: np.random.Generator) -> Path:
    files = files_of(path)
    return files[rng.integers(len(files))]


def _pair(path: Path, rng: np.random.Generator) -> tuple[Path, Path] | None:
    """Two objects of different bytes, of the same size if there are such."""
    files = files_of(path)
    order = [files[i] for i in rng.permutation(len(files))]
    for same_size in (True, False):
        for one in order:
            content = one.read_bytes()
            for other in order:
                same = one.stat().st_size == other.stat().st_size
                if same == same_size and other.read_bytes() != content:
                    return one, other
    return None


DAMAGES: dict[str, Callable[[Path, np.random.Generator], str | None]] = {
    "delete": _delete,
    "delete folder": _delete_folder,
    "truncate": _truncate,
    "empty": _empty,
    "extend": _extend,
    "folder": _folder,
    "link": _link,
    "swap": _swap,
    "duplicate": _duplicate,
    "add": _add,
}

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.sampled_from([0, 1, -1, 2**31, 2**40, 2**62, 2**63, 2**64, 10**30])
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["", "..", "../../etc", "NaN", "numcodecs.pickle", "complete", "|O", "gzip"]),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=6,
)


def fuzz(samples: Path, seed: int, first: int, n: int) -> Result:
    """Mutated ``zarr.json`` and ``dataset.json``, by structure and by bytes. A case is a batch."""
    own, result = own_samples(samples, os.getpid()), Result()
    names = {name: path for name, (path, _) in own.items() if name != "archive"}

    @hypothesis.seed(seed * 100_003 + first)
    @hypothesis.settings(
        max_examples=n,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(st.data())
    def one(data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(names)))
        path, truth = own[name]
        file = path / ("zarr.json" if path.suffix == ".zarr" else "dataset.json")
        whole = file.read_bytes()
        draw = mutated if data.draw(st.booleans()) else scrambled
        content, forged = draw(data, whole)
        file.write_bytes(content)
        try:
            with bounded():
                outcome, broken = judge_metadata(path, truth, content == whole, forged=forged)
        except Hangs:
            outcome, broken = "hangs", ["hangs"]
        file.write_bytes(whole)
        result.counts[f"fuzz {'forged' if forged else 'plain'} {outcome}"] += 1
        result.broken += [
            f"fuzz first {first}, example {result.counts.total()}: {name}: {what}; "
            f"{_diff(whole, content)}"
            for what in broken
        ]

    one()
    return result


def judge_metadata(
    path: Path, truth: dict[str, Any], same: bool, *, forged: bool
) -> tuple[str, list[str]]:
    """As ``judge``; who forges the checksum may write numbers of their own, but nothing worse."""
    outcome, broken = judge(path, truth)
    if same:
        return outcome, [] if outcome == "right" else [f"unchanged, yet {outcome}"]
    if forged:
        fine = ("verify finds nothing", "reads wrong numbers")
        broken = [what for what in broken if what not in fine]
    return outcome, broken


def mutated(data: st.DataObject, whole: bytes) -> tuple[bytes, bool]:
    """Some values of a document deleted, replaced, retyped or copied; perhaps a new checksum."""
    document = json.loads(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        holder, key = data.draw(st.sampled_from(_places(document)))
        value = holder[key]
        change = data.draw(st.sampled_from(["delete", "replace", "wrap", "number", "text", "copy"]))
        if change == "delete":
            del holder[key]
        elif change == "copy":
            other, place = data.draw(st.sampled_from(_places(document)))
            holder[key] = json.loads(json.dumps(other[place]))
        else:
            holder[key] = {
                "replace": lambda: data.draw(JSON),
                "wrap": lambda value=value: data.draw(st.sampled_from([[value], {"a": value}])),
                "number": lambda value=value: _number(data, value),
                "text": lambda value=value: str(value),
            }[change]()
        if not _places(document):
            break
    forged = data.draw(st.booleans())
    if forged:
        forge(document)
    return json.dumps(document, indent=1).encode(), forged


def _number(data: st.DataObject, value: Any) -> Any:
    """A number near the old one, or far from it."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return data.draw(st.integers(-3, 2**40))
    far = st.sampled_from([0, -value, value * 1000, value * 2**40, value / 3, 10**20])
    return data.draw(st.sampled_from([value + 1, value - 1, float(value)]) | far)


def _places(document: Any) -> list[tuple[Any, Any]]:
    """Every value of a document, as its holder and key."""
    found: list[tuple[Any, Any]] = []
    pairs = (
        list(document.items()) if isinstance(document, dict) else
        list(enumerate(document)) if isinstance(document, list) else []
    )  # fmt: skip
    for key, value in pairs:
        found += [(document, key), *_places(value)]
    return found


def forge(document: Any) -> None:
    """Write the checksum anew, as anyone can."""
    if not isinstance(document, dict):
        return
    attributes = document.get("attributes")
    if isinstance(attributes, dict):
        attributes.pop("weighttraj_sha256", None)
        attributes["weighttraj_sha256"] = checksum(document)
    else:
        document.pop("sha256", None)
        document["sha256"] = checksum(document)


def scrambled(data: st.DataObject, whole: bytes) -> tuple[bytes, bool]:
    """Some bytes replaced, inserted, removed or repeated."""
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(content)))
        stop = data.draw(st.integers(start, min(len(content), start + 40)))
        content[start:stop] = data.draw(
            st.binary(max_size=4) | st.just(bytes(content[:start][-9:]))
        )
    return bytes(content), False


def _diff(whole: bytes, content: bytes) -> str:
    """What was changed, in few words."""
    start = next((i for i, (a, b) in enumerate(zip(whole, content, strict=False)) if a != b), 0)
    return f"from {start}: {content[max(0, start - 40) : start + 60]!r}"


# Kills


def kills(reference: Path, seed: int, first: int, n: int, *, cli: bool = False) -> Result:
    """Collectors that are killed, at a moment or at a file operation, again and again."""
    result, truth = Result(), contents(reference)
    with tempfile.TemporaryDirectory(dir=reference.parent) as folder:
        out, seen = Path(folder) / "0", Counter[str]()
        life = _start_cli if cli else forked
        for case in range(first, first + n):
            rng = np.random.default_rng([seed, 3, case])
            how, ended = _kill(life, out, rng, seen, by_time=cli or rng.random() < 0.5)
            result.counts["kills " + ("too late" if ended == "complete" else how)] += 1
            broken = after_kill(out, truth, seen)
            if ended not in ("killed", "complete"):
                broken.append(f"the collector failed: {ended}")
            if ended == "complete":
                broken += whole(out, truth)
                result.counts["data sets completed"] += 1
                out, seen = out.with_name(str(case + 1)), Counter()
            result.broken += [f"kills first {first}, case {case}, {how}: {s}" for s in broken]
        if out.exists():
            collect(RECIPE, out)
            broken = whole(out, truth)
            result.counts["data sets completed"] += 1
            result.broken += [f"kills first {first}, at the end: {what}" for what in broken]
        result.counts["bytes left by killed collectors"] += _litter(Path(folder))
    return result


class Life:
    """A collector in a process."""

    def __init__(self, pid: int, log: Path) -> None:
        self.pid, self.log = pid, log
        self.status: int | None = None

    def running(self) -> bool:
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = status if pid else None
        return self.status is None

    def ended(self) -> str:
        """``killed``, ``complete``, or what it said."""
        while self.running():
            time.sleep(0.002)
        assert self.status is not None
        if os.WIFSIGNALED(self.status) and os.WTERMSIG(self.status) == signal.SIGKILL:
            return "killed"
        return "complete" if self.status == 0 else self.log.read_text()[-800:]


def forked(out: Path, operation: int | None) -> Life:
    """A collector that has imported everything; before this file operation it kills itself."""
    log = out.with_name("log")
    pid = os.fork()
    if pid:
        return Life(pid, log)
    try:
        screen = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(screen, 1)
        os.dup2(screen, 2)
        if operation is not None:
            _die_at(operation, str(out))
        collect(RECIPE, out)
        os._exit(0)
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(1)


def _die_at(operation: int, folder: str) -> None:
    """Send SIGKILL to this process before its n-th operation on the files of a folder."""
    left = operation

    def hook(event: str, args: tuple[Any, ...]) -> None:
        nonlocal left
        ours = (folder in str(arg) or str(arg).endswith(DRAFT) for arg in args[:2])
        if event in OPERATIONS and any(ours):  # drafts are named from the folder that they are in
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


OPERATIONS = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.scandir", "os.listdir"}
MOST_OPERATIONS = 5500
"""About so many has a collector that does both runs in one go."""

MOST_SECONDS = {False: 5.0, True: 16.0}
"""About so long lives an undisturbed collector: forked, started as a command."""


def _start_cli(out: Path, operation: int | None) -> Life:
    recipe = out.with_name("recipe.toml")
    recipe.write_text(TOML)
    command = [sys.executable, "-W", "ignore", "-m", "weighttraj.cli", "collect", str(recipe)]
    log = out.with_name("log")
    with log.open("wb") as screen:
        process = subprocess.Popen(
            [*command, "--out", str(out)], stdout=screen, stderr=subprocess.STDOUT
        )
    life = Life(process.pid, log)
    process.returncode = 0  # it is ours to wait for
    return life


def _kill(
    start: Callable[[Path, int | None], Life],
    out: Path,
    rng: np.random.Generator,
    seen: Counter[str],
    *,
    by_time: bool,
) -> tuple[str, str]:
    """Start a collector, kill it, and note what it had reported as committed meanwhile."""
    operation = None if by_time else int(rng.integers(1, MOST_OPERATIONS))
    moment = float(rng.uniform(0, MOST_SECONDS[start is _start_cli]))
    life, begin = start(out, operation), time.monotonic()
    while life.running() and (operation or time.monotonic() < begin + moment):
        _observe(out, seen)
        time.sleep(0.004)
    if operation is None and life.running():
        os.kill(life.pid, signal.SIGKILL)
    ended = life.ended()
    _observe(out, seen)
    return ("by time" if by_time else "by operation"), ended


def _observe(out: Path, seen: Counter[str]) -> None:
    """Snapshots that each run reports as committed, seen from outside."""
    for file in out.glob("runs/*.zarr/zarr.json"):
        try:
            found = re.search(rb'"n_committed": (\d+)', file.read_bytes())
        except (FileNotFoundError, NotADirectoryError):  # packed this moment
            continue
        assert found is not None
        seen[file.parent.name] = max(seen[file.parent.name], int(found[1]))


def after_kill(out: Path, truth: dict[str, Any], seen: Counter[str]) -> list[str]:
    """Promises that a killed collector broke."""
    broken = []
    if not (out / "dataset.json").exists():
        return ["runs without dataset.json"] if seen else []
    try:
        dataset = wt.open(out)
        found = {f"{run.id}.zarr": run for run in dataset}
        broken += [f"{name} is gone" for name in seen if name not in found]
        for name, run in found.items():
            if len(run) < seen[name]:
                broken.append(f"{name} has {len(run)} snapshots, had reported {seen[name]}")
            broken += _not_a_beginning(run, truth[run.id][1])
        problems = wt.verify(out, deep=True)
        broken += [f"verify: {what}" for what in problems if "weighttraj repair" not in what]
        if problems:
            broken += _not_mended(out)
    except Exception as error:
        broken.append(f"{error!r} at {_place(error)}")
    return broken


def _not_a_beginning(run: wt.Run, truth: dict[str, Any]) -> list[str]:
    """Arrays whose committed rows differ from the first ones of the undisturbed run."""
    return [
        f"{run.id} has other values in {name}"
        for name, array in run.arrays.items()
        if array[:].tobytes() != truth[name][: array[:].nbytes]
    ]


def _not_mended(out: Path) -> list[str]:
    copy = out.with_name("copy")
    shutil.copytree(out, copy)
    try:
        wt.repair(copy)
        return [f"after repair: {what}" for what in wt.verify(copy, deep=True)]
    finally:
        shutil.rmtree(copy)


def whole(out: Path, truth: dict[str, Any]) -> list[str]:
    """How a data set differs from the undisturbed one; when and where it was made may differ."""
    problems = wt.verify(out, deep=True)
    for run in wt.open(out):
        expected = truth[run.id][1]
        got = run_contents(run)
        problems += [
            f"{run.id} differs in {name}"
            for name in expected
            if name != "info" and got.get(name) != expected[name]
        ]
    if len(wt.open(out)) != len(truth) - 1:
        problems.append("runs are missing")
    return problems


def _litter(folder: Path) -> int:
    """Bytes of hidden files and folders in completed data sets: drafts that nobody removed."""
    found = {p for p in folder.rglob("*") if p.is_file() and "/." in f"/{p.relative_to(folder)}"}
    return sum(p.stat().st_size for p in found if not p.name.endswith(".lock"))


# All of it

PARTS: dict[str, tuple[Callable[[Path, int, int, int], Result], int]] = {
    "kills": (kills, 20),
    "cli_kills": (functools.partial(kills, cli=True), 5),
    "flips": (flips, 50),
    "deletions": (deletions, 20),
    "fuzz": (fuzz, 100),
}
"""Each part, and how many of its cases are done in a row."""


def prepare(folder: Path) -> Path:
    """The reference that nobody disturbs, and the samples."""
    torch.set_num_threads(1)
    collect(RECIPE, folder / "reference")
    make_samples(folder / "reference", folder / "samples")
    return folder


def run_parts(folder: Path, counts: dict[str, int], seed: int, first: int, workers: int) -> Result:
    """Do the cases in several processes; a process that dies is a broken promise too."""
    total = Result()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), refresh_per_second=1) as progress:
        for part, n in counts.items():
            bar = progress.add_task(part, total=n)
            for result, done in _run_part(folder, part, n, seed, first, workers):
                total += result
                progress.update(bar, advance=done)
                for what in result.broken[:3]:
                    progress.console.print(what, markup=False)
    return total


def _run_part(
    folder: Path, part: str, n: int, seed: int, first: int, workers: int
) -> Iterator[tuple[Result, int]]:
    work, size = PARTS[part]
    where = folder / ("reference" if "kills" in part else "samples")
    with ProcessPoolExecutor(workers, multiprocessing.get_context("fork")) as pool:
        jobs = {}
        for start in range(first, first + n, size):
            many = min(size, first + n - start)
            jobs[pool.submit(work, where, seed, start, many)] = (start, many)
        for job in as_completed(jobs):
            start, many = jobs[job]
            try:
                yield job.result(), many
            except BrokenProcessPool:
                yield Result(broken=[f"{part} cases from {start}: the process died"]), many


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--cli-kills", type=int, default=10)
    parser.add_argument("--flips", type=int, default=10_000)
    parser.add_argument("--deletions", type=int, default=200)
    parser.add_argument("--fuzz", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--only", choices=list(PARTS), help="this part only")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    counts = {part: getattr(args, part) for part in PARTS if args.only in (None, part)}
    room = "/dev/shm" if os.path.isdir("/dev/shm") else None  # noqa: S108
    with tempfile.TemporaryDirectory(dir=room, prefix="stress") as folder:
        total = run_parts(prepare(Path(folder)), counts, args.seed, args.first, args.workers)
    for what in total.broken:
        print(what, file=sys.stderr)
    report = {"seed": args.seed, **counts, **dict(sorted(total.counts.items()))}
    print(json.dumps(report | {"broken promises": len(total.broken)}))
    sys.exit(1 if total.broken else 0)


if __name__ == "__main__":
    main()
