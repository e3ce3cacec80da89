"""Is a forecast worth anything on HalfCheetah, where 100 snapshots change little?

python docs/studies/half_cheetah_gain.py DATASET    # measure, then render
python docs/studies/half_cheetah_gain.py            # render what was measured

Writes half_cheetah_gain.json, and the table in half_cheetah_gain.md, beside this file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress
from study import Study, parser

import tipl
import weighttraj as wt
from tipl.evaluation.returns import Player, forecast_returns, true_returns
from tipl.evaluation.statistics import Bootstrap, Cell, mean, ratio_of_sums

FORECASTERS = (
    *("tipl-gate-half-cheetah-v4", "tipl-gate-inverted-pendulum-v4"),
    *("last-step", "trend-20", "trend-200", "ema-0.9", "ema-0.95", "ema-0.98"),
)
NOW, LATER = "phi_t", "phi_{t+h}, by PPO"


def measure(data: Path, h: int, starts: int, episodes: int) -> dict[str, Any]:
    """Returns at starts over the first half of the test runs, with the exploration noise of t."""
    runs = wt.open(data).split("test").runs
    forecasters = {name: tipl.load(name) for name in FORECASTERS}
    returns: dict[str, list[np.ndarray]] = {}
    with Progress() as progress:
        task = progress.add_task("policies", total=len(runs) * starts * (2 + len(forecasters)))

        def tick(count: int) -> None:
            progress.advance(task, count)

        for run in runs:
            t = np.linspace(0, len(run) // 2, starts + 2)[1:-1].round().astype(int)
            with Player(run, episodes, 0, modes=("held",)) as player:
                true = true_returns(player, run, t, [h], tick)
                found = {NOW: true["now"][0], LATER: true["later"][0, :, 0]}
                for name, one in forecasters.items():
                    played = forecast_returns(one, player, run, t, [h], tick)
                    found[name] = played["forecast"][0, :, 0]
            for name, values in found.items():
                returns.setdefault(name, []).append(values)
    bootstrap = Bootstrap(resamples=2000, seed=0)
    arrays = {name: np.array(values) for name, values in returns.items()}  # (run, start)
    now = arrays[NOW].sum(1, keepdims=True)
    later = arrays[LATER].sum(1, keepdims=True)
    return {
        "data": data.name,
        "runs": [run.id for run in runs],
        "h": h,
        "starts": starts,
        "episodes": episodes,
        "env_steps": float(np.mean([run.num_timesteps[h] for run in runs])),
        "return": {
            name: bootstrap.interval(mean, values.mean(1, keepdims=True))[0]
            for name, values in arrays.items()
        },
        "added": {
            name: bootstrap.interval(mean, (values - arrays[NOW]).mean(1, keepdims=True))[0]
            for name, values in arrays.items()
        },
        "gain": {
            name: bootstrap.interval(
                ratio_of_sums, values.sum(1, keepdims=True) - now, later - now
            )[0]
            for name, values in arrays.items()
        },
    }


def table(result: dict[str, Any]) -> str:
    """Mean returns and gains, best forecasts first.

    A gain has no interval: in some resamples PPO itself gains nothing to divide by.
    """
    names = sorted(result["gain"], key=lambda name: -result["gain"][name]["value"])
    names = [NOW, LATER, *(name for name in names if name not in (NOW, LATER))]
    lines = ["| policy | mean return | added to phi_t | inference gain |", "|---|---:|---:|---:|"]
    for name in names:
        added = "" if name == NOW else _told(result["added"][name], 0)
        gain = "" if name in (NOW, LATER) else f"{result['gain'][name]['value']:.2f}"
        lines.append(f"| {name} | {_told(result['return'][name], 0)} | {added} | {gain} |")
    told = (
        f"`{result['data']}`, test runs {', '.join(result['runs'])}: {result['starts']} starts in "
        f"the first half of each, h = {result['h']} ({result['env_steps']:,.0f} environment steps "
        f"of PPO), {result['episodes']} episodes for each policy, `log_std` of t for all. 95 % "
        "intervals: bootstrap over runs."
    )
    return "\n".join([*lines, "", told])


def _told(cell: Cell, digits: int) -> str:
    value, low, high = (f"{cell[key]:.{digits}f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]"


STUDY = Study(__file__, table)


def main() -> None:
    """Measure, if a data set is given, and render."""
    options = parser(__doc__)
    options.add_argument("data", type=Path, nargs="?", help="half-cheetah-v4-ppo-v1, collected")
    options.add_argument("--h", type=int, default=100)
    options.add_argument("--starts", type=int, default=24)
    options.add_argument("--episodes", type=int, default=10)
    args = options.parse_args()
    if args.data:
        found = measure(args.data, args.h, args.starts, args.episodes)
        STUDY.keep(found)
    STUDY.render()


if __name__ == "__main__":
    main()
