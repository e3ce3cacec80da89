"""A stranger's files at every door: whatever they hold, the end is an answer or a clear error.

nice python -W ignore tests/benchmarks/fuzz_doors.py --cases 20000 --seed 0

Each case changes one file of a small data set, run, recipe or HDF5 export, by its structure or by
its bytes, with a right checksum where anyone can compute it, and goes through the doors. Prints a
line of counts, and exits with 1 if a door ended in anything but an answer, a ``WeightTrajError`` or
a ``FileNotFoundError``, hung, or took gigabytes. A case follows from the seed and its number:
``--first 4711 --cases 1`` does one again. tests/test_doors.py does a few hundred.
"""

from __future__ import annotations

import argparse
import importlib
import json
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

import weighttraj as wt
from tests.benchmarks.stress_format import (
    ALLOWED,
    Hangs,
    Result,
    _place,
    _places,
    bounded,
    contents,
    forge,
    make_samples,
)
from weighttraj import registry
from weighttraj.collect import read_recipe
from weighttraj.collect.recipe import Recipe
from weighttraj.publish.source import facts, lead, open_source, run_rows, settings
from weighttraj.registry.download import source_of
from weighttraj.registry.local import LocalDataset
from weighttraj.store.catalog import write_manifest
from weighttraj.tools.hdf5 import export_hdf5, import_hdf5

STRANGE = [
    None, True, False, 0, 1, -1, 0.5, -0.0, 1e308, 2**31, 2**53 + 1, 2**62, 2**63, 2**64, 10**30,
    "", "..", "../../etc", "/etc/passwd", "NaN", "auto", "complete", "|O", "numcodecs.pickle",
    "\x1b[2J", "\u202eabc", "a\nb: c", "[/red]", "<script>", "$x$", "%s", "{0}", "x" * 5000,
    [], {}, [[]], [None], {"a": {}}, [1, "a"], [[1, 2], [3, 4]], [["a", "b"], ["c", "d"]],
]  # fmt: skip
"""Values that a field does not expect."""


def mutated(document: Any, rng: random.Random) -> None:
    """Change one to three values of a document: gone, strange, wrapped, copied, renamed."""
    for _ in range(rng.randint(1, 3)):
        places = _places(document)
        if not places:
            return
        holder, key = rng.choice(places)
        value, kind = holder[key], rng.randrange(6)
        if kind == 0:
            del holder[key]
        elif kind == 1:
            holder[key] = rng.choice([[value], {"a": value}, str(value)])
        elif kind == 2:
            other, place = rng.choice(places)
            holder[key] = json.loads(json.dumps(other[place]))
        elif kind == 3 and isinstance(value, int | float) and not isinstance(value, bool):
            holder[key] = rng.choice([value + 1, -value, value * 1000, value / 3, value * 2**40])
        elif kind == 4 and isinstance(holder, dict):
            holder[str(rng.choice(STRANGE))[:300]] = value
        else:
            holder[key] = rng.choice(STRANGE)


def scrambled(content: bytes, rng: random.Random) -> bytes:
    """Change, insert, remove or repeat a few bytes."""
    data = bytearray(content)
    for _ in range(rng.randint(1, 3)):
        start = rng.randrange(len(data) + 1)
        stop = min(len(data), start + rng.choice([0, 1, 1, 4, 40]))
        data[start:stop] = rng.choice([b"", rng.randbytes(rng.randint(1, 4)), data[:9], b"\0" * 64])
    if rng.random() < 0.1:
        del data[rng.randrange(len(data) + 1) :]
    return bytes(data)


def change_json(file: Path, rng: random.Random) -> None:
    """Change a JSON document, and mostly make its checksum right again."""
    document = json.loads(file.read_bytes())
    mutated(document, rng)
    if rng.random() < 0.9:
        forge(document)
    file.write_text(json.dumps(document, indent=1))


def change_bytes(file: Path, rng: random.Random) -> None:
    """Change the bytes of a file."""
    file.write_bytes(scrambled(file.read_bytes(), rng))


def change_table(file: Path, rng: random.Random) -> None:
    """Change a table: its bytes, or whole columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if rng.random() < 0.5:
        change_bytes(file, rng)
        return
    table = pq.read_table(file)
    name = rng.choice([*table.column_names, "dataset", "index", "x\x1b"])
    value = rng.choice([None, 2**62, "x", 0.5, True, [1], b"\xff", "x" * 10**6])
    column = pa.array([value] * len(table))
    if name in table.column_names:
        table = table.set_column(table.column_names.index(name), name, column)
    else:
        table = table.append_column(name, column)
    pq.write_table(table.slice(rng.choice([0, 0, 0, 1])), file)


def change_recipe(file: Path, rng: random.Random) -> None:
    """Change a recipe: its values, or its bytes."""
    if rng.random() < 0.3:
        change_bytes(file, rng)
        return
    document = msgspec.to_builtins(Recipe(id="small"))
    mutated(document, rng)
    file.write_text("".join(f"{json.dumps(k)} = {toml(v)}\n" for k, v in document.items()))


def toml(value: Any) -> str:
    """A JSON value in TOML, which has no null."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return "''" if value is None else json.dumps(value)


def _show(path: Path) -> None:
    opened = wt.open_run(path) if path.name.endswith((".zarr", ".zip")) else wt.open(path)
    repr(opened)
    if isinstance(opened, wt.Dataset):
        opened.select(seed=0, final_return=lambda value: value > 0)


def _page(path: Path) -> None:
    source = open_source(path)
    for part in (facts, lead, settings, lambda s: run_rows(s.runs)):
        part(source)


def _replay(path: Path) -> None:
    """All of a replay but the training: a recipe that passes is fit to be trained."""
    replay = importlib.import_module("weighttraj.collect.replay")
    compare, replay._compare = replay._compare, lambda *_: []
    try:
        replay.replay(path, 1)
    finally:
        replay._compare = compare


def _search(path: Path) -> None:
    registry.search("seed == 0", [LocalDataset("theirs", path)])
    registry.search("", [LocalDataset("theirs", path)])


Door = Callable[[Path], object]
RUN_DOORS: dict[str, Door] = {
    "contents": contents,
    "show": _show,
    "verify": lambda p: wt.verify(p, deep=True),
    "lint": wt.lint,
    "repair": wt.repair,
    "repair --cut": lambda p: wt.repair(p, cut=True),
    "page": _page,
    "pack": lambda p: wt.pack(p, out=p.with_name("out.zarr.zip")),
    "export": lambda p: wt.export_npy(wt.open_run(p), p.with_name("out")),
    "create": lambda p: registry.create([p], p.with_name("out")),
}
DATASET_DOORS: dict[str, Door] = {
    "contents": contents,
    "show": _show,
    "verify": wt.verify,
    "lint": wt.lint,
    "repair": wt.repair,
    "repair --cut": lambda p: wt.repair(p, cut=True),
    "page": _page,
    "card": registry.write_card,
    "search": _search,
    "split": lambda p: registry.split(p, p.with_name("out"), fractions=(1, 0, 0)),
    "replay": _replay,
    "source": source_of,
    "export": lambda p: export_hdf5(p, p.with_name("out.h5")),
}
Change = Callable[[Path, random.Random], None]
CASES: dict[str, tuple[str, str, Change, dict[str, Door]]] = {
    "run json": ("complete.zarr", "zarr.json", change_json, RUN_DOORS),
    "run bytes": ("crashed.zarr", "zarr.json", change_bytes, RUN_DOORS),
    "array json": ("complete.zarr", "policy/weights/zarr.json", change_json, RUN_DOORS),
    "zip": ("default/runs/seed0000.zarr.zip", "", change_bytes, RUN_DOORS),
    "list": ("default", "dataset.json", change_json, DATASET_DOORS),
    "list bytes": ("default", "dataset.json", change_bytes, DATASET_DOORS),
    "manifest": ("default", "MANIFEST.sha256", change_bytes, DATASET_DOORS),
    "runs table": ("default", "tables/runs.parquet", change_table, DATASET_DOORS),
    "snapshots table": ("default", "tables/snapshots.parquet", change_table, DATASET_DOORS),
    "card": ("default", "README.md", change_bytes, DATASET_DOORS),
    "croissant": ("default", "croissant.json", change_bytes, DATASET_DOORS),
    "source": ("default", ".source.json", change_json, DATASET_DOORS),
    "recipe": ("recipe.toml", "", change_recipe, {"read": read_recipe}),
    "hdf5": (
        "export.h5",
        "",
        change_bytes,
        {
            "contents": contents,
            "verify": wt.verify,
            "page": _page,
            "import": lambda p: import_hdf5(p, p.with_name("out")),
        },
    ),
}
"""Which sample, which file of it, how it is changed, and the doors."""


def prepare(dataset: Path, folder: Path) -> Path:
    """Make the samples from a small data set; returns their folder."""
    make_samples(dataset, folder)
    registry.write_card(folder / "default")
    (folder / "default/.source.json").write_text('{"repository": "hf://a/b", "revision": "x"}')
    export_hdf5(wt.open(folder / "default"), folder / "export.h5")
    (folder / "recipe.toml").write_text('id = "small"\n[ppo]\nn_steps = 64\n')
    return folder


def fuzz(samples: Path, seed: int, first: int, n: int) -> Result:
    """Do some cases, each through two doors of its kind."""
    result = Result()
    for case in range(first, first + n):
        rng = random.Random(f"{seed} {case}")
        name = rng.choice(list(CASES))
        sample, file, change, doors = CASES[name]
        with tempfile.TemporaryDirectory(dir=samples.parent) as folder:
            path = copied(samples / sample, Path(folder))
            change(path / file if file else path, rng)
            if name not in ("manifest", "list bytes") and path.is_dir() and sample == "default":
                write_manifest(path)  # as whoever changes it can
            for door in rng.sample(list(doors), min(2, len(doors))):
                outcome, why = _through(doors[door], path)
                result.counts[outcome] += 1
                if why:
                    result.broken.append(f"case {case}, {name}, {door}: {why}")
    return result


def copied(sample: Path, folder: Path) -> Path:
    """A copy of a sample in a folder."""
    copy = shutil.copytree if sample.is_dir() else shutil.copyfile
    return Path(copy(sample, folder / sample.name))


def _through(door: Door, path: Path) -> tuple[str, str]:
    """Go through a door; returns what became of it, and what is wrong with that."""
    try:
        with bounded():
            door(path)
    except ALLOWED as error:
        return "refused", "" if str(error).strip() else f"{type(error)} without a message"
    except Hangs:
        return "hangs", "hangs"
    except Exception as error:
        return "raw", f"{error!r:.300} at {_place(error)}"
    return "answered", ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--dataset", type=Path, help="small data set; default: one is collected")
    args = parser.parse_args()
    total, kinds = Result(), Counter[str]()
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        dataset = args.dataset
        if dataset is None:
            from tests.benchmarks.stress_format import RECIPE, collect

            dataset = Path(folder) / "reference"
            collect(RECIPE, dataset)
        samples = prepare(dataset, Path(folder) / "samples")
        for first in range(args.first, args.first + args.cases, 100):
            part = fuzz(samples, args.seed, first, min(100, args.first + args.cases - first))
            total += part
            kinds.update(what.split(" at ")[-1] for what in part.broken)
            for what in part.broken:
                print(what, file=sys.stderr, flush=True)
            print(f"{first + 100}: {dict(total.counts)}", file=sys.stderr, flush=True)
    report = {"seed": args.seed, "cases": args.cases, **dict(sorted(total.counts.items()))}
    print(json.dumps(report | {"broken promises": len(total.broken), "places": kinds}))
    sys.exit(1 if total.broken else 0)


if __name__ == "__main__":
    main()
