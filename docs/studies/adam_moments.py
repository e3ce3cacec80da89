"""What are Adam's moments worth to tipl-gate? It is trained with and without them.

weighttraj collect docs/studies/adam_moments.toml                       # half an hour of CPU
python docs/studies/adam_moments.py --models data/results/adam-moments  # train, measure, render
python docs/studies/adam_moments.py                                     # render what was measured

Trainings that stopped go on. Writes adam_moments.json and the table in adam_moments.md, beside
this file.
"""

from __future__ import annotations

from pathlib import Path

from study import Study, parser
from variants import compare, table

from tipl import change
from tipl.models.gate import GateTrainConfig

DATA = Path("data/inverted-pendulum-v4-ppo-adam")
WHOLE = "weights alone"


def variants(data: Path, models: Path, n_batches: int) -> dict[str, GateTrainConfig]:
    """What is trained: each with two seeds."""
    return {
        f"{name}{', another seed' if seed else ''}": change(
            GateTrainConfig(data=(data,), out=models / f"{'adam' if adam else 'weights'}-{seed}"),
            n_batches=n_batches,
            seed=seed,
            adam=bool(adam),
        )
        for adam, name in enumerate((WHOLE, "with Adam's moments"))
        for seed in (0, 1)
    }


STUDY = Study(__file__, table)


def main() -> None:
    """Measure, if a folder for the models is given, and render."""
    options = parser(__doc__)
    options.add_argument("--models", type=Path, help="folder of the trained networks")
    options.add_argument("--data", type=Path, default=DATA, help="runs that store the moments")
    options.add_argument("--n-batches", type=int, default=4_000)
    options.add_argument("--workers", type=int, default=2)
    args = options.parse_args()
    if args.models:
        result = compare(variants(args.data, args.models, args.n_batches), WHOLE, args.workers)
        STUDY.keep(result)
    STUDY.render()


if __name__ == "__main__":
    main()
