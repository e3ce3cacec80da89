"""What is each input of tipl-gate worth? It is trained without each, and judged on test runs.

python docs/studies/gate_inputs.py --models data/results/gate-inputs   # train, measure, render
python docs/studies/gate_inputs.py                                     # render what was measured

Trainings that stopped go on. Writes gate_inputs.json and the table in gate_inputs.md, beside this
file.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import get_args

from page import insert as insert_into
from variants import compare, table

from tipl.gate import GateTrainConfig
from tipl.models.gate import Input

HERE = Path(__file__)
RESULTS, PAGE = HERE.with_suffix(".json"), HERE.with_suffix(".md")
DATA = "inverted-pendulum-v4-ppo-v1"
WHOLE, AGAIN = "all inputs", "all inputs, another seed"


def variants(models: Path, n_batches: int) -> dict[str, GateTrainConfig]:
    """What is trained."""

    def config(name: str, seed: int, *without: Input) -> GateTrainConfig:
        out = models / name.replace(", ", "-").replace(" ", "-")
        return GateTrainConfig(
            data=(DATA,), out=out, n_batches=n_batches, seed=seed, without=without
        )

    found = {WHOLE: config(WHOLE, 0), AGAIN: config(AGAIN, 1)}
    for name in get_args(Input):
        found[f"without {name}"] = config(f"without {name}", 0, name)
    return found


def insert(page: str) -> str:
    """The page with the table as the results have it."""
    return insert_into(page, HERE, table(json.loads(RESULTS.read_text())))


def main() -> None:
    """Measure, if a folder for the models is given, and render."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", type=Path, help="folder of the trained networks")
    parser.add_argument("--n-batches", type=int, default=4_000)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    if args.models:
        result = compare(variants(args.models, args.n_batches), WHOLE, args.workers)
        RESULTS.write_text(json.dumps(result) + "\n")
    PAGE.write_text(insert(PAGE.read_text()))


if __name__ == "__main__":
    main()
