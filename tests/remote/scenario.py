"""Load a published data set and a published model by name, train, and evaluate.

Run by ``test_everywhere.py``: ``python -m tests.remote.scenario DATA MODEL OUT``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import tipl
import weighttraj as wt

MODEL = "tipl-gate-inverted-pendulum-v4"


def use(data: str, model: str, out: str) -> None:
    dataset = wt.load_dataset(data, download=True)
    train = tipl.TrainConfig(data=dataset.path, out=Path(out) / "tipl")
    tipl.train(tipl.change(train, rank=8, n_batches=3, batch_size=8, seed=0))
    config = tipl.EvaluateConfig(
        data=data if data.startswith("file") else str(dataset.path),
        out=Path(out) / "results",
        starts=3,
        function_starts=1,
        learning_starts=0,
        horizons=(1, 5),
        bootstrap=20,
    )
    forecasters = [tipl.load(model), tipl.load(Path(out) / "tipl")]
    results = tipl.evaluate(forecasters, config)
    print(json.dumps({"runs": len(dataset), "judged": list(results.forecasters)}))


if __name__ == "__main__":
    use(*sys.argv[1:])
