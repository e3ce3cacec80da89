"""Where does a jump lead: direction and length of forecasts beside PPO's own way.

python docs/studies/jump_direction.py --measure    # measure, then render
python docs/studies/jump_direction.py              # render what was measured

Writes jump_direction.json, and the table in jump_direction.md, beside this file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.progress import track
from study import Study, parser

import tipl
import weighttraj as wt
from tipl.evaluation.statistics import Bootstrap, mean
from tipl.runs import weights_of

DATA = {
    "inverted-pendulum-v4-ppo-v1": "InvertedPendulum",
    "half-cheetah-v4-ppo-16x16-v1": "HalfCheetah",
}
FORECASTERS = ("last-iteration", "ema-0.9", "tipl-gate")
PARTS = ("first quarter", "middle", "last quarter")
FIGURES = ("cosine with PPO's way", "cosine with the last iteration", "length, last iteration = 1")
ITERATION = 5
"""Number of snapshots of an iteration."""


def measure(h: int, starts: int) -> list[dict[str, Any]]:
    """Return one line for each data set, part of the training and forecaster."""
    lines = []
    for data in DATA:
        found: dict[tuple[str, str], list[np.ndarray]] = {}
        for run in track(wt.open(data).split("test").runs, data):
            for part, name, figures in _of_run(run, h, starts):
                found.setdefault((part, name), []).append(figures)
        bootstrap = Bootstrap(resamples=2000, seed=0)
        for (part, name), rows in found.items():
            cells = bootstrap.interval(mean, np.array(rows))
            lines.append(
                {"data": data, "part": part, "forecaster": name, "runs": len(rows), "h": h}
                | dict(zip(FIGURES, cells, strict=True))
            )
    return lines


def _of_run(run: wt.Run, h: int, starts: int) -> list[tuple[str, str, np.ndarray]]:
    """Return the figures of a run: means over starts at the ends of iterations."""
    weights = weights_of(run).astype(np.float64)
    last = len(weights) - 1 - h
    places = np.unique(np.linspace(2 * ITERATION, last, starts, dtype=int) // ITERATION * ITERATION)
    before, after = (weights[places] - weights[places - ITERATION], weights[places + h])
    way = after - weights[places]
    quarter = np.minimum(4 * places // last, 3)
    chosen = {"first quarter": quarter == 0, "last quarter": quarter == 3}
    chosen["middle"] = ~(chosen["first quarter"] | chosen["last quarter"])
    lines = []
    for name in FORECASTERS:
        ahead = tipl.load(name).forecast(run, places.tolist(), [h])[:, 0]
        moved = ahead - weights[places]
        figures = np.stack(
            [_cosine(moved, way), _cosine(moved, before), _norm(moved) / _norm(before)], axis=1
        )
        lines += [(part, name, figures[chosen[part]].mean(0)) for part in PARTS]
    return lines


def _cosine(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.asarray((one * other).sum(1) / (_norm(one) * _norm(other)))


def _norm(moved: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt((moved * moved).sum(1)))


def table(measured: list[dict[str, Any]]) -> str:
    """Return the table in Markdown."""
    lines = [
        f"| task | part of the training | forecaster | {' | '.join(FIGURES)} |",
        f"|---|---|---|{'---:|' * len(FIGURES)}",
    ]
    for row in measured:
        cells = " | ".join(_told(row[name]) for name in FIGURES)
        lines.append(f"| {DATA[row['data']]} | {row['part']} | {row['forecaster']} | {cells} |")
    return "\n".join(lines)


def _told(cell: dict[str, float]) -> str:
    return f"{cell['value']:.2f} [{cell['low']:.2f}, {cell['high']:.2f}]"


STUDY = Study(__file__, table)


def main() -> None:
    """Measure if asked to, and render."""
    arguments = parser(__doc__)
    arguments.add_argument("--measure", action="store_true")
    arguments.add_argument("--horizon", type=int, default=50)
    arguments.add_argument("--starts", type=int, default=120, help="starts of each run")
    options = arguments.parse_args()
    if options.measure:
        STUDY.keep(measure(options.horizon, options.starts))
    STUDY.render()


if __name__ == "__main__":
    main()
