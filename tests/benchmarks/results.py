"""Keeps what benchmarks measured in results.json, and renders it into README.md.

python tests/benchmarks/results.py    # rewrites the table between the marks in README.md
"""

from __future__ import annotations

import json
import platform
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("results.json")
README = Path(__file__).parents[2] / "README.md"
START = "<!-- measured by tests/benchmarks: rewrite with `python tests/benchmarks/results.py` -->"
END = "<!-- end of what was measured -->"


def save(name: str, result: dict[str, Any]) -> None:
    """Keep the result of one benchmark."""
    results = json.loads(FILE.read_text()) if FILE.exists() else {}
    results[name] = result | {"machine": f"{platform.system()} {platform.machine()}"}
    FILE.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")


def render(results: dict[str, Any]) -> str:
    """The table, and a line for each other figure."""
    sizes = results["format"]["runs"]
    lines = [
        "| weights of one run, kept as | "
        + " | ".join(f"{env}: size | read" for env in sizes)
        + " |",
        "|---|" + "---:|---:|" * len(sizes),
    ]
    for way in next(iter(sizes.values())):
        cells = []
        for rows in sizes.values():
            fastest = rows["torch.save, a file a snapshot"]["cpu_s"] / rows[way]["cpu_s"]
            cells += [
                f"{rows[way]['size_of_raw']:.3f}",
                f"{fastest:,.0f}x" if fastest >= 100 else f"{fastest:.3g}x",
            ]
        lines.append(f"| {way} | " + " | ".join(cells) + " |")
    opening = results["format"]["opening"]
    lines += [
        "",
        "Size: of raw float32. Read: how many times faster than `torch.load` of a file a snapshot, "
        "in CPU time, digests checked.",
        f"A data set of {opening['runs']} runs is {opening['objects']} objects; from its path to "
        f"the first window takes {opening['first_window_s']:.2f} s.",
    ]
    if "load" in results:
        lines.append(_load(results["load"]))
    if "callback" in results:
        callback = results["callback"]
        lines.append(
            "Recording HalfCheetah 256x256 every 64 gradient steps takes "
            f"{100 * (callback['ratio_inside'] - 1):.2g} % of the training's CPU time and "
            f"{callback['extra_peak_mib'] / callback['block_mib']:.1f} blocks of memory."
        )
    returns = results.get("returns", {}).values()
    lines += [_returns(row) for row in returns if isinstance(row, dict)]
    lines += [
        f"A population of {row['learners']}, {case}: {row['times_faster']:.1f} times the "
        "environment steps of SB3 in the same CPU time, both recording."
        for case, row in results.get("population", {}).get("cases", {}).items()
    ]
    if "processes" in results:
        row = results["processes"]
        lines.append(
            f"{row['runs']} runs of {row['iterations']} iterations, {row['case']}: two processes "
            f"are done {row['times_faster']} times as fast as one, start-up included."
        )
    if "learning" in results:
        lines += _learning(results["learning"])
    if "recipes" in results:
        lines += _tried(results["recipes"])
    return "\n".join(lines)


def _tried(recipes: dict[str, Any]) -> list[str]:
    """The table of recipes that were tried short."""
    cases, episodes = recipes["cases"], recipes["episodes"]
    lines = [
        "",
        "| [recipe](datasets/README.md), tried short | parameters | seeds | steps a CPU second "
        f"| MB a run | return: first {episodes} episodes | last {episodes} "
        "| whole: CPU hours | GB |",
        "|---|" + "---:|" * 8,
    ]
    lines += [
        f"| {name} | {row['parameters']:,} | {row['seeds']} | {row['steps_per_cpu_s']:,} "
        f"| {row['mb_per_run']:.2f} | {row['first_returns']:,.1f} | {row['last_returns']:,.1f} "
        f"| {row['whole_cpu_hours']:.2f} | {row['whole_gb']:.2f} |"
        for name, row in cases.items()
    ]
    found = [
        f"{name}, {runs} runs: {finding}"
        for name, row in cases.items()
        for finding, runs in row["findings"].items()
    ]
    return [
        *lines,
        "",
        f"Each for {recipes['iterations']} iterations of every seed, by one population in one "
        "thread; returns of training episodes, means over seeds. Whole: what the recipe will take "
        "at that rate. `verify` finds every run whole; "
        f"`lint` finds {'; '.join(found) or 'nothing suspicious'}.",
    ]


def _returns(row: dict[str, Any]) -> str:
    units = "x".join(map(str, row["units"]))
    return (
        f"Returns of {row['policies']} policies x {row['episodes']} episodes, {row['env']} "
        f"{units}: {row['over_sb3']:.1f} times as fast as `evaluate_policy` one after another, "
        f"{row['over_limit']:.2f} of the speed of the bare physics; two threads "
        f"{row['two_threads']:.1f} times as fast as one."
    )


def _learning(learning: dict[str, Any]) -> list[str]:
    """Two samples of runs side by side, what tests say of them, and the runs of the same seeds."""
    seeds = {who: "{} to {}".format(*ends) for who, ends in learning["seeds"].items()}
    units = "x".join(map(str, learning["units"]))
    lines = [
        "",
        f"| {learning['env']} {units}, {learning['timesteps']:,} steps | "
        + " | ".join(f"{who}, seeds {numbers}" for who, numbers in seeds.items())
        + " | difference | p: means, distributions | control: difference | p | same seeds: "
        "difference | p |",
        "|---|" + "---:|" * (len(seeds) + 6),
    ]
    for name, row in learning["samples"].items():
        control, pairs = learning["control"][name], learning["same_seeds"][name]
        ranges = zip(row["iqm"], row["intervals"], strict=True)
        cells = [f"{iqm:,.0f} ({low:,.0f} to {high:,.0f})" for iqm, (low, high) in ranges]
        cells += [
            f"{row['difference_percent']:+.1f} % ± {row['half_width_percent']:.1f} %",
            f"{row['p']['means']:.2g}, {row['p']['distributions']:.2g}",
            f"{control['difference_percent']:+.1f} %",
            f"{control['p']['means']:.2g}, {control['p']['distributions']:.2g}",
            f"{pairs['difference_percent']:+.1f} %",
            f"{pairs['p']:.2g}",
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    never = " and ".join(
        f"{threshold} in {sb3} and {population} runs"
        for threshold, sb3, population in zip(
            learning["thresholds"], *(learning["never"][who] for who in seeds), strict=True
        )
    )
    overlaps = sum(row["intervals_overlap"] for row in learning["samples"].values())
    apart = "; ".join(
        f"{name}: {pair['median_absolute']:,.3g} and {pair['max_absolute']:,.3g}"
        for name, pair in learning["same_seeds"].items()
    )
    return [
        *lines,
        "",
        f"Does a population learn as SB3 does? Training returns, means of {learning['episodes']} "
        "episodes at the end of each rollout; a run that never reaches a threshold counts as the "
        f"whole length ({never}). Interquartile means over runs with 95 % bootstrap intervals, of "
        f"which {overlaps} of {len(learning['samples'])} overlap. Differences are of means; after "
        "± stands the half width of the 95 % interval: a smaller difference does not show. p by "
        "permutation, of the means and of Kolmogorov-Smirnov's statistic. Control: the population "
        "on SB3's seeds against the population on its own, set apart by the seeds alone. "
        "Same seeds: the population against SB3 run by run, p by flipping signs; the two are apart "
        f"by (median and most) {apart}.",
    ]


def _load(load: dict[str, Any]) -> str:
    rows = [f"{env}: {ratio:.2f}" for env, ratio in load["dataloader_over_memmap"].items()]
    more = [f"{env}: {ratio:.2f}" for env, ratio in load["resumable_over_memmap"].items()]
    return (
        "Random windows of 20 through the cache, `DataLoader` with 2 workers, against the same on "
        f"a bare `np.memmap`: {', '.join(rows)}; by `ResumableLoader`: {', '.join(more)}."
    )


def insert(page: str) -> str:
    """The page with the table as the results have it."""
    before, rest = page.split(START)
    _, after = rest.split(END)
    return f"{before}{START}\n\n{render(json.loads(FILE.read_text()))}\n\n{END}{after}"


if __name__ == "__main__":
    README.write_text(insert(README.read_text()))
