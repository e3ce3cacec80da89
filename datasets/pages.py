"""Write a page for each data set, and the table of all of them, from what was measured.

python datasets/pages.py --measure [ID ...]

reads the runs of each data set, in ``datasets/<id>/data`` and in ``data/<id>``, where they are
collected, and keeps the figures in ``datasets/<id>/facts.json``. Then, and without ``--measure``
only this, it writes ``datasets/<id>/README.md`` and ``curves.svg`` of each data set that has such
figures, the table in ``datasets/README.md``, and the short one in the ``README.md`` above it.
"""

from __future__ import annotations

import argparse
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib as mpl
import msgspec
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

import weighttraj as wt
from weighttraj.collect import Recipe, read_recipe
from weighttraj.collect.agents import actor_parameters
from weighttraj.collect.costs import read_costs
from weighttraj.collect.population import Origin
from weighttraj.publish.curves import KINDS, Kind, band, curves, mean_returns
from weighttraj.registry.croissant import citation
from weighttraj.text import between

DATASETS = Path(__file__).parent
COLLECTED = DATASETS.parent / "data"
PAGE = DATASETS / "README.md"
FRONT = DATASETS.parent / "README.md"
START = "<!-- data sets: rewrite with `python datasets/pages.py` -->"
END = "<!-- end of the data sets -->"
SPLITS = ("train", "validation", "test")
MODES: dict[Kind, str] = {
    "deterministic": "deterministic actions",
    "sampled": "sampled actions",
    "training": "last training episodes",
}
COLORS: dict[Kind, str] = {"deterministic": "#3f74d9", "sampled": "#c8770a", "training": "#1d9a7c"}
RESAMPLES = 10_000


class Interval(msgspec.Struct, frozen=True):
    """A mean over runs with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float
    runs: int


class Curve(msgspec.Struct, frozen=True):
    """Quartiles of the returns over runs, against environment steps."""

    steps: list[float]
    low: list[float]
    median: list[float]
    high: list[float]


class Part(msgspec.Struct, frozen=True):
    """Runs of a data set in one place."""

    runs: dict[str, int]
    """Number of runs in each split."""
    megabytes: float


class Cost(msgspec.Struct, frozen=True):
    """What collecting took."""

    runs: int
    cpu_hours_per_run: float
    steps_per_cpu_second: int


class Returns(msgspec.Struct, frozen=True):
    """Which returns are stored in the runs."""

    runs: int
    """Runs that have any."""
    deterministic: int
    """Episodes with deterministic actions."""
    sampled: int
    """Episodes with sampled actions."""
    every: int
    """Every so many-th snapshot is evaluated, and the last one."""
    first: int
    """Also each of the first so many."""
    learning: int
    """Also every so many-th snapshot of the learning phase; 0: no more."""


class Facts(msgspec.Struct, frozen=True):
    """Everything on a data set's page that was measured on its runs."""

    here: Part | None
    """In this repository; None: nothing."""
    collected: Part | None
    """Collected when the figures were measured, the runs in this repository included."""
    steps: int
    """Environment steps of a run."""
    evaluated: Returns | None
    """Stored returns; None: there are none."""
    made_by: str
    final: dict[str, Interval]
    """Returns at the end of the runs, by kind."""
    curves: dict[str, Curve]
    cost: Cost | None
    citation: str


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ids", nargs="*", help="data sets to be measured; default: all with runs")
    parser.add_argument("--measure", action="store_true", help="read the runs first")
    args = parser.parse_args()
    if args.measure:
        for name in args.ids or [recipe.id for recipe in recipes() if _places(recipe.id)]:
            print(name)
            facts = msgspec.json.format(msgspec.json.encode(measure(name)), indent=1)
            (DATASETS / name / "facts.json").write_bytes(facts + b"\n")
    for recipe in recipes():
        facts = facts_of(recipe.id)
        if facts is not None:
            (DATASETS / recipe.id / "README.md").write_text(render(recipe, facts))
            (DATASETS / recipe.id / "curves.svg").write_text(draw(recipe.id, facts))
    PAGE.write_text(insert(PAGE.read_text()))
    FRONT.write_text(insert_short(FRONT.read_text()))


def recipes() -> list[Recipe]:
    """Return the recipes of all data sets."""
    return [read_recipe(file) for file in sorted(DATASETS.glob("*-v*/recipe.toml"))]


def facts_of(name: str) -> Facts | None:
    """Return the figures that were kept of a data set; None: nothing was measured."""
    file = DATASETS / name / "facts.json"
    return msgspec.json.decode(file.read_bytes(), type=Facts) if file.is_file() else None


# Measuring


def measure(name: str) -> Facts:
    """Return the figures of the runs of a data set that are on this machine."""
    here, collected = DATASETS / name / "data", COLLECTED / name
    parts = {place: wt.open(place) for place in _places(name)}
    runs = _complete(parts.values())
    return Facts(
        here=_part(here, parts[here].runs) if here in parts else None,
        collected=_part(collected, _complete([parts[collected]])) if collected in parts else None,
        steps=int(runs[0].num_timesteps[-1]),
        evaluated=_evaluated(runs),
        made_by=_made_by(runs),
        final={kind: found for kind in KINDS if (found := _final(runs, kind)) is not None},
        curves={kind: _curve(runs, kind) for kind in KINDS if curves(runs, kind)},
        cost=_cost(collected, int(runs[0].num_timesteps[-1])),
        citation=citation(next(iter(parts.values()))),
    )


def _places(name: str) -> list[Path]:
    folders = (DATASETS / name / "data", COLLECTED / name)
    return [folder for folder in folders if (folder / "dataset.json").is_file()]


def _complete(datasets: Any) -> list[wt.Run]:
    """Return the complete runs of some data sets by seed; of two with one seed, the first."""
    by_seed: dict[int, wt.Run] = {}
    for dataset in datasets:
        for run in dataset:
            if run.info.status == "complete":
                by_seed.setdefault(run.info.seed or 0, run)
    return [by_seed[seed] for seed in sorted(by_seed)]


def _part(folder: Path, runs: Sequence[wt.Run]) -> Part:
    size = sum(Path(run.path).stat().st_size for run in runs)
    tables = sum(file.stat().st_size for file in folder.glob("tables/*"))
    counts = Counter(run.split for run in runs)
    return Part(
        runs={split: counts[split] for split in SPLITS if counts[split]},
        megabytes=round((size + tables) / 1e6, 1),
    )


def _evaluated(runs: Sequence[wt.Run]) -> Returns | None:
    found = [run.evaluation for run in runs if run.evaluation is not None]
    if not found:
        return None
    one = found[0]
    return Returns(
        runs=len(found),
        deterministic=sum(one.deterministic),
        sampled=len(one.deterministic) - sum(one.deterministic),
        every=one.every,
        first=one.first,
        learning=one.learning,
    )


def _made_by(runs: Sequence[wt.Run]) -> str:
    """Return who trained the runs, with which versions and on which processors."""
    algorithm = runs[0].info.algorithm
    provenances = [run.info.provenance for run in runs]
    cpus = sorted({p.cpu for p in provenances})
    versions = {tuple(sorted(p.packages.items())) for p in provenances}
    told = ("; or ").join(", ".join(" ".join(pair) for pair in each) for each in sorted(versions))
    trainer, _, same = getattr(algorithm, "library", "").partition(", as ")
    trainer = trainer.removesuffix("'s population")
    if same:
        trainer = f"{trainer}'s population collector (the algorithm of {same})"
    return f"{trainer} on {' and '.join(cpus)}; versions: {told}"


def _final(runs: Sequence[wt.Run], kind: Kind) -> Interval | None:
    values = [found for run in runs if (found := mean_returns(run, kind)) is not None]
    last = np.array([each[np.isfinite(each)][-1] for each in values if np.isfinite(each).any()])
    if not len(last):
        return None
    picks = np.random.default_rng(0).integers(len(last), size=(RESAMPLES, len(last)))
    low, high = np.quantile(last[picks].mean(1), [0.025, 0.975])
    return Interval(*(round(float(x), 1) for x in (last.mean(), low, high)), runs=len(last))


def _curve(runs: Sequence[wt.Run], kind: Kind) -> Curve:
    middle = asdict(band(curves(runs, kind)))
    return Curve(**{name: np.round(values, 1).tolist() for name, values in middle.items()})


def _cost(folder: Path, steps: int) -> Cost | None:
    lines = read_costs(folder)
    runs = sum(len(line["seeds"]) for line in lines)
    if not runs:
        return None
    per_run = sum(line["cpu_s"] for line in lines) / runs
    return Cost(
        runs=runs,
        cpu_hours_per_run=round(per_run / 3600, 4),
        steps_per_cpu_second=round(steps / per_run),
    )


# Writing


def render(recipe: Recipe, facts: Facts) -> str:
    """Return the page of a data set."""
    parts = [
        f"# {recipe.id}",
        _about(recipe),
        "![Returns against environment steps: median and quartiles over runs](curves.svg)",
        _opening(recipe, facts),
        "## What it holds",
        "\n".join(_contents(recipe, facts)),
        "## Returns at the end of training",
        "\n".join(_returns(recipe, facts)),
        "## Collect it",
        _collecting(recipe, facts),
        "## Cite it",
        f"```bibtex\n{facts.citation}\n```\n\nLicence of the data: {recipe.licence}.",
        f"This page was written by `python datasets/pages.py` from [facts.json](facts.json), which "
        f"`python datasets/pages.py --measure {recipe.id}` measured.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _about(recipe: Recipe) -> str:
    """Return the comment at the top of the recipe."""
    lines = (DATASETS / recipe.id / "recipe.toml").read_text().splitlines()
    return "\n".join(line.removeprefix("#").strip() for line in _leading(lines))


def _leading(lines: Sequence[str]) -> Iterator[str]:
    for line in lines:
        if not line.startswith("#"):
            return
        yield line


def _opening(recipe: Recipe, facts: Facts) -> str:
    name = recipe.id if facts.here else f"data/{recipe.id}"
    return (
        f'```python\nimport weighttraj as wt\n\nds = wt.open("{name}")\nprint(ds)\n'
        'windows = ds.split("train").to_torch(window=20)  # a PyTorch Dataset\n```'
    )


def _contents(recipe: Recipe, facts: Facts) -> Iterator[str]:
    total = sum(len(seeds) for seeds in recipe.seeds.by_split().values())
    if facts.here is not None:
        held = sum(facts.here.runs.values())
        which = f"{held} of the recipe's {total} runs" if held < total else f"All {total} runs"
        yield f"- {which} are in this repository: {_counts(facts.here)}; {facts.here.megabytes} MB."
    if facts.collected is not None and (
        facts.here is None or facts.here.runs != facts.collected.runs
    ):
        held = sum(facts.collected.runs.values())
        yield (
            f"- {held} of the recipe's {total} runs had been collected when this page was "
            f"written: {_counts(facts.collected)}; {_size(facts.collected.megabytes)}."
        )
    yield (
        f"- Each run has {recipe.n_snapshots:,} snapshots of {parameters_of(recipe):,} "
        f"parameters, one every {recipe.store.every} gradient steps, over {facts.steps:,} "
        "environment steps. Each snapshot has its observation and reward normalisers, counters and "
        f"diagnostics. For each iteration, {recipe.store.probe_observations} observations of its "
        "rollout are stored, as the network saw them (probe observations)."
    )
    yield f"- {_evaluation(facts.evaluated)}"
    yield f"- Trained by {facts.made_by}."
    if recipe.seeds.test:
        yield "- Evaluate forecasts on the `test` runs; make choices on the `validation` runs."


def _evaluation(stored: Returns | None) -> str:
    if stored is None:
        return "No returns are stored yet."
    rows = f"every {stored.every}th snapshot"
    rows += f", each of the first {stored.first}" if stored.first else ""
    rows += f", every {stored.learning}th of the learning phase" if stored.learning else ""
    return (
        f"{stored.runs} runs have returns: {stored.deterministic} episodes with deterministic and "
        f"{stored.sampled} with sampled actions of {rows}, and of the last. All policies play the "
        "same episodes."
    )


def _options(stored: Returns | None) -> str:
    """Return the options of `weighttraj returns` that make such returns."""
    if stored is None:
        return ""
    first = f" --first {stored.first}" if stored.first else ""
    learning = f" --learning {stored.learning}" if stored.learning else ""
    return f" --episodes {stored.sampled} --every {stored.every}{first}{learning}"


def _counts(part: Part) -> str:
    return ", ".join(f"{count} {split}" for split, count in part.runs.items())


def _size(megabytes: float) -> str:
    return f"{megabytes / 1000:.1f} GB" if megabytes >= 1000 else f"{megabytes:.1f} MB"


def _returns(recipe: Recipe, facts: Facts) -> Iterator[str]:
    yield "| what | environment steps | return |"
    yield "|---|---:|---:|"
    for kind, final in facts.final.items():
        yield f"| here, {MODES[kind]} | {facts.steps:,} | {_interval(final)} |"
    for row in _published().get(recipe.ppo.env_id, []):
        yield f"| [{row['by']}]({row['source']}) | {row['steps']} | {row['return']} |"
    runs = max((final.runs for final in facts.final.values()), default=0)
    yield ""
    yield (
        f"Here: mean of up to {runs} runs, with the 95 % bootstrap interval over runs. Published "
        "figures are for other networks, lengths and versions of the environment, as named."
    )


def _interval(final: Interval) -> str:
    return f"{_number(final.mean)} [{_number(final.low)}, {_number(final.high)}]"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}"


def _published() -> dict[str, list[dict[str, str]]]:
    return msgspec.json.decode((DATASETS / "published.json").read_bytes())


def _collecting(recipe: Recipe, facts: Facts) -> str:
    data = f"data/{recipe.id}"
    iterations = 20 * recipe.ppo.gradient_steps_per_iteration // recipe.store.every
    text = f"""```bash
weighttraj collect datasets/{recipe.id}/recipe.toml --workers 2
weighttraj returns {data}{_options(facts.evaluated)} --workers 2
```

This makes all runs of the recipe in `{data}`{", beside what is here" if facts.here else ""}.
The same command continues a stopped one, and `--seeds 0:2` makes only the runs of seeds 0 and 1.
With the same versions and on the same kind of processor the runs come out bit by bit:
`weighttraj verify {recipe.id if facts.here else data} --replay {1 + iterations}` trains the
first 20 iterations of a run again and compares them."""
    if facts.cost is None:
        return text
    total, each = len(recipe.splits()), facts.cost.cpu_hours_per_run
    return f"""{text}

Measured over {facts.cost.runs} runs: {facts.cost.steps_per_cpu_second:,} environment steps per CPU
second, {each:.2g} CPU hours a run, so {each * total:.1f} for all {total}."""


def draw(name: str, facts: Facts) -> str:
    """Return the learning curves as SVG: the same text for the same figures."""
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        figure = Figure(figsize=(7, 3.2), layout="constrained")
        axes = figure.subplots()
        for kind, curve in facts.curves.items():
            color = COLORS[kind]  # type: ignore[index]
            axes.plot(curve.steps, curve.median, label=MODES[kind], color=color)  # type: ignore[index]
            axes.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.2, lw=0)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1000:,.0f}k"))
        axes.set_xlabel("environment steps")
        axes.set_ylabel("return")
        axes.legend(frameon=False)
        axes.grid(alpha=0.2)
        axes.spines[["top", "right"]].set_visible(False)
        return _svg(figure)


def _svg(figure: Figure) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines()) + "\n"


# The table of all


def table() -> str:
    """Return the table of all data sets."""
    lines = [
        "| id | task | parameters | runs here / in the recipe | snapshots of a run | size here "
        "| return at the end | returns against steps |",
        "|---|---|---:|---:|---:|---:|---:|---|",
    ]
    for recipe in recipes():
        facts = facts_of(recipe.id)
        page = "README.md" if (DATASETS / recipe.id / "README.md").is_file() else "recipe.toml"
        here = facts.here if facts else None
        final = next(iter(facts.final.values()), None) if facts else None
        cells = [
            f"[{recipe.id}]({recipe.id}/{page})",
            recipe.ppo.env_id,
            f"{parameters_of(recipe):,}",
            f"{sum(here.runs.values()) if here else 0} / {len(recipe.splits())}",
            f"{recipe.n_snapshots:,}",
            _size(here.megabytes) if here else "-",
            _interval(final) if final else "not measured",
            f"![curves of {recipe.id}]({recipe.id}/curves.svg)" if facts else "-",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def insert(page: str) -> str:
    """Return the page of all data sets with the table as it is now."""
    return between(page, START, END, table())


def short_table() -> str:
    """Return the data sets whose runs are in this repository, in few columns."""
    lines = ["| data set | runs | snapshots of each | return at the end |"]
    lines.append("|---|---:|---:|---:|")
    for recipe in recipes():
        facts = facts_of(recipe.id)
        if facts is None or facts.here is None:
            continue
        cells = [
            f"[{recipe.id}](datasets/{recipe.id}/README.md)",
            f"{sum(facts.here.runs.values())}",
            f"{recipe.n_snapshots:,}",
            _number(next(iter(facts.final.values())).mean) if facts.final else "-",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def insert_short(page: str) -> str:
    """Return the README of the repository with the short table as it is now."""
    return between(page, START, END, short_table())


def parameters_of(recipe: Recipe) -> int:
    """Return the number of parameters of a snapshot."""
    policy = Origin(recipe.ppo, seed=0).model.policy
    return sum(parameter.numel() for parameter in actor_parameters(policy).values())


if __name__ == "__main__":
    main()
