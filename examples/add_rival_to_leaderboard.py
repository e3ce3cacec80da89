"""Evaluate a forecaster of your own on two tasks, beside two baselines, in one leaderboard.

python examples/add_rival_to_leaderboard.py
"""

from pathlib import Path

import numpy as np

import tipl
from tipl.evaluation.leaderboard import leaderboard
from tipl.evaluation.rows import read_rows

OUT = Path("data/examples/leaderboard")
TASKS = ["swimmer-v4-ppo-16x16-v1", "reacher-v4-ppo-16x16-v1"]


class HalfStep(tipl.Forecaster):
    """Repeat the last step once, half as long, at every horizon."""

    name = "half-step"

    def forecast(self, run, starts, horizons):
        """Return the forecast weights, (start, horizon, param)."""
        now = np.stack([run.weights[t] for t in starts])
        before = np.stack([run.weights[max(t - 1, 0)] for t in starts])
        return np.repeat((now + (now - before) / 2)[:, None], len(horizons), axis=1)


amount = {"horizons": (1, 10), "starts": 50, "function_starts": 0, "learning_starts": 0}
for task in TASKS:
    config = tipl.EvaluateConfig(data=task, out=OUT / task, bootstrap=200, **amount)
    tipl.evaluate([HalfStep(), tipl.load("last-step"), tipl.load("ema-0.9")], config)

rows = [row for task in TASKS for row in read_rows(OUT / task / "rows.csv")]
for entry in leaderboard(rows, rival="ema-0.9").entries:
    print(f"{entry.measure}, h = {entry.horizon}: {entry.forecaster} {entry.score.value:.2f}")
