"""Plot the path of a training through weight space, its returns, and forecasts of both.

python examples/plot_path_and_returns.py docs/path-and-returns.png
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tipl
import weighttraj as wt
from weighttraj.policies import evaluate, load_policies

STARTS, H, LAST = [20, 30, 40, 50], 50, 150  # forecasts of 50 snapshots ahead
run = wt.open("inverted-pendulum-v4-ppo-v1").split("test").runs[0]
model = tipl.load("tipl-gate")
forecasts = model.forecast(run, STARTS, [H])[:, 0]  # (start, param)
ahead = load_policies(run, STARTS).with_weights(forecasts)  # with the normaliser of each start
gained = evaluate(ahead, run, episodes=20, deterministic=False).returns.mean(axis=1)

weights = run.weights[: LAST + 1]
_, _, basis = np.linalg.svd(weights - weights.mean(0), full_matrices=False)
path, ends = ((w - weights.mean(0)) @ basis[:2].T for w in (weights, forecasts))
returns, steps = run.mean_return(deterministic=False)[: LAST + 1], run.num_timesteps[: LAST + 1]
known = np.flatnonzero(np.isfinite(returns))  # the evaluated snapshots

fig = Figure(figsize=(9, 3.4), layout="constrained")
left, right = fig.subplots(1, 2)
left.plot(*path.T, color="#a6acaf", lw=1)
colours = left.scatter(*path[known].T, c=returns[known], s=12)
fig.colorbar(colours, ax=left, label="return")
right.plot(steps[known], returns[known], color="#2471a3")
for t, end, gain in zip(STARTS, ends, gained, strict=True):
    now = np.interp(t, known, returns[known])
    left.plot(*np.stack([path[t], end]).T, "o-", color="#c0392b", ms=4)
    right.plot(steps[[t, t + H]], [now, gain], "o-", color="#c0392b", ms=4)
left.set(title="path of the weights, two principal directions", xticks=[], yticks=[])
right.set(title=f"return; in red: forecasts {H} snapshots ahead", xlabel="environment steps")
fig.savefig(sys.argv[1] if len(sys.argv) > 1 else "path-and-returns.png", dpi=110)
