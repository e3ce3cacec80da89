"""Does tipl-gate forecast the training of a task that it was not trained on?

python docs/studies/across_tasks.py --out data/results/across-tasks  # collect, train, evaluate
python docs/studies/across_tasks.py                                  # render what was measured

Collects short runs of four environments, from the recipes of datasets/ (a quarter of an hour of
CPU), trains on what the table names, and evaluates on test runs of each; those of HalfCheetah must
have been collected. The same command continues a stopped one. Writes across_tasks.json, and the
table in across_tasks.md, beside this file.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from study import Study, parser

import tipl
import weighttraj as wt
from tipl.evaluation.statistics import Bootstrap, Cell, quotient
from tipl.evaluation.weights import squared_errors
from tipl.forecaster import Forecaster
from tipl.models.baselines import Persistence
from tipl.models.gate import GateTrainConfig, train_gate
from weighttraj.collect import collect, read_recipe
from weighttraj.collect.settings import Seeds
from weighttraj.engine import Tell, engine_of

RECIPES = Path(__file__).parents[2] / "datasets"
SHORT = {
    name: f"{name.lower()}-v4-ppo-v1"
    for name in ("Hopper", "Inverted-Double-Pendulum", "Reacher", "Swimmer")
}
RELEASED = {
    "InvertedPendulum": "tipl-gate-inverted-pendulum-v4",
    "HalfCheetah": "tipl-gate-half-cheetah-v4",
}
"""Released gates, by the task that they were trained on."""
STEPS = 163_840
"""Environment steps of a short run: 80 iterations of PPO."""
SEEDS = Seeds(train=[0, 1, 2, 3], validation=[6], test=[8, 9])
PENDULUM, CHEETAH = "inverted-pendulum-v4-ppo-v1", "half-cheetah-v4-ppo-v1"
HORIZONS = (1, 10, 50, 200)
BOOTSTRAP = Bootstrap(resamples=2000, seed=0)


def collect_short(out: Path) -> list[Path]:
    """The four data sets of short runs; those that are there are left alone."""
    found = []
    for name in SHORT.values():
        recipe = read_recipe(RECIPES / name / "recipe.toml")
        ppo = replace(recipe.ppo, total_timesteps=STEPS)
        found.append(out / name)
        collect(replace(recipe, ppo=ppo, seeds=SEEDS), found[-1], console=Console())
    return found


def trainings(out: Path, short: list[Path], n_batches: int) -> dict[str, GateTrainConfig]:
    """What is trained, by what it learns from."""
    training = replace(GateTrainConfig.training, n_batches=n_batches)
    config = partial(GateTrainConfig, training=training)
    return {
        "the four": config(data=tuple(short), out=out / "gate-four"),
        "InvertedPendulum and the four": config(data=(PENDULUM, *short), out=out / "gate-five"),
    }


def train(config: GateTrainConfig, tell: Tell) -> None:
    """One of them."""
    train_gate(config)


def errors_of(task: tuple[Forecaster, str, int, int], tell: Tell) -> np.ndarray:
    """Sums of squared errors at each horizon: a forecaster, a data set, number of the run, starts.

    Starts are drawn, and are the same for every forecaster.
    """
    forecaster, data, number, count = task
    run = wt.open(data).split("test").runs[number]
    last = len(run) - 1 - max(HORIZONS)
    rng = np.random.default_rng([0, number])
    starts = 1 + np.sort(rng.permutation(last)[:count])
    errors = squared_errors(forecaster, run, starts, HORIZONS, lambda _: None)
    return np.asarray(errors["squared"].sum((0, 2)))


def measure(out: Path, cheetah: Path, n_batches: int, starts: int, workers: int) -> dict[str, Any]:
    """Skill of each gate on the test runs of each data set."""
    short = collect_short(out)
    wanted = trainings(out, short, n_batches)
    evaluated_on = {"InvertedPendulum": PENDULUM, "HalfCheetah": str(cheetah)}
    evaluated_on |= {
        name.replace("-", ""): str(path) for name, path in zip(SHORT, short, strict=True)
    }
    with ExitStack() as stack:
        engine = stack.enter_context(engine_of(workers))
        progress = stack.enter_context(Progress())
        bar = progress.add_task("trainings", total=len(wanted))
        for _, failed in engine.run(train, list(wanted.values()), lambda *_: None):
            if isinstance(failed, Exception):
                raise failed
            progress.advance(bar)
        models: dict[str, Forecaster] = {"copy": Persistence()}
        models |= {name: tipl.load(config.out) for name, config in wanted.items()}
        models |= {name: tipl.load(model) for name, model in RELEASED.items()}
        tasks = [
            (model, data, number, starts)
            for data in evaluated_on.values()
            for number in range(len(wt.open(data).split("test").runs))
            for model in models.values()
        ]
        bar = progress.add_task("runs", total=len(tasks))
        errors: dict[tuple[int, str], dict[int, np.ndarray]] = {}
        for task, outcome in engine.run(errors_of, tasks, lambda *_: None):
            if isinstance(outcome, Exception):
                raise outcome
            model, data, number, _ = task
            errors.setdefault((id(model), data), {})[number] = outcome
            progress.advance(bar)

    def of(model: Forecaster, data: str) -> np.ndarray:
        found = errors[id(model), data]
        return np.array([found[number] for number in sorted(found)])

    skill = {
        name: {
            place: BOOTSTRAP.interval(_skill, of(model, data), of(models["copy"], data))
            for place, data in evaluated_on.items()
        }
        for name, model in models.items()
        if name != "copy"
    }
    runs = {place: len(wt.open(data).split("test").runs) for place, data in evaluated_on.items()}
    return {
        "n_batches": n_batches,
        "starts": starts,
        "steps": STEPS,
        "horizons": HORIZONS,
        "runs": runs,
        "skill": skill,
    }


def _skill(error: np.ndarray, copy: np.ndarray) -> np.ndarray:
    return 1 - quotient(error.sum(0), copy.sum(0))


def table(result: dict[str, Any]) -> str:
    """Return one table a horizon; tasks that a gate was not trained on are marked."""
    places = list(result["runs"])
    lines = []
    for row, h in enumerate(result["horizons"]):
        lines += [
            f"| h = {h}: trained on | " + " | ".join(places) + " |",
            "|---|" + "---:|" * len(places),
        ]
        for name, skill in result["skill"].items():
            cells = (_told(skill[place][row], _foreign(name, place)) for place in places)
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines.append("")
    count = ", ".join(f"{n} of {place}" for place, n in result["runs"].items())
    return "\n".join(
        [
            *lines,
            f"Skill (0 is persistence, 1 the truth) at {result['starts']} starts of each test "
            f"run: {count}. In italics: runs of tasks that the gate has not seen. The four: short "
            f"runs of {result['steps']:,} environment steps; {result['n_batches']:,} batches. The "
            "gates of one task are the released ones. 95 % intervals: bootstrap over runs.",
        ]
    )


def _foreign(trained_on: str, place: str) -> bool:
    if place in ("InvertedPendulum", "HalfCheetah"):
        return place not in trained_on.split(" and ")
    return "the four" not in trained_on


def _told(cell: Cell, foreign: bool) -> str:
    value, low, high = (f"{cell[key]:.3f}" for key in ("value", "low", "high"))
    told = f"{value} [{low}, {high}]"
    return f"*{told}*" if foreign else told


STUDY = Study(__file__, table)


def main() -> None:
    """Collect, train and measure, if a folder is given, and render."""
    options = parser(__doc__)
    options.add_argument("--out", type=Path, help="folder of the short runs and the networks")
    options.add_argument("--cheetah", type=Path, default=Path("data") / CHEETAH)
    options.add_argument("--n-batches", type=int, default=4_000)
    options.add_argument("--starts", type=int, default=200)
    options.add_argument("--workers", type=int, default=1)
    args = options.parse_args()
    if args.out:
        found = measure(args.out, args.cheetah, args.n_batches, args.starts, args.workers)
        STUDY.keep(found)
    STUDY.render()


if __name__ == "__main__":
    main()
