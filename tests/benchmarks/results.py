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
    return "\n".join(lines)


def _returns(row: dict[str, Any]) -> str:
    units = "x".join(map(str, row["units"]))
    return (
        f"Returns of {row['policies']} policies x {row['episodes']} episodes, {row['env']} "
        f"{units}: {row['over_sb3']:.1f} times as fast as `evaluate_policy` one after another, "
        f"{row['over_limit']:.2f} of the speed of the bare physics; two threads "
        f"{row['two_threads']:.1f} times as fast as one."
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
    before, rest = page.split(START)
    _, after = rest.split(END)
    return f"{before}{START}\n\n{render(json.loads(FILE.read_text()))}\n\n{END}{after}"


if __name__ == "__main__":
    README.write_text(insert(README.read_text()))
