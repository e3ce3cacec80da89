"""What the metadata of runs and data sets say, and which arrays follow from it.

JSON is parsed here, at the border, into frozen dataclasses; everything inside trusts them.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from weighttraj.errors import FormatError, NewerFormatError
from weighttraj.format.exact import decode, encode, encode_exactly
from weighttraj.format.layout import ParamLayout

FORMAT_VERSION = 1
"""Version of the bytes on disk. It moves when they change, not with the package."""

Status = Literal["collecting", "complete", "crashed"]
Profile = Literal["default", "archive"]
Axis = Literal["time", "iteration"]
AXES: tuple[Axis, ...] = ("time", "iteration")

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
_MAX_ROW = 2**31  # elements; beyond it a snapshot is taken for damaged metadata
_MAX_COUNT = 2**48
_MAX_EPISODES = 2**20
_MAX_DEPTH = 64  # of JSON; what walks it may call itself so often


@dataclass(frozen=True, kw_only=True)
class ObsNorm:
    """How raw observations become the network's inputs: ``clip((obs - mean) / sqrt(var + eps))``.

    The statistics move with training and are stored for every snapshot; this holds what is fixed.
    """

    source: str
    """Who normalised: ``gymnasium.NormalizeObservation``, ``stable_baselines3.VecNormalize``."""
    epsilon: float
    """Added to the variance."""
    shape: tuple[int, ...]
    """Shape of one observation."""
    clip_low: float | None = None
    """Lower bound of the normalised observation; None: not clipped."""
    clip_high: float | None = None
    """Upper bound of the normalised observation; None: not clipped."""
    dtype: str = "float64"
    """Type in which the trainer kept the statistics; the store keeps float64, which holds both."""
    cast_before_clip: bool = True
    """Whether values become float32 before (Gymnasium) or after (SB3) they are clipped."""


@dataclass(frozen=True, kw_only=True)
class PolicySpec:
    """What it takes to rebuild the policy's function from its weights."""

    kind: Literal["mlp", "other"]
    """``mlp``: fully connected, rebuilt by ``Run.load_policy``."""
    head: Literal["gaussian", "categorical", "other"] = "other"
    """Distribution over actions; the Gaussian's deviation is the parameter ``log_std``."""
    activation: str = ""
    """Name of the hidden activation: tanh, relu, elu, leaky_relu."""
    layers: tuple[tuple[str, str], ...] = ()
    """(weight, bias) parameter names from the first layer to the action layer."""
    observation_shape: tuple[int, ...] = ()
    """Shape of one observation."""
    action_shape: tuple[int, ...] = ()
    """Shape of one action; empty for discrete actions."""
    action_low: tuple[float, ...] = ()
    """Lower bounds of a continuous action, flattened; actions are clipped to them."""
    action_high: tuple[float, ...] = ()
    """Upper bounds of a continuous action, flattened."""
    acting: Literal["", "squashed_gaussian", "squashed", "greedy"] = ""
    """How a fully connected network of an off-policy algorithm acts; empty: as ``kind`` and
    ``head`` say, which are ``other`` if this is not empty. ``squashed_gaussian`` (SAC): tanh of a
    Gaussian whose deviation is the output of the layer ``log_std``, within exp(-20) and exp(2);
    ``squashed`` (TD3): tanh of the outputs; ``greedy`` (DQN): the largest output. Values from -1
    to 1 are stretched to the bounds of the action."""
    log_std: tuple[str, ...] = ()
    """(weight, bias) of the layer beside the last one that gives the logarithm of the deviation."""
    cannot_rebuild: tuple[str, ...] = ()
    """Reasons why the policy cannot be rebuilt from this description; empty: it can."""

    @property
    def mode(self) -> str:
        """How outputs become actions: ``acting`` or the head; ``other``: it cannot be rebuilt."""
        return self.acting or (self.head if self.kind == "mlp" else "other")

    @property
    def is_continuous(self) -> bool:
        """Whether actions are vectors within bounds; else they are numbers of choices."""
        return self.mode not in ("categorical", "greedy", "other")

    @property
    def is_sampled(self) -> bool:
        """Whether the policy can be sampled; else it acts in one way only."""
        return self.mode in ("gaussian", "categorical", "squashed_gaussian")


@dataclass(frozen=True, kw_only=True)
class EnvInfo:
    """The environment, as Gymnasium's registry knows it."""

    id: str
    """Id for ``gymnasium.make``."""
    kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments for ``gymnasium.make``, with the very values of the training."""
    max_episode_steps: int | None = None
    """Time limit: an episode has at most this many steps. None: the registered limit; -1: none."""
    spec: dict[str, Any] = field(default_factory=dict)
    """What else the registry says of it, for the record; nothing is rebuilt from it."""
    wrappers: tuple[str, ...] = ()
    """Class names of the wrappers, outermost first."""
    cannot_remake: tuple[str, ...] = ()
    """Reasons why ``gymnasium.make`` gives another environment than the training's, such as
    "keyword `reward` (function)"; empty: none is known."""


@dataclass(frozen=True, kw_only=True)
class Cadence:
    """When snapshots are taken."""

    every: int
    """Gradient steps from one snapshot to the next."""
    unit: Literal["gradient_step", "update"] = "gradient_step"
    """What ``index/gradient_step`` counts: steps of the optimizer, or updates of the policy, each
    of which is all that changed its weights between two rollouts."""
    gradient_steps_per_iteration: int | None = None
    """Gradient steps of one iteration (rollout and update); None: it varies."""


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """The training algorithm."""

    name: str
    """Class name: PPO, A2C."""
    library: str = ""
    """Library that trained it."""
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    """Plain values; a schedule is a table of (progress_remaining, value) pairs, never code."""


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a run comes from: what must be equal for it to repeat bit by bit."""

    created: str = ""
    """UTC time, ISO 8601."""
    packages: dict[str, str] = field(default_factory=dict)
    """Versions of python and of each library that moves the numbers."""
    platform: str = ""
    """Operating system and architecture."""
    cpu: str = ""
    """Model of the processor."""
    threads: int | None = None
    """Threads of torch during training; another number gives other bits."""
    command: str = ""
    """Command line."""
    commit: str = ""
    """Version-control commit of the working directory; empty: none."""


@dataclass(frozen=True, kw_only=True)
class Continuation:
    """The training that a run goes on from: its first snapshot is no fresh initialisation."""

    num_timesteps: int
    """Environment steps that the policy had been trained for when the run began, as far as the
    model told: 0 where its counter had been reset."""
    run_id: str = ""
    """Id of the run that it continues; empty: not known. Counters then begin at 0."""
    snapshot: int = -1
    """Which snapshot of that run the first one of this run equals; -1: not known."""
    digest: str = ""
    """SHA-256 (hex) of that snapshot's weights, as its row of ``digest``; empty: not known."""

    def __post_init__(self) -> None:
        if self.run_id:
            check_id(self.run_id, "run id")
        if not (0 <= self.num_timesteps <= _MAX_COUNT and -1 <= self.snapshot <= _MAX_COUNT):
            raise FormatError(
                "a number of a run's origin is out of range",
                expected="num_timesteps 0 to 2**48, snapshot -1 to 2**48",
                got=f"num_timesteps {self.num_timesteps}, snapshot {self.snapshot}",
                do="restore the run's zarr.json from a copy",
            )


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How the episodes were played whose returns stand under ``eval/``: one column an episode."""

    seeds: tuple[int, ...]
    """Seed of each episode's reset."""
    deterministic: tuple[bool, ...]
    """Of each episode: whether actions were the distribution's mode; else they were sampled."""
    every: int = 1
    """Returns were asked for of the snapshots 0, every, 2 * every and so on, and of the last."""
    first: int = 0
    """Returns were also asked for of each of the first N snapshots."""
    learning: int = 0
    """Returns were also asked for of every N-th snapshot of the learning phase; 0: of no more."""
    normalizer: Literal["own", "final"] = "own"
    """Whose statistics normalised observations: the snapshot's own, or those of the last one."""
    simulator: str = ""
    """What simulated: ``mujoco.batch``, ``gymnasium``; empty: not recorded."""
    packages: dict[str, str] = field(default_factory=dict)
    """Versions of each library that moves the numbers."""

    def __post_init__(self) -> None:
        n = len(self.seeds)
        if n != len(self.deterministic) or not 1 <= n <= _MAX_EPISODES:
            raise FormatError(
                "an evaluation does not say of each episode how it was played",
                expected="1 to 2**20 episodes, a seed and a mode for each",
                got=f"{n} seeds, {len(self.deterministic)} modes",
                do="give both, one for each column of the returns",
            )
        counts = (self.every - 1, self.first, self.learning)
        if min(*self.seeds, *counts) < 0 or max(counts) > _MAX_COUNT:
            raise FormatError(
                "a number of an evaluation is out of range",
                expected="seeds at least 0, every 1 to 2**48, first and learning 0 to 2**48",
                got=f"smallest seed {min(self.seeds)}, every {self.every}, first {self.first}, "
                f"learning {self.learning}",
                do="give the numbers that the episodes were played with",
            )


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """Everything about one run that is no array. Lives in the attributes of its Zarr group."""

    run_id: str
    """Unique in its data set; letters, digits, dot, underscore and hyphen."""
    layout: ParamLayout
    """Order of the policy's parameters in ``policy/weights``."""
    policy: PolicySpec = PolicySpec(
        kind="other", cannot_rebuild=("the writer did not describe it",)
    )
    """How the weights act."""
    env: EnvInfo | None = None
    """Environment; None: not recorded."""
    algorithm: Algorithm | None = None
    """Algorithm; None: not recorded."""
    seed: int | None = None
    """Seed of the run."""
    cadence: Cadence | None = None
    """When snapshots were taken; None: not recorded."""
    continues: Continuation | None = None
    """Training that the run goes on from; None: it begins with an untrained policy, or a version
    before this key was written."""
    moved_by: tuple[str, ...] = ()
    """What changed the weights between an update and the next rollout, such as ForecastCallback;
    empty: nothing did, or a version before this key was written."""
    obs_norm: ObsNorm | None = None
    """Observation normaliser; None: the run has none."""
    ret_norm: bool = False
    """Whether statistics of a reward normaliser are stored."""
    diagnostics: tuple[str, ...] = ()
    """Names of the arrays under ``train/``."""
    critic_layout: ParamLayout | None = None
    """Order of parameters in ``critic/weights``; None: not stored."""
    optimizer_moments: bool = False
    """Whether Adam's moments of the policy's parameters are stored."""
    probe_observations: int = 0
    """Network inputs kept an iteration; 0: none."""
    evaluation: Evaluation | None = None
    """How the stored returns were got, after the training; None: no returns are stored."""
    provenance: Provenance = Provenance()
    """Versions and machine."""
    block: int = 64
    """Snapshots in one commit and, while the run is collected, in one chunk."""
    profile: Profile = "default"
    """``default``: core codecs, any Zarr v3 reader; ``archive``: smallest, needs PCodec."""
    status: Status = "collecting"
    """``collecting``: being written, or killed; ``complete``; ``crashed``: ended by an error."""
    n_committed: int = 0
    """Snapshots that readers may see."""
    n_committed_iterations: int = 0
    """Rows of iteration-indexed arrays that readers may see."""
    format_version: int = FORMAT_VERSION
    """Version of the format."""

    def __post_init__(self) -> None:
        check_id(self.run_id, "run id")
        rows = (self.n_committed, self.n_committed_iterations)
        counts = (self.block - 1, *rows, self.probe_observations)
        if min(counts) < 0 or max(counts) > _MAX_COUNT or self.layout.size > _MAX_ROW:
            raise FormatError(
                "a count in the metadata is out of range",
                expected="block at least 1, other counts at least 0, at most 2**48, "
                "at most 2**31 parameters",
                got=f"block {self.block}, n_committed {self.n_committed}, "
                f"n_committed_iterations {self.n_committed_iterations}, "
                f"probe_observations {self.probe_observations}, {self.layout.size} parameters",
                where=f"run {self.run_id!r}",
                do="restore the run's zarr.json from a copy",
            )

    def committed(self, axis: Axis) -> int:
        """Return rows along an axis that readers may see."""
        return self.n_committed if axis == "time" else self.n_committed_iterations


@dataclass(frozen=True, kw_only=True)
class RunEntry:
    """One line of a data set's list of runs."""

    id: str
    """Id of the run."""
    path: str
    """Path from the data set's folder, with forward slashes."""
    seed: int | None = None
    """Seed of the run."""
    split: Literal["train", "validation", "test", ""] = ""
    """Part of the data set it belongs to. Splits are by run, never by time."""

    def __post_init__(self) -> None:
        check_id(self.id, "run id")
        if self.path not in (f"runs/{self.id}.zarr", f"runs/{self.id}.zarr.zip"):
            raise FormatError(
                "a run must lie in its data set, under its own name",
                expected=f"runs/{self.id}.zarr, or .zarr.zip",
                got=self.path,
                where=f"run {self.id!r} in dataset.json",
                do="do not use data from a source that you do not trust",
            )


@dataclass(frozen=True, kw_only=True)
class DatasetInfo:
    """``dataset.json``: the list of runs, so that no reader needs to list folders."""

    id: str
    """Id of the data set, ``<env>-<algorithm>-v<N>``."""
    runs: tuple[RunEntry, ...] = ()
    """Every run that the data set holds or, while collecting, will hold."""
    status: Literal["collecting", "complete"] = "collecting"
    """A complete data set has all its runs."""
    version: str = "1"
    """Version of the data, not of the format."""
    licence: str = "CC-BY-4.0"
    """Licence of the data."""
    recipe: dict[str, Any] = field(default_factory=dict)
    """Recipe that makes it."""
    format_version: int = FORMAT_VERSION
    """Version of the format."""

    def __post_init__(self) -> None:
        check_id(self.id, "data set id")
        ids = [run.id for run in self.runs]
        if len(set(ids)) != len(ids):
            raise FormatError(
                "run ids in a data set must be unique",
                got=ids,
                where=self.id,
                do="give each run an id of its own",
            )

    @property
    def part(self) -> str:
        """How many runs of the whole it holds, such as ``10 of 50``; empty if it is the whole."""
        part = self.recipe.get("part")
        runs = part.get("runs") if isinstance(part, dict) else None
        return runs if isinstance(runs, str) and re.fullmatch(r"\d+ of \d+", runs) else ""


@dataclass(frozen=True, kw_only=True)
class ArraySpec:
    """One array of a run: everything but its length."""

    name: str
    """Path in the run's group."""
    dtype: str
    """Numpy name of the element type."""
    inner: tuple[int, ...]
    """Shape of one row."""
    dims: tuple[str, ...]
    """Names of the dimensions, the row axis first."""

    @property
    def axis(self) -> Axis:
        """What a row stands for: a snapshot (time) or an iteration."""
        return "iteration" if self.dims[0] == "iteration" else "time"

    @property
    def fill(self) -> float | int:
        """Value of a row that was never given: NaN, or -1 for integers."""
        kind = np.dtype(self.dtype).kind
        return float("nan") if kind == "f" else (0 if kind == "u" else -1)


def arrays_of(info: RunInfo) -> dict[str, ArraySpec]:
    """Return the arrays of a run, by name, in the order of ``FORMAT.md``."""
    param = (info.layout.size,)
    specs = [
        _array("policy/weights", "float32", param, "param"),
        _array("digest", "uint8", (32,), "byte"),
        *(_array(f"index/{name}", "int64") for name in INDEX_COUNTERS),
        _array("index/learning_rate", "float64"),
        *(_array(f"train/{name}", "float64") for name in info.diagnostics),
    ]
    if info.obs_norm is not None:
        dims = _observation_dims(info.obs_norm.shape)
        specs += [_array(f"obs_norm/{s}", "float64", info.obs_norm.shape, *dims) for s in MOMENTS]
        specs.append(_array("obs_norm/count", "float64"))
    if info.ret_norm:
        specs += [_array(f"ret_norm/{name}", "float64") for name in (*MOMENTS, "count")]
    if info.critic_layout is not None:
        critic = (info.critic_layout.size,)
        specs.append(_array("critic/weights", "float32", critic, "critic_param"))
    if info.optimizer_moments:
        specs += [_array(f"optimizer/{m}", "float32", param, "param") for m in ADAM_MOMENTS]
    if info.probe_observations:
        shape = info.policy.observation_shape
        inner, dims = (info.probe_observations, *shape), ("probe", *_observation_dims(shape))
        specs.append(_array("probe/observations", "float32", inner, *dims, axis="iteration"))
    if info.evaluation is not None:
        episodes = (len(info.evaluation.seeds),)
        types = zip(RETURNS, ("float64", "int32"), strict=True)
        specs += [_array(name, dtype, episodes, "episode") for name, dtype in types]
    return {spec.name: spec for spec in specs}


INDEX_COUNTERS = ("iteration", "epoch", "gradient_step", "num_timesteps", "phase")
MOMENTS = ("mean", "var")
ADAM_MOMENTS = ("exp_avg", "exp_avg_sq")
RETURNS = ("eval/returns", "eval/lengths")


def _observation_dims(shape: tuple[int, ...]) -> tuple[str, ...]:
    return ("obs",) if len(shape) == 1 else tuple(f"obs_{i}" for i in range(len(shape)))


def _array(
    name: str, dtype: str, inner: tuple[int, ...] = (), *dims: str, axis: Axis = "time"
) -> ArraySpec:
    return ArraySpec(name=name, dtype=dtype, inner=inner, dims=(axis, *dims))


T = TypeVar("T", RunInfo, DatasetInfo)


def parse(document: object, kind: type[T], where: object) -> T:
    """Parse JSON metadata; tagged numbers and tuples (see ``exact``) become what they stand for.

    Raises:
        NewerFormatError: a later version of the format wrote it.
        FormatError: it is no metadata of this kind, or out of range.
    """
    version = document.get("format_version") if isinstance(document, dict) else None
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise NewerFormatError(
            "the data is in a newer format than this version of weighttraj reads",
            expected=f"format_version at most {FORMAT_VERSION}",
            got=version,
            where=where,
            do="pip install --upgrade weighttraj",
        )
    try:
        return msgspec.convert(decode(document), kind)
    except msgspec.ValidationError as error:
        raise FormatError(
            f"the metadata is not a valid {kind.__name__}",
            expected=f"what FORMAT.md says for format_version {FORMAT_VERSION}",
            got=error,
            where=where,
            do="restore the metadata from a copy; the arrays beside it may be whole",
        ) from error


def load_json(text: bytes, where: object) -> Any:
    """Parse JSON text.

    Raises:
        FormatError: the text is no JSON.
    """
    try:
        value = json.loads(text.decode(), object_pairs_hook=_no_key_twice)
        # NaN, infinite numbers and lone surrogates are Python's, not JSON's.
        json.dumps(value, allow_nan=False, ensure_ascii=False).encode()
        if _is_deep([value]):
            raise ValueError(f"more than {_MAX_DEPTH} values in one another")
        return value
    except (ValueError, RecursionError) as error:
        raise FormatError(
            "the metadata is no JSON",
            got=error,
            where=where,
            do="restore the file from a copy; the arrays beside it may be whole",
        ) from error


def _is_deep(value: Any) -> bool:
    level = [value]
    for _ in range(_MAX_DEPTH):
        inner = [v.values() if isinstance(v, dict) else v for v in level]
        level = [v for values in inner for v in values if isinstance(v, dict | list)]
        if not level:
            return False
    return True


def _no_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON; readers do not agree on which of two equal keys counts."""
    if len(dict(pairs)) < len(pairs):
        raise ValueError(f"a key is there twice, among {[key for key, _ in pairs][:20]}")
    return dict(pairs)


def to_json(info: RunInfo | DatasetInfo) -> dict[str, Any]:
    """Return the metadata as plain JSON values.

    Raises:
        FormatError: it holds a value that JSON cannot; the error names the field.
    """
    # Not msgspec: it leaves out fields that it filled with defaults when it parsed.
    document: dict[str, Any] = encode(info)
    if isinstance(info, RunInfo) and info.env is not None:
        document["env"]["kwargs"] = encode_exactly(info.env.kwargs, "env.kwargs")
    return document


def check_id(value: str, what: str) -> str:
    """Return a valid id: it names a file, so it cannot lead out of the folder.

    Raises:
        FormatError: the id is empty, too long or has other characters.
    """
    if _ID.fullmatch(value) is None:
        raise FormatError(
            f"invalid {what}",
            expected="1 to 128 letters, digits, '.', '_' or '-', not starting with '.'",
            got=repr(value),
            do="rename it",
        )
    return value


def with_progress(info: RunInfo, *, status: Status, time: int, iteration: int) -> RunInfo:
    """Return the metadata after a commit."""
    return replace(info, status=status, n_committed=time, n_committed_iterations=iteration)
