"""Runs a study: every arm on every task with every seed, on again where it was stopped."""

from __future__ import annotations

import contextlib
import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from tipl.errors import EvaluateError
from tipl.evaluation.results import write_document
from tipl.live.block import Block, Made, make_block, read_block, wait_for
from tipl.live.path import forecaster_of
from tipl.live.plan import Plan, Stage, Trial, check_task, ppo_of, read_plan, settings_of
from tipl.live.results import Cpu, Figure, LiveResults, Series
from tipl.live.summary import compare, final, mean_log_ratio, thresholds_of
from tipl.saved import fingerprint
from weighttraj.atomic import replace_file
from weighttraj.engine import engine_of
from weighttraj.errors import StoreLockedError, WeightTrajError
from weighttraj.progress import LoggedProgress

RESULTS = "results.json"


@dataclass(frozen=True, kw_only=True)
class LiveConfig:
    """One stage of a study."""

    plan: Path
    """The plan, a TOML file."""
    out: Path
    """Folder of results; each stage has a folder of its own in it."""
    stage: Stage = "test"
    """``tuning``, which runs first: all points of the grids on the tuning seeds.
    ``test``: the best point of each arm on the test seeds."""
    tasks: tuple[str, ...] = ()
    """Tasks to train on; empty: all of the plan."""
    arms: tuple[str, ...] = ()
    """Arms to train; empty: all of the plan. The baseline always runs.
    Results also hold the arms that were trained earlier."""
    workers: int = 1
    """Number of processes; each takes a population of seeds at a time."""
    scheduler: str | None = None
    """Address of a Dask cluster, tcp://host:port, or `local` for --workers processes here."""


def run_live(
    config: LiveConfig, *, command: str = "", console: Console | None = None
) -> LiveResults:
    """Train what is missing, and write ``results.json`` and ``curves.csv``.

    Each population of seeds is a file. Those that are there are left alone, if they have the same
    settings and forecaster. So the same command continues a study that was stopped, and several
    commands can share the work: none trains a population that another one is training. The results
    hold every arm of the plan whose trainings are all there, those of earlier commands too.

    Raises:
        EvaluateError: the plan is invalid, or the stage ``test`` comes before the tuning.
        ForecastError: a forecaster needs the future of the run.
        KeyboardInterrupt: it was stopped; finished populations are kept.
    """
    plan = read_plan(config.plan)
    _check_names(plan, config)
    for task in config.tasks or plan.tasks:
        check_task(plan, task, config.plan.parent)
    marks, tuned = _Marks(), None
    if config.stage == "test":
        whole = replace(config, stage="tuning", tasks=(), arms=())
        tuned = _Ranked.of(plan, _series(plan, whole, marks))
    _make(list(_missing(_blocks(plan, config, tuned), marks)), config, console)
    folder, series = config.out / config.stage, _series(plan, config, marks, tuned)
    while True:
        results = _results(plan, config, series, tuned, command)
        write_document(folder / RESULTS, results)
        replace_file(folder / "curves.csv", _csv(series).encode())
        before, series = series, _series(plan, config, marks, tuned)
        if series == before:  # no other command has finished a training in the meantime
            return results


@dataclass(frozen=True)
class _Ranked:
    """What the trainings of a stage say of the trials."""

    thresholds: dict[str, dict[str, float]]
    """Return of each threshold, by task and share in per cent."""
    best: dict[str, dict[str, str]]
    """Best trial of each arm, by task and arm."""
    scores: dict[str, dict[str, float]]
    """What tuning minimises, by task and trial."""

    @classmethod
    def of(cls, plan: Plan, series: Sequence[Series]) -> _Ranked:
        found = cls({}, {}, {})
        for task in dict.fromkeys(one.task for one in series):
            mine = [one for one in series if one.task == task]
            (baseline,) = (one for one in mine if one.arm == plan.baseline)
            limits = found.thresholds[task] = thresholds_of(plan, baseline)
            score = found.scores[task] = {
                one.trial: math.exp(mean_log_ratio(plan, one, baseline, limits)) for one in mine
            }
            found.best[task] = {
                arm: min((one.trial for one in mine if one.arm == arm), key=score.__getitem__)
                for arm in dict.fromkeys(one.arm for one in mine)
            }
        return found


def _check_names(plan: Plan, config: LiveConfig) -> None:
    for what, given, known in (
        ("task", config.tasks, plan.tasks),
        ("arm", config.arms, plan.arms),
    ):
        for name in given:
            if name not in known:
                raise EvaluateError(
                    f"the plan has no such {what}",
                    expected=", ".join(known),
                    got=name,
                    where=config.plan,
                    do=f"name some of these with --{what}s",
                )


def _blocks(plan: Plan, config: LiveConfig, tuned: _Ranked | None) -> Iterator[Block]:
    """Yield the populations of a stage.

    Args:
        plan: the study.
        config: stage, tasks and arms.
        tuned: what the tuning says; needed for the stage ``test`` only.
    """
    seeds = plan.seeds_of(config.stage)
    groups = [seeds[i : i + plan.population] for i in range(0, len(seeds), plan.population)]
    for task in config.tasks or plan.tasks:
        ppo, every = ppo_of(plan, task, config.plan.parent)
        for trial in _trials(plan, config, task, tuned):
            for group in groups:
                name = f"{group[0]}-{group[-1]}.json"
                yield Block(
                    file=config.out / config.stage / task / trial.folder / name,
                    task=task,
                    trial=trial,
                    config=ppo,
                    every=every,
                    evaluation=plan.evaluation_of(task),
                    seeds=group,
                )


class _Marks:
    """Fingerprints of forecasters, each of which is loaded once."""

    def __init__(self) -> None:
        self._found: dict[str, str] = {"": ""}

    def on(self, block: Block) -> Block:
        """Return a block with the fingerprint of its forecaster.

        Raises:
            Exception: the forecaster cannot be loaded.
        """
        name = block.trial.forecaster
        if name not in self._found:
            try:
                self._found[name] = fingerprint(forecaster_of(name))
            except Exception as error:
                error.add_note(f"arm {block.trial.arm!r}, task {block.task!r}")
                raise
        return msgspec.structs.replace(block, fingerprint=self._found[name])

    def read(self, block: Block) -> Made | None:
        """Return a block's trainings, of any forecaster if its own cannot be loaded here."""
        with contextlib.suppress(WeightTrajError, OSError, ImportError):
            block = self.on(block)
        return read_block(block)


def _missing(blocks: Iterable[Block], marks: _Marks) -> Iterator[Block]:
    """Yield the blocks that are still to be trained."""
    for block in blocks:
        if marks.read(block) is None:
            yield marks.on(block)


def _trials(plan: Plan, config: LiveConfig, task: str, tuned: _Ranked | None) -> Iterator[Trial]:
    """Yield the trials of a stage on a task: all of them, or the best of each arm."""
    for arm, trials in plan.trials(task).items():
        if config.arms and arm not in (*config.arms, plan.baseline):
            continue
        if config.stage == "tuning" or len(trials) == 1:
            yield from trials
        else:
            best = tuned.best.get(task, {}).get(arm) if tuned else None
            if best is None:
                raise EvaluateError(
                    "an arm with a grid was not tuned, or the plan was changed since",
                    expected=f"trainings of all points of its grid, and of {plan.baseline!r}, on "
                    "the tuning seeds",
                    got=f"not all of arm {arm!r} on task {task!r}",
                    where=config.out / "tuning",
                    do=f"run: tipl live {config.plan} --out {config.out} --stage tuning",
                )
            yield next(trial for trial in trials if trial.name == best)


def _make(blocks: Sequence[Block], config: LiveConfig, console: Console | None) -> None:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with (
        engine_of(config.workers, config.scheduler) as engine,
        LoggedProgress(*columns, console=console) as progress,
    ):
        total = sum(block.config.n_iterations for block in blocks)
        bar = progress.add_task(f"{len(blocks)} populations", total=total)
        while blocks:
            elsewhere = []
            for block, outcome in engine.run(
                make_block, blocks, lambda count: progress.advance(bar, count), wait=False
            ):
                if isinstance(outcome, StoreLockedError):
                    elsewhere.append(block)
                elif isinstance(outcome, Exception):
                    outcome.add_note(f"arm {block.trial.name}, task {block.task}")
                    raise outcome
            blocks = elsewhere
            if blocks:
                progress.update(bar, description="waiting for another process")
                wait_for(blocks[0])


def _series(
    plan: Plan, config: LiveConfig, marks: _Marks, tuned: _Ranked | None = None
) -> list[Series]:
    """Return the trainings of each trial on each task, of the arms whose trainings are all there.

    A task is left out where those of the baseline are not.
    """
    series = []
    for task in plan.tasks:
        made: dict[str, list[Series]] = {}
        for arm in plan.arms:
            if found := _finished(plan, replace(config, tasks=(task,), arms=(arm,)), marks, tuned):
                made[arm] = found
        if plan.baseline in made:
            series += [one for found in made.values() for one in found]
    return series


def _finished(plan: Plan, config: LiveConfig, marks: _Marks, tuned: _Ranked | None) -> list[Series]:
    """Return the trainings of each trial of one arm on one task; empty: some are missing."""
    (arm,) = config.arms
    pairs: dict[str, list[tuple[Block, Made]]] = {}
    try:
        blocks = [block for block in _blocks(plan, config, tuned) if block.trial.arm == arm]
    except (WeightTrajError, OSError):  # not tuned, or a recipe of another task cannot be read
        return []
    for block in blocks:
        if (made := marks.read(block)) is None:
            return []
        pairs.setdefault(block.trial.name, []).append((block, made))
    return [_joined(some) for some in pairs.values()]


def _joined(pairs: Sequence[tuple[Block, Made]]) -> Series:
    (block, first), *_ = pairs
    made = [one for _, one in pairs]
    names = ("training", "forecasts", "evaluation")
    return Series(
        task=block.task,
        arm=block.trial.arm,
        trial=block.trial.name,
        settings=settings_of(block.trial),
        num_timesteps=first.num_timesteps,
        curves=[curve for one in made for curve in one.curves],
        cpu=Cpu(**{name: sum(getattr(one.cpu, name) for one in made) for name in names}),
    )


def _results(
    plan: Plan, config: LiveConfig, series: Sequence[Series], tuned: _Ranked | None, command: str
) -> LiveResults:
    finals: dict[str, dict[str, float]] = {}
    ranked = _Ranked.of(plan, series)
    figures: list[Figure] = []
    for task in dict.fromkeys(one.task for one in series):
        mine = [one for one in series if one.task == task]
        finals[task] = {one.trial: final(one, plan.evaluation_of(task)) for one in mine}
        chosen = [one for one in mine if ranked.best[task][one.arm] == one.trial]
        rivals = [one for one in chosen if one.arm in (plan.baseline, plan.rival)]
        for other in rivals:
            for one in chosen:
                if one.arm != other.arm:
                    figures += compare(plan, one, other, ranked.thresholds[task])
    builtins: dict[str, Any] = msgspec.to_builtins(plan)
    return LiveResults(
        study=plan.id,
        stage=config.stage,
        baseline=plan.baseline,
        rival=plan.rival,
        plan=builtins,
        thresholds=ranked.thresholds,
        final=finals,
        best=ranked.best,
        scores=ranked.scores,
        primary=_primary(plan, tuned or ranked, ranked.best),
        series=list(series),
        figures=figures,
        command=command,
    )


def _primary(plan: Plan, tuned: _Ranked, best: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Return by task the arm that forecasts and was best on the tuning seeds, the rival aside.

    Args:
        plan: the study.
        tuned: what the tuning says.
        best: best trials of this stage; their arms are looked at.
    """
    found = {}
    for task, arms in best.items():
        ranked = {
            arm: tuned.scores[task][tuned.best[task][arm]]
            for arm in arms
            if arm in tuned.best.get(task, {}) and plan.arms[arm].forecaster and arm != plan.rival
        }
        if ranked:
            found[task] = min(ranked, key=ranked.__getitem__)
    return found


def _csv(series: Sequence[Series]) -> str:
    """Return one line for each evaluation of each training."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["task", "arm", "trial", "seed", "num_timesteps", "return"])
    for one in series:
        for curve in one.curves:
            for steps, value in zip(one.num_timesteps, curve.returns, strict=True):
                told = "" if value is None else f"{value:.6g}"
                writer.writerow([one.task, one.arm, one.trial, curve.seed, steps, told])
    return text.getvalue()
