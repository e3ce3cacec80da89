"""The card of a data set: what it is, for people and for the hub.

``README.md`` begins with the metadata that the hub reads: licence, tags, and the tables that its
viewer shows. Its sections follow Datasheets for Datasets (Gebru et al., 2021). Prose is written by
hand and stays; what stands between markers comes from the data, and is written anew by
``weighttraj card``. Beside it lies ``croissant.json``.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from weighttraj.atomic import replace_file
from weighttraj.dataset import Dataset
from weighttraj.errors import RegistryError
from weighttraj.format import Algorithm
from weighttraj.locate import locate
from weighttraj.opening import open_dataset
from weighttraj.registry.croissant import CROISSANT, citation, croissant
from weighttraj.store.catalog import MANIFEST, check_file_names, write_manifest
from weighttraj.store.objects import read_plain
from weighttraj.text import markdown, printable, yaml
from weighttraj.tools.tables import RUNS, SNAPSHOTS

CARD = "README.md"
START, END = "<!-- facts, {}: rewrite with `weighttraj card` -->", "<!-- end of facts -->"

_MAX_CARD = 16 << 20  # bytes
_PLACE = re.compile(
    r"<!-- facts, (?P<section>\w+): rewrite with `weighttraj card` -->\n.*?<!-- end of facts -->",
    re.DOTALL,
)
_FRONT = re.compile(r"\A---\n.*?\n---\n", re.DOTALL)


def write_card(path: str | Path) -> Path:
    """Write a data set's card, or the facts into the one that is there; and Croissant metadata.

    Args:
        path: a complete data set on this machine: path or id. Its manifest is written anew.

    Returns:
        The card.

    Raises:
        FileNotFoundError: there is no such data set.
        RegistryError: it is not complete, or the card has lost its places for facts.
    """
    dataset = open_dataset(locate(path))
    folder = Path(dataset.path)
    if folder.is_file() or dataset.info.status != "complete":
        raise RegistryError(
            "only a complete data set has a card",
            expected="a folder, status complete",
            got=dataset.info.status,
            where=folder,
            do="finish collecting it",
        )
    if not dataset.runs:
        raise RegistryError(
            "a card describes the runs of a data set, and this one has none",
            expected="at least one run",
            got="none",
            where=folder,
            do="collect runs, or make the data set of runs that you have: weighttraj create",
        )
    card = folder / CARD
    check_file_names(folder)  # before anything changes
    text = _card_there(card) or new_card(dataset)
    written = {CARD: refreshed(text, dataset), CROISSANT: croissant(dataset)}
    (folder / MANIFEST).unlink(missing_ok=True)  # from here on it would be wrong
    for name, content in written.items():
        replace_file(folder / name, content.encode(), root=folder)
    write_manifest(folder)
    return card


def _card_there(card: Path) -> str | None:
    """The text of a card; None: there is none."""
    if not card.exists() and not card.is_symlink():
        return None
    try:
        return read_plain(card, _MAX_CARD).decode()
    except UnicodeDecodeError as error:
        raise RegistryError(
            "the card is no text in UTF-8", got=error, where=card, do="save it as UTF-8"
        ) from error


def refreshed(text: str, dataset: Dataset) -> str:
    """A card with its front matter and facts written anew.

    Raises:
        RegistryError: it has no place for facts.
    """
    if _PLACE.search(text) is None:
        raise RegistryError(
            "the card has no place for the facts of its data set",
            expected=f"{START.format('composition')} and {END}, a line each",
            got="none",
            where=dataset.path,
            do="write both lines where they shall stand, or delete the card: a new one is made",
        )

    def fill(match: re.Match[str]) -> str:
        section = match["section"]
        if section not in SECTIONS:
            raise RegistryError(
                "the card has a place for facts that there are not",
                expected=", ".join(SECTIONS),
                got=section,
                where=dataset.path,
                do="correct its name",
            )
        return _place(section, dataset)

    return _front_matter(dataset) + _PLACE.sub(fill, _FRONT.sub("", text))


def new_card(dataset: Dataset) -> str:
    """A card with the prose that is true of every data set; its author goes on from there."""
    return f"""
# {dataset.info.id}

{_place("summary", dataset)}

{_place("loading", dataset)}

## Composition

{_place("composition", dataset)}

## Collection process

{_place("collection", dataset)}

## Preprocessing

Weights are stored as they were in training, in float32 and without loss. What observations were
normalised with is stored beside each snapshot, where there was a normaliser.

## Uses

To learn from the paths that policies take through weight space: to forecast them, to represent
them, to ask what training does. Snapshots of one run are not independent, runs are: divide by run,
as the splits do, and give intervals over runs.

## Distribution

{_place("distribution", dataset)}

## Maintenance

What is published under a version stays as it is. Corrections are another version, with another
manifest.

## Citation

{_place("citation", dataset)}
"""


def _place(section: str, dataset: Dataset) -> str:
    return f"{START.format(section)}\n\n{SECTIONS[section](dataset)}\n\n{END}"


def _front_matter(dataset: Dataset) -> str:
    """YAML that the hub reads."""
    snapshots = sum(len(run) for run in dataset)
    sizes = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"))
    size = next((name for most, name in sizes if snapshots < most), "n>1M")
    environments = sorted({run.info.env.id for run in dataset if run.info.env})
    tags = ["reinforcement-learning", "weight-space-learning", "policy-weight-trajectories"]
    lines = [
        f"license: {yaml(dataset.info.licence.lower())}",
        f"pretty_name: {json.dumps(dataset.info.id)}",
        "task_categories:\n- reinforcement-learning",
        f"size_categories:\n- {size}",
        "tags:\n"
        + "\n".join(
            f"- {json.dumps(printable(tag), ensure_ascii=False)}" for tag in [*tags, *environments]
        ),
        "configs:",
        f"- config_name: snapshots\n  data_files: {SNAPSHOTS}\n  default: true",
        f"- config_name: runs\n  data_files: {RUNS}",
    ]
    return "---\n" + "\n".join(lines) + "\n---\n"


def _summary(dataset: Dataset) -> str:
    run = dataset.runs[0]
    env = sorted({r.info.env.id for r in dataset if r.info.env}) or ["an unrecorded environment"]
    names = sorted({r.info.algorithm.name for r in dataset if r.info.algorithm}) or ["training"]
    cadence = run.info.cadence
    every = f", one every {cadence.every} gradient steps" if cadence else ""
    return (
        f"The weights of policies while {markdown(', '.join(names))} trains them on "
        f"{markdown(', '.join(env))}: "
        f"{len(dataset):,} runs of {_range(len(r) for r in dataset)} snapshots{every}, of "
        f"{_range(r.layout.size for r in dataset)} parameters each."
    )


def _loading(dataset: Dataset) -> str:
    return f"""```python
import weighttraj as wt

ds = wt.load_dataset("{dataset.info.id}")  # or wt.open of its address: hf://..., s3://...
ds.runs[0].weights[:20]  # float32 (20, {dataset.runs[0].layout.size})
ds.runs[0].load_policy(t=-1)  # acts as the agent did
```

The tables, a row a run and a row a snapshot, are Parquet, which any program reads."""


def _composition(dataset: Dataset) -> str:
    parts = Counter(run.split or "in no split" for run in dataset)
    run = dataset.runs[0]
    hidden = [
        f"{spec.shape[0]}" for spec in run.layout.params if spec.role == "bias" and spec.shape
    ]
    lines = [
        f"- runs: {', '.join(f'{count} {name}' for name, count in parts.items())}",
        f"- policy: {run.info.policy.kind}, {run.info.policy.mode} head, "
        f"{markdown(run.info.policy.activation or 'other')} units: {' x '.join(hidden)}",
        "",
        f"| array of `{run.id}` | shape | type |",
        "|---|---|---|",
    ]
    for name, array in run.arrays.items():
        shape = ", ".join(f"{d} {n:,}" for d, n in zip(array.dims, array.shape, strict=True))
        lines.append(f"| `{name}` | {shape} | {array.dtype} |")
    return "\n".join(lines + _returns(dataset))


def _returns(dataset: Dataset) -> list[str]:
    """What the last policies return, by split."""
    finals = [(run.split or "in no split", run.final_mean_return) for run in dataset]
    by_part: dict[str, list[float]] = {}
    for part, value in finals:
        if np.isfinite(value):
            by_part.setdefault(part, []).append(value)
    if not by_part:
        return []
    lines = [
        "",
        "| return of the last snapshot | median | lowest | highest |",
        "|---|---:|---:|---:|",
    ]
    return lines + [
        f"| {part} | {np.median(v):,.1f} | {min(v):,.1f} | {max(v):,.1f} |"
        for part, v in by_part.items()
    ]


def _collection(dataset: Dataset) -> str:
    run = dataset.runs[0]
    provenances = {json.dumps(r.info.provenance.packages, sort_keys=True) for r in dataset}
    lines = []
    for packages in sorted(provenances):
        said = ", ".join(f"{name} {version}" for name, version in json.loads(packages).items())
        lines.append(f"- made with {markdown(said) or 'versions that are not recorded'}")
    provenance = run.info.provenance
    machine = ", ".join(filter(None, (provenance.platform, provenance.cpu)))
    if machine:
        lines.append(f"- on {markdown(machine)}")
    seeds = [r.info.seed for r in dataset if r.info.seed is not None]
    if seeds:
        lines.append(f"- seeds {_seeds(seeds)}")
    match run.info.algorithm:
        case Algorithm(name=name, library=library, hyperparameters=settings):
            of = f" of {markdown(library)}" if library else ""
            lines += ["", f"Settings of {markdown(name)}{of}, `{run.id}`:", ""]
            lines += ["| setting | value |", "|---|---|"]
            lines += [f"| {markdown(k)} | {_value(v)} |" for k, v in settings.items()]
    return "\n".join(lines)


def _distribution(dataset: Dataset) -> str:
    runs = sorted(entry.path for entry in dataset.info.runs)
    return "\n".join(
        [
            f"- licence: {markdown(dataset.info.licence)}",
            f"- version {markdown(dataset.info.version)} of the data, version "
            f"{dataset.info.format_version} of the format",
            f"- {len(runs)} runs as Zarr v3 groups, `{runs[0]}` and so on; `{SNAPSHOTS}`, `{RUNS}`",
            f"- `{MANIFEST}` has the hash of every file",
        ]
    )


SECTIONS: dict[str, Callable[[Dataset], str]] = {
    "summary": _summary,
    "loading": _loading,
    "composition": _composition,
    "collection": _collection,
    "distribution": _distribution,
    "citation": lambda dataset: f"```bibtex\n{citation(dataset)}\n```",
}
"""What can stand between markers."""


def _range(values: Any) -> str:
    found = sorted(set(values))
    return f"{found[0]:,}" if len(found) == 1 else f"{found[0]:,} to {found[-1]:,}"


def _seeds(seeds: list[int]) -> str:
    """Numbers as ranges: 0 to 29, 40."""
    found, start = [], None
    for seed in sorted(seeds):
        if start is None or seed != found[-1][1] + 1:
            found.append([seed, seed])
            start = seed
        found[-1][1] = seed
    return ", ".join(f"{a} to {b}" if a < b else str(a) for a, b in found)


def _value(value: Any) -> str:
    if _is_schedule(value):
        first, last = value[0][1], value[-1][1]
        same = all(pair[1] == first for pair in value)
        return f"{first:.6g}" if same else f"{first:.6g} at the start, {last:.6g} at the end"
    text = value if isinstance(value, str) else json.dumps(value)
    return markdown(text if len(text) <= 60 else f"{text[:57]}...")


def _is_schedule(value: Any) -> bool:
    """Whether a setting is a table of (progress remaining, value) pairs."""
    return (
        isinstance(value, list)
        and len(value) > 1
        and all(isinstance(pair, list) and len(pair) == 2 for pair in value)
        and all(isinstance(number, int | float) for pair in value for number in pair)
    )
