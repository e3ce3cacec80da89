"""Puts a trained forecaster into the zoo, with what is known of it.

What is released must be what was evaluated, byte for byte, and a model above 3 MB is rounded when
it is released. So there are two steps, with the evaluation between them::

    tipl release FOLDER --name NAME
    tipl evaluate NAME ... --data DATA --out OUT
    tipl release FOLDER --name NAME --results OUT/results.json

The first step puts the model into the zoo, rounded if necessary, as a draft without figures, where
it is evaluated by its name. The second one adds the figures if the results are those of the bytes
in the zoo (``fingerprint``). A model that needs no rounding can be evaluated before.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
from safetensors.numpy import load_file, save

import weighttraj as wt
from tipl import registry
from tipl.checks.results import CheckResults, read_checks
from tipl.errors import ModelError
from tipl.evaluation.leaderboard import leaderboard
from tipl.evaluation.results import Results, Scores, TaskScore, read_results, write_document
from tipl.evaluation.rows import read_rows
from tipl.forecaster import every_of
from tipl.report.scores import REPW, SKILL, function_skill, oracles, shown
from tipl.saved import ARRAYS, CONFIG, fingerprint
from tipl.zoo.metrics import FILE, Metrics, TrainedOn, read_metrics

MOST = 3_000_000
"""Largest size of a model's arrays in bytes, after rounding to float16 if necessary."""
ON_CARDS = (("skill", 1), ("skill", 10), ("skill", 200), ("gain", 50))
"""Measures and horizons that a card shows for each of several tasks."""
LINES = 100
"""Number of lines of a training's log that are kept."""
_NAME = re.compile(r"[a-z0-9][a-z0-9.-]*")
_OF_THE_MACHINE = (
    "data",
    "out",
    "runs",
    "along",
    "gate",
    "chosen_on",
    "validation",
    "device",
    "threads",
    "compile",
)
"""Settings of a training that say nothing of the model."""


def release(
    folder: Path,
    name: str,
    *,
    results: Path | None = None,
    checks: Path | None = None,
    rows: Sequence[Path] = (),
    log: bool = True,
) -> Path:
    """Copy a forecaster into the zoo, with what is known of it; return its folder there.

    Nothing in the zoo changes before everything is checked. What was known of the same bytes and is
    not given again stays.

    Args:
        folder: folder of the trained model; its train.json and log.jsonl are read if they exist.
        name: name in the zoo.
        results: a results.json in which the model of the zoo was evaluated; None: a draft.
        checks: what ``tipl check`` wrote of it.
        rows: CSV files of several tasks in which it was evaluated by its name in the zoo, as a
            whole or by trainings ``NAME@0``, ``NAME@1``, ...
        log: keep some lines of the training's log.

    Raises:
        ModelError: the folder holds no forecaster or too large a one, the name is invalid, or
            results or checks are of other bytes.
    """
    _check_name(name)
    out = registry.MODELS / name
    with TemporaryDirectory() as scratch:
        draft = Path(scratch) / name
        _copy(folder, draft)
        metrics = _metrics(folder, draft, results=results, checks=checks, log=log)
        if metrics is not None and rows:
            metrics = replace(metrics, tasks=task_scores(name, rows))
        shutil.copytree(draft, out, dirs_exist_ok=True)
    if metrics is None:
        (out / FILE).unlink(missing_ok=True)
    else:
        write_document(out / FILE, metrics)
    return out


def _metrics(
    folder: Path, draft: Path, *, results: Path | None, checks: Path | None, log: bool
) -> Metrics | None:
    """Return what is known of a model that is about to be released; None: it is a draft."""
    name, forecaster = draft.name, registry.load(draft)
    mark, known = fingerprint(forecaster), read_metrics(registry.MODELS / draft.name)
    if known is not None and known.fingerprint != mark:
        known = None  # metrics of a model that was released before
    checked = known.checks if known else None
    if checks is not None:
        checked = _checks(checks, mark, name)
    if results is None:
        return replace(known, checks=checked) if known else None
    document = read_results(results)
    evaluated_as = _find(document, mark, name, results)
    return Metrics(
        name=name,
        kind=registry.kind_in(folder),
        causal=forecaster.causal,
        fingerprint=mark,
        evaluated_as=evaluated_as,
        results=reduced(document, evaluated_as),
        **_training(folder, known, log),
        tasks=known.tasks if known else (),
        checks=checked,
    )


def task_scores(name: str, rows: Sequence[Path]) -> tuple[TaskScore, ...]:
    """Return the scores of one forecaster on all tasks, at the horizons that a card shows.

    Raises:
        ModelError: the rows have no forecaster of this name.
    """
    board = leaderboard(row for file in rows for row in read_rows(file))
    found = tuple(
        score
        for score in board.scores
        if score.forecaster == name and (score.measure, score.horizon) in ON_CARDS
    )
    if not found:
        raise ModelError(
            "the rows hold no scores of the model",
            expected=f"a forecaster {name} or {name}@0 in rows.csv",
            got=sorted({score.forecaster for score in board.scores}),
            where=", ".join(map(str, rows)),
            do="evaluate the model by this name, or in a folder of this name",
        )
    return found


def _training(folder: Path, known: Metrics | None, log: bool) -> dict[str, Any]:
    """Return what the folder says of the training, or else what was known of it."""
    settings = _json(folder / "train.json")
    if not settings and known is not None:
        return {
            "trained_on": known.trained_on,
            "settings": known.settings,
            "log": known.log if log else [],
        }
    return {
        "trained_on": _trained_on(settings),
        "settings": {k: v for k, v in settings.items() if k not in _OF_THE_MACHINE},
        "log": thinned(folder / "log.jsonl") if log else [],
    }


def reduced(results: Results, evaluated_as: str) -> Results:
    """Return results of the forecasters and figures that a card shows."""
    chosen = {evaluated_as, *shown(results), *oracles(results)}
    forecasters = {
        name: Scores(
            kind=scores.kind,
            causal=scores.causal,
            is_oracle=scores.is_oracle,
            wpe=scores.wpe,
            repw_ratio=scores.repw_ratio,
            skill={"ratio_of_sums": {"all": tuple(SKILL(scores))}} if scores.skill else {},
            function_skill={"all": rows} if (rows := function_skill(scores)) else {},
            gain={"held": scores.gain["held"]} if scores.gain.get("held") else {},
            repw={"sampled": {"learning": tuple(REPW(scores))}} if REPW(scores) else {},
        )
        for name, scores in results.forecasters.items()
        if name in chosen
    }
    return msgspec.structs.replace(results, forecasters=forecasters)


def thinned(log: Path) -> list[dict[str, float]]:
    """Return a log; of a long one ``LINES`` lines at most, evenly spaced on a logarithmic scale."""
    if not log.exists():
        return []
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    last = len(lines) - 1
    chosen = np.arange(last + 1)
    if last >= LINES:
        chosen = np.unique(np.geomspace(1, last + 1, LINES).round().astype(int)) - 1
    return [{k: v for k, v in lines[i].items() if k != "batches_per_s"} for i in chosen]


def _check_name(name: str) -> None:
    if _NAME.fullmatch(name) is None or name in registry.unfitted():
        raise ModelError(
            "a model of the zoo cannot be called this",
            expected="lower-case letters, digits, dots and hyphens; no name of a baseline",
            got=name,
            do="choose another --name",
        )


def _copy(folder: Path, out: Path) -> None:
    """Write config.json, and the arrays, rounded if they are too large.

    Only matrices are rounded: vectors are small, and scales among them need their digits.
    """
    arrays = load_file(folder / ARRAYS) if (folder / ARRAYS).exists() else None
    packed = None if arrays is None else save(arrays)
    if arrays is not None and packed is not None and len(packed) > MOST:
        with np.errstate(over="ignore"):
            arrays = {
                name: array.astype(np.float16)
                if array.ndim > 1 and array.dtype == np.float32
                else array
                for name, array in arrays.items()
            }
        packed = save(arrays)
        if len(packed) > MOST or not all(np.isfinite(v).all() for v in arrays.values()):
            raise ModelError(
                "the model is too large for the zoo",
                expected=f"at most {MOST:,} bytes of finite numbers in float16",
                got=f"{len(packed):,} bytes",
                where=folder,
                do="train a smaller one, or keep it in a folder of its own",
            )
    out.mkdir(parents=True, exist_ok=True)
    if packed is not None:
        (out / ARRAYS).write_bytes(packed)
    shutil.copyfile(folder / CONFIG, out / CONFIG)
    for inner in folder.glob(f"*/{CONFIG}"):  # a forecast along another one
        _copy(inner.parent, out / inner.parent.name)


def _find(results: Results, mark: str, name: str, where: Path) -> str:
    """Return the name of the model of these bytes in the results."""
    marks = {n: s.fingerprint for n, s in results.forecasters.items()}
    if results.split == "train" or mark not in marks.values():
        raise ModelError(
            "the results are not of this model on runs that it has not seen",
            expected=f"a forecaster of fingerprint {mark}, on the validation or test split",
            got=f"{results.split} split: {marks}",
            where=where,
            do="release it without results, evaluate what then lies in the zoo, "
            f"`tipl evaluate {name} ...`, and give those results",
        )
    return next(str(n) for n, m in marks.items() if m == mark)


def _checks(file: Path, mark: str, name: str) -> CheckResults:
    checks = read_checks(file)
    if checks.fingerprint != mark:
        raise ModelError(
            "the checks are not of this model",
            expected=f"fingerprint {mark}",
            got=checks.fingerprint,
            where=file,
            do=f"release it without them, and check what then lies in the zoo: `tipl check {name} "
            "...`",
        )
    return checks


def _trained_on(settings: dict[str, Any]) -> tuple[TrainedOn, ...]:
    """Return the runs that a training's settings name, of one data set or several."""
    data, runs = settings.get("data"), settings.get("runs")
    if data is None or runs is None:
        return ()
    if isinstance(data, str):
        data, runs = [data], [runs]
    return tuple(_of_one(*pair) for pair in zip(data, runs, strict=True))


def _of_one(data: str, runs: dict[str, str]) -> TrainedOn:
    dataset = wt.open_dataset(data)
    run = dataset[next(iter(runs))]
    info = run.info
    return TrainedOn(
        data=dataset.info.id,
        version=dataset.info.version,
        runs=tuple(runs),
        environment=info.env.id if info.env else None,
        algorithm=info.algorithm.name if info.algorithm else None,
        every=every_of(run),
        parameters=info.layout.size,
    )


def _json(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    return found
