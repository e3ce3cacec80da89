"""What is in a released data set? Writes facts and a figure into the page beside it.

python tests/benchmarks/facts.py inverted-pendulum-v4-ppo-v1

reads datasets/<id>/data, rewrites what stands between the marks in datasets/<id>/README.md, and
draws datasets/<id>/returns.svg.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt

import weighttraj as wt

DATASETS = Path(__file__).parents[2] / "datasets"
START = "<!-- facts: rewrite with `python tests/benchmarks/facts.py {id}` -->"
END = "<!-- end of the facts -->"
COLUMNS = 8
"""Moments of training in the table."""
MODES = {"deterministic": True, "sampled": False}


def returns_of(dataset: wt.Dataset) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Environment steps (point,) of what was evaluated, and mean returns (run, point) by mode."""
    first = dataset.runs[0]
    rows = np.flatnonzero(np.isfinite(first.mean_return(deterministic=True)))
    steps = first["index/num_timesteps"][:][rows]
    by_mode = {
        mode: np.array([run.mean_return(deterministic=flag)[rows] for run in dataset])
        for mode, flag in MODES.items()
    }
    return steps, by_mode


def render(dataset: wt.Dataset) -> str:
    """Sizes, versions, and quartiles of the returns over runs."""
    steps, by_mode = returns_of(dataset)
    run = dataset.runs[0]
    trainer = asdict(run.info.algorithm)["library"]
    splits = [f"{len(dataset.split(name).runs)} {name}" for name in ("train", "validation", "test")]
    size = sum(file.stat().st_size for file in dataset.path.rglob("*") if file.is_file())
    provenances = {tuple(sorted(r.info.provenance.packages.items())) for r in dataset}
    versions = [", ".join(f"{name} {version}" for name, version in each) for each in provenances]
    wanted = run["index/num_timesteps"][-1] * np.linspace(0, 1, COLUMNS) ** 2
    columns = np.unique([np.abs(steps - step).argmin() for step in wanted])
    lines = [
        f"- {len(dataset.runs)} runs: {', '.join(splits)}",
        f"- {len(run):,} snapshots of {run.layout.size} parameters each; "
        f"{size / 1e6:.1f} MB in all",
        f"- made by {trainer}, on {run.info.provenance.platform}, "
        f"{run.info.provenance.cpu}, with {'; '.join(versions)}",
        "",
        "| return after | "
        + " | ".join(f"{steps[column]:,}" for column in columns)
        + " environment steps |",
        "|---|" + "---:|" * len(columns),
    ]
    for mode, values in by_mode.items():
        low, median, high = np.quantile(values[:, columns], (0.25, 0.5, 0.75), axis=0)
        cells = [
            f"{m:,.0f} ({a:,.0f} to {b:,.0f})" for a, m, b in zip(low, median, high, strict=True)
        ]
        lines.append(f"| {mode} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "Medians and quartiles over runs of the mean return of the stored episodes. The figure "
        "shows them at all moments.",
        "",
        "![returns](returns.svg)",
    ]
    return "\n".join(lines)


def draw(dataset: wt.Dataset, path: Path) -> None:
    """Median and quartiles of the returns, over environment steps."""
    steps, by_mode = returns_of(dataset)
    # The same file each time.
    with mpl.rc_context({"svg.hashsalt": dataset.info.id, "svg.fonttype": "none"}):
        figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
        for mode, values in by_mode.items():
            low, median, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
            (line,) = axes.plot(steps, median, label=f"{mode} actions")
            axes.fill_between(steps, low, high, color=line.get_color(), alpha=0.25, linewidth=0)
        axes.set_xscale("symlog", linthresh=float(steps[steps > 0][0]))
        axes.set_xlabel("environment steps")
        axes.set_ylabel(f"return, {len(dataset.runs)} runs")
        axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
        figure.savefig(path, metadata={"Date": None})
        plt.close(figure)


def insert(page: str, dataset: wt.Dataset) -> str:
    """The page with the facts of the data set."""
    start = START.format(id=dataset.info.id)
    before, rest = page.split(start)
    _, after = rest.split(END)
    return f"{before}{start}\n\n{render(dataset)}\n\n{END}{after}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("id", help="folder in datasets/")
    folder = DATASETS / parser.parse_args().id
    dataset = wt.open(folder / "data")
    page = folder / "README.md"
    page.write_text(insert(page.read_text(), dataset))
    draw(dataset, folder / "returns.svg")


if __name__ == "__main__":
    main()
