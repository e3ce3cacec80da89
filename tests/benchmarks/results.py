"""Keeps what benchmarks measured in results.json, and renders it into docs/benchmarks.md.

python tests/benchmarks/results.py    # rewrites what stands between the marks in the page
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from weighttraj.text import between

FILE = Path(__file__).with_name("results.json")
PAGE = Path(__file__).parents[2] / "docs/benchmarks.md"
START = "<!-- measured by tests/benchmarks: rewrite with `python tests/benchmarks/results.py` -->"
END = "<!-- end of what was measured -->"


def save(name: str, result: dict[str, Any]) -> None:
    """Keep the result of one benchmark."""
    results = json.loads(FILE.read_text()) if FILE.exists() else {}
    results[name] = result | {"machine": f"{platform.system()} {platform.machine()}"}
    FILE.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")


def render(results: dict[str, Any]) -> str:
    """All sections: tables, and a line for each other figure."""
    sections = {
        "Storing and loading": [*_format(results["format"]), *_bullets(_stored(results))],
        "Reading from elsewhere": _bullets(_remote(results)),
        "Collecting and returns": _bullets(_collected(results)),
        "Does a population learn as SB3 does?": _section(_learning, results.get("learning")),
        "Temporal SVD, training, forecasts": _bullets(_trained(results)),
        "Recipes": _section(_tried, results.get("recipes")),
    }
    written = ("\n".join([f"## {title}", "", *lines]) for title, lines in sections.items() if lines)
    return "\n\n".join(written)


def _section(write: Callable[[dict[str, Any]], list[str]], row: dict[str, Any] | None) -> list[str]:
    return [] if row is None else write(row)


def _bullets(lines: Iterable[str]) -> list[str]:
    return [f"- {line}" for line in lines]


def _format(measured: dict[str, Any]) -> list[str]:
    sizes = measured["runs"]
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
    return [
        *lines,
        "",
        "Size: of raw float32. Read: how many times faster than `torch.load` of a file a snapshot, "
        "in CPU time, digests checked.",
        "",
    ]


def _remote(results: dict[str, Any]) -> Iterator[str]:
    if (row := results.get("remote")) is None:
        return
    yield (
        f"A data set of {row['runs']} runs opened at an address and one window read: "
        f"{row['requests']} requests; over S3 on loopback "
        f"{row['open_and_window_s'] * 1000:.0f} ms (median of {row['turns']})."
    )
    yield (
        f"The window takes {row['bytes_of_the_window'] / 1e3:,.0f} kB, "
        f"{row['bytes_of_the_window'] / row['bytes_of_its_chunks']:.2f} times its chunks; opening, "
        f"once, {row['bytes_before_the_window'] / 1e3:,.0f} kB."
    )
    yield (
        f"All of it downloaded and checked takes {row['download_ratio']:.2f} times as long as "
        f"boto3's `download_file` with as many threads, which checks nothing."
    )


def _stored(results: dict[str, Any]) -> Iterator[str]:
    opening = results["format"]["opening"]
    yield (
        f"A data set of {opening['runs']} runs is {opening['objects']} objects; from its path to "
        f"the first window takes {opening['first_window_s']:.2f} s."
    )
    if "load" in results:
        yield _load(results["load"])


def _collected(results: dict[str, Any]) -> Iterator[str]:
    if "callback" in results:
        callback = results["callback"]
        yield (
            "Recording HalfCheetah 256x256 every 64 gradient steps takes "
            f"{100 * (callback['ratio_inside'] - 1):.2g} % of the training's CPU time and "
            f"{callback['extra_peak_mib'] / callback['block_mib']:.1f} blocks of memory."
        )
    for row in results.get("returns", {}).values():
        if isinstance(row, dict):
            yield _returns(row)
    for case, row in results.get("population", {}).get("cases", {}).items():
        yield (
            f"A population of {row['learners']}, {case}: {row['times_faster']:.1f} times the "
            "environment steps of SB3 in the same CPU time, both recording."
        )
    if "processes" in results:
        row = results["processes"]
        yield (
            f"{row['runs']} runs of {row['iterations']} iterations, {row['case']}: two processes "
            f"are done {row['times_faster']} times as fast as one, start-up included (turns on a "
            f"noisy machine: {', '.join(map(str, sorted(row['ratios'])))})."
        )


def _trained(results: dict[str, Any]) -> Iterator[str]:
    if "svd" in results:
        yield _svd(results["svd"])
    if "tipl_train" in results:
        yield _training(results["tipl_train"])
    if "gate" in results:
        yield _forecast(results["gate"])


def _tried(recipes: dict[str, Any]) -> list[str]:
    """The table of recipes that were tried short."""
    cases, episodes = recipes["cases"], recipes["episodes"]
    lines = [
        "| [recipe](../datasets/README.md), tried short | parameters | seeds | steps a CPU second "
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


def _training(training: dict[str, Any]) -> str:
    row = training["threads_1"]
    beside = (
        f"{row['over_transformers']:.2f} of the time of the same GPT-2 from `transformers`, "
        if "over_transformers" in row
        else ""
    )
    return (
        f"A gradient step of TIPL on one CPU thread, 64 windows of 20, {training['gflop']:.1f} "
        f"GFLOP: {beside}{row['gflop_per_s']:.0f} GFLOP/s where a matrix product alone reaches "
        f"{row['gflop_per_s_of_product']:.0f}; 100,000 batches take {row['hours_of_100k']:.1f} "
        "hours."
    )


def _forecast(gate: dict[str, Any]) -> str:
    low, high = gate["quartiles_ms"]
    return (
        f"One forecast of tipl-gate for {gate['parameters']:,} parameters, {gate['horizons']} "
        f"horizons, on one CPU thread: {gate['forecast_ms']:.0f} ms (quartiles {low:.0f} and "
        f"{high:.0f}), of which the network with what it sees of parameters "
        f"{gate['ms']['network']:.0f}, {gate['network_over_product']:.1f} times as long as a "
        f"matrix product alone takes for its {gate['gflop']:.1f} GFLOP."
    )


def _learning(learning: dict[str, Any]) -> list[str]:
    """Two samples of runs side by side, what tests say of them, and the runs of the same seeds."""
    seeds = {who: "{} to {}".format(*ends) for who, ends in learning["seeds"].items()}
    units = "x".join(map(str, learning["units"]))
    samples = [
        f"| {learning['env']} {units}, {learning['timesteps']:,} steps | "
        + " | ".join(f"{who}, seeds {numbers}" for who, numbers in seeds.items())
        + " | difference | p: means, distributions | control: difference | p |",
        "|---|" + "---:|" * (len(seeds) + 4),
    ]
    for name, row in learning["samples"].items():
        ranges = zip(row["iqm"], row["intervals"], strict=True)
        cells = [f"{iqm:,.0f} ({low:,.0f} to {high:,.0f})" for iqm, (low, high) in ranges]
        for pair in (row, learning["control"][name]):
            cells += [
                f"{pair['difference_percent']:+.1f} % ± {pair['half_width_percent']:.1f} %",
                f"{pair['p']['means']:.2g}, {pair['p']['distributions']:.2g}",
            ]
        samples.append(f"| {name} | " + " | ".join(cells) + " |")
    pairs = [
        f"| population less SB3, seeds {seeds['SB3']} | difference | p | apart: median | most "
        "| equal runs |",
        "|---|" + "---:|" * 5,
    ]
    pairs += [
        f"| {name} | {pair['difference_percent']:+.1f} % | {pair['p']:.2g} "
        f"| {pair['median_absolute']:,.0f} | {pair['max_absolute']:,.0f} | {pair['equal']} |"
        for name, pair in learning["same_seeds"].items()
    ]
    never = " and ".join(
        f"{threshold} by {sb3} and {population} runs"
        for threshold, sb3, population in zip(
            learning["thresholds"], *(learning["never"][who] for who in seeds), strict=True
        )
    )
    overlaps = sum(row["intervals_overlap"] for row in learning["samples"].values())
    return [
        f"Training returns, means of {learning['episodes']} episodes at the end of each rollout:",
        "",
        *samples,
        "",
        "Interquartile means over runs with 95 % bootstrap intervals; "
        f"{overlaps} of {len(learning['samples'])} pairs of intervals overlap. A run that never "
        f"reaches a threshold would count as the whole length; never reached: {never}. Differences "
        "are of means, with the half width of their 95 % interval: smaller ones seldom show. "
        "p by permutation, of the means and of Kolmogorov-Smirnov's statistic. Control: the "
        "population on SB3's seeds against its own seeds, so that only the seeds differ.",
        "",
        "The same seeds run by run, p by flipping signs:",
        "",
        *pairs,
    ]


def _svd(svd: dict[str, Any]) -> str:
    apart = ", ".join(f"{name}: {row['worst_of_first']:.1g}" for name, row in svd["apart"].items())
    return (
        "Temporal SVD of rank {} of {:,} snapshots x {:,} parameters, ".format(
            svd["rank"], *svd["shape"]
        )
        + f"read {svd['passes']:.0f} times from the disk: {svd['cpu_s']:.0f} CPU seconds, of which "
        f"{svd['decode_cpu_s']:.0f} decode, {svd['times_faster']:.0f} times fewer than "
        f"`numpy.linalg.svd` (extrapolated from {svd['numpy_rows']:,} snapshots, "
        f"{svd['numpy_cpu_s']:.0f} s), in {svd['peak_mb']:.0f} MB of memory. The first "
        f"{svd['compared']} singular values are right within (relative) {apart}."
    )


def _load(load: dict[str, Any]) -> str:
    rows = [f"{env}: {ratio:.2f}" for env, ratio in load["dataloader_over_memmap"].items()]
    more = [f"{env}: {ratio:.2f}" for env, ratio in load["resumable_over_memmap"].items()]
    return (
        "Random windows of 20 through the cache, `DataLoader` with 2 workers, against the same on "
        f"a bare `np.memmap`: {', '.join(rows)}; by `ResumableLoader`: {', '.join(more)}."
    )


def insert(page: str) -> str:
    """The page with the table as the results have it."""
    return between(page, START, END, render(json.loads(FILE.read_text())))


if __name__ == "__main__":
    PAGE.write_text(insert(PAGE.read_text()))
