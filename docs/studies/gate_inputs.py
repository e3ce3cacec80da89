"""What is each input of tipl-gate worth? It is trained without each, and evaluated on test runs.

python docs/studies/gate_inputs.py --models data/results/gate-inputs   # train, measure, render
python docs/studies/gate_inputs.py                                     # render what was measured

Trainings that stopped go on. Writes gate_inputs.json and the table in gate_inputs.md, beside this
file.
"""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from study import Study, parser
from variants import compare, table

from tipl import change
from tipl.models.gate import GateTrainConfig
from tipl.models.gate.network import Input

DATA = "inverted-pendulum-v4-ppo-v1"
WHOLE, AGAIN = "all inputs", "all inputs, another seed"


def variants(models: Path, n_batches: int) -> dict[str, GateTrainConfig]:
    """What is trained."""

    def config(name: str, seed: int, *without: Input) -> GateTrainConfig:
        out = models / name.replace(", ", "-").replace(" ", "-")
        config = GateTrainConfig(data=(DATA,), out=out)
        return change(config, n_batches=n_batches, seed=seed, without=without)

    found = {WHOLE: config(WHOLE, 0), AGAIN: config(AGAIN, 1)}
    for name in get_args(Input):
        found[f"without {name}"] = config(f"without {name}", 0, name)
    return found


STUDY = Study(__file__, table)


def main() -> None:
    """Measure, if a folder for the models is given, and render."""
    options = parser(__doc__)
    options.add_argument("--models", type=Path, help="folder of the trained networks")
    options.add_argument("--n-batches", type=int, default=4_000)
    options.add_argument("--workers", type=int, default=2)
    args = options.parse_args()
    if args.models:
        result = compare(variants(args.models, args.n_batches), WHOLE, args.workers)
        STUDY.keep(result)
    STUDY.render()


if __name__ == "__main__":
    main()
