"""How fast are returns measured? Environment steps per CPU second, side by side in one process.

python tests/benchmarks/bench_returns.py DATASET [DATASET ...]

For each data set, policies of one run evenly spaced over its training, 4 episodes each: through the
batched evaluator; through Stable-Baselines3's `evaluate_policy`, one policy after another; and, as
the limit, the same number of simulations in `mujoco.batch` with no policy at all, on actions that
the policies took. The last evaluation is repeated by two threads, for wall time. The three take
turns, because the machine's speed moves; medians of ratios within a turn.

And how equal: the mean return of one policy over 100 episodes by both, with its standard error.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from results import save
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

import weighttraj as wt
from weighttraj import environments
from weighttraj.policies import Evaluator, env_of, export_sb3, load_policies
from weighttraj.policies.kernels import kernel_for
from weighttraj.policies.simulators import Physics, start_of

EPISODES = 4


def by_us(evaluator: Evaluator, policies: Any) -> tuple[float, float]:
    """Environment steps per CPU second and per second."""
    cpu, wall = time.process_time(), time.perf_counter()
    steps = int(evaluator(policies).lengths.sum())
    return steps / (time.process_time() - cpu), steps / (time.perf_counter() - wall)


def by_sb3(run: wt.Run, rows: list[int], folder: Path) -> float:
    """Environment steps per CPU second of the policies one after another, loading left out."""
    steps, cpu = 0, 0.0
    for t in rows:
        model, venv = _exported(run, t, folder / str(t), 1)
        start = time.process_time()
        _, lengths = evaluate_policy(model, venv, EPISODES, return_episode_rewards=True)
        cpu += time.process_time() - start
        steps += sum(lengths)  # type: ignore[arg-type]
        venv.close()
    return steps / cpu


def _exported(run: wt.Run, t: int, folder: Path, n_envs: int) -> tuple[PPO, VecNormalize]:
    export = folder if folder.exists() else export_sb3(run, t, folder).model.parent
    venv = make_vec_env(lambda: environments.make(env_of(run).id), n_envs=n_envs, seed=0)
    return (
        PPO.load(export / "model.zip", device="cpu"),
        VecNormalize.load(str(export / "vecnormalize.pkl"), venv),
    )


def limit(run: wt.Run, sims: int, steps: int, actions: np.ndarray) -> float:
    """Environment steps per CPU second of the bare physics."""
    env = environments.make(env_of(run).id)
    kernel = kernel_for(env)
    assert kernel is not None
    starts = [start_of(kernel, env.reset(seed=i)[0]) for i in range(EPISODES)]
    physics = Physics(kernel, sims)
    physics.load(np.arange(sims), starts * (sims // EPISODES))
    batch, ctrl = physics._batch, physics._ctrl
    with environments.quiet_mujoco():
        cpu = time.process_time()
        for step in range(steps):
            ctrl[:] = actions[step]
            batch.step(nstep=kernel.env.frame_skip)
        return sims * steps / (time.process_time() - cpu)


def actions_of(evaluator: Evaluator, policies: Any, steps: int) -> np.ndarray:
    """What policies do in their first steps, (step, simulation, action)."""
    simulator, taken = evaluator._simulators[0], []
    observations = simulator.reset(len(policies))
    everything = np.arange(len(observations))
    for _ in range(steps):
        shape = (len(policies), EPISODES, *observations.shape[1:])
        taken.append(policies.act(observations.reshape(shape)))
        taken[-1] = taken[-1].reshape(len(everything), -1)
        observations = simulator.step(everything, taken[-1]).observations
    return np.stack(taken)


def agreement(run: wt.Run, folder: Path, episodes: int) -> dict[str, float]:
    """Mean return of the last policy by both, and the standard error of the mean."""
    model, venv = _exported(run, len(run) - 1, folder / "last", 10)
    theirs, _ = evaluate_policy(model, venv, episodes, return_episode_rewards=True)
    with Evaluator(env_of(run), episodes=episodes) as evaluator:
        ours = evaluator(load_policies(run, [len(run) - 1])).returns[0]
    error = float(np.std(theirs, ddof=1) / np.sqrt(episodes))
    return {
        "episodes": episodes,
        "sb3_mean": float(np.mean(theirs)),
        "mean": float(ours.mean()),
        "standard_error": error,
    }


def measure(path: Path, args: argparse.Namespace) -> dict[str, Any]:
    """All figures of the first run of a data set."""
    run = wt.open(path).runs[0]
    rows = np.linspace(0, len(run) - 1, args.policies).astype(int)
    few = rows[:: max(1, len(rows) // args.sb3_policies)].tolist()
    policies = load_policies(run, rows)
    turns: list[dict[str, float]] = []
    with (
        tempfile.TemporaryDirectory(dir="data") as folder,
        Evaluator(env_of(run), episodes=EPISODES) as one,
        Evaluator(env_of(run), episodes=EPISODES, threads=2) as two,
    ):
        actions = actions_of(one, policies, args.limit_steps)
        for _ in range(args.turns):
            sb3 = by_sb3(run, few, Path(folder))
            bare = limit(run, len(rows) * EPISODES, args.limit_steps, actions)
            cpu, wall = by_us(one, policies)
            _, wall_of_two = by_us(two, policies)
            turns.append(
                {
                    "steps_per_cpu_s": cpu,
                    "over_sb3": cpu / sb3,
                    "over_limit": cpu / bare,
                    "two_threads": wall_of_two / wall,
                }
            )
            print(path.name, json.dumps(turns[-1]), flush=True)
        equal = agreement(run, Path(folder), args.episodes)
    medians = {k: round(statistics.median(t[k] for t in turns), 3) for k in turns[0]}
    units = [run.layout[bias].size for _, bias in run.info.policy.layers[:-1]]
    return medians | {
        "policies": len(rows),
        "episodes": EPISODES,
        "units": units,
        "env": env_of(run).id,
        "agreement": equal,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("datasets", type=Path, nargs="+")
    parser.add_argument("--policies", type=int, default=256)
    parser.add_argument("--sb3-policies", type=int, default=8, help="of them, by evaluate_policy")
    parser.add_argument("--limit-steps", type=int, default=200)
    parser.add_argument("--episodes", type=int, default=100, help="to compare the means")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--save", action="store_true", help="keep the figures in results.json")
    args = parser.parse_args()
    results = {path.name: measure(path, args) for path in args.datasets}
    print(json.dumps(results, indent=1))
    if args.save:
        save("returns", results)


if __name__ == "__main__":
    main()
