"""One forecast, early in training: how far does it get?

python docs/studies/one_jump.py --measure    # measure, then render
python docs/studies/one_jump.py              # render what was measured

Writes one_jump.json, and the table in one_jump.md, beside this file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.progress import track
from study import Study, parser

import tipl
import weighttraj as wt
from tipl.evaluation.returns import Player, forecast_returns, true_returns
from tipl.evaluation.statistics import Bootstrap, Cell, mean

DATA = "inverted-pendulum-v4-ppo-v1"
MODELS = ("tipl-gate", "tipl-drift", "tipl-causal", "tipl", "ar-20-phase")
FORECASTERS = (
    *(f"{model}-inverted-pendulum-v4" for model in MODELS),
    *("last-step", "trend-5", "trend-20", "trend-50", "ema-0.9", "ema-0.95", "ema-0.98"),
)
MODES = ("sampled", "held")
NOW, LATER = "phi_t", "phi_{t+h}, by PPO"


def measure(t: int, h: int, episodes: int) -> dict[str, Any]:
    """Returns over the test runs."""
    runs = wt.open(DATA).split("test").runs
    forecasters = {name: tipl.load(name) for name in FORECASTERS}
    returns: dict[str, list[np.ndarray]] = {}
    starts = np.array([t])
    for run in track(runs, "test runs"):
        with Player(run, episodes, 0, modes=MODES) as player:
            true = true_returns(player, run, starts, [h], lambda _: None)
            found = {NOW: true["now"][:, 0], LATER: true["later"][:, 0, 0]}
            for name, one in forecasters.items():
                played = forecast_returns(one, player, run, starts, [h], lambda _: None)
                found[name] = played["forecast"][:, 0, 0]
        for name, values in found.items():
            returns.setdefault(name, []).append(values)
    bootstrap = Bootstrap(resamples=2000, seed=0)
    steps = [int(run.num_timesteps[t + h] - run.num_timesteps[t]) for run in runs]
    return {
        "data": DATA,
        "runs": len(runs),
        "t": t,
        "h": h,
        "episodes": episodes,
        "env_steps": float(np.mean(steps)),
        "returns": {
            name: dict(zip(MODES, bootstrap.interval(mean, np.array(values)), strict=True))
            for name, values in returns.items()
        },
    }


def table(result: dict[str, Any]) -> str:
    """Mean returns, best forecasts first."""
    returns = dict(result["returns"])
    first = {name: returns.pop(name) for name in (NOW, LATER)}
    ranked = sorted(returns.items(), key=lambda item: -item[1]["held"]["value"])
    lines = [
        "| policy | mean return, sampled actions | the same, `log_std` of t |",
        "|---|---:|---:|",
    ]
    lines += [
        f"| {name} | {_told(modes['sampled'])} | {_told(modes['held'])} |"
        for name, modes in [*first.items(), *ranked]
    ]
    told = (
        f"`{result['data']}`, {result['runs']} test runs, t = {result['t']}, h = {result['h']}: "
        f"{result['env_steps']:,.0f} environment steps of PPO. {result['episodes']} episodes for "
        "each policy; 95 % intervals: bootstrap over runs."
    )
    return "\n".join([*lines, "", told])


def _told(cell: Cell) -> str:
    return f"{cell['value']:.0f} [{cell['low']:.0f}, {cell['high']:.0f}]"


STUDY = Study(__file__, table)


def main() -> None:
    """Measure, if asked to, and render."""
    options = parser(__doc__)
    options.add_argument("--measure", action="store_true")
    options.add_argument("--t", type=int, default=40)
    options.add_argument("--h", type=int, default=50)
    options.add_argument("--episodes", type=int, default=20)
    args = options.parse_args()
    if args.measure:
        STUDY.keep(measure(args.t, args.h, args.episodes))
    STUDY.render()


if __name__ == "__main__":
    main()
