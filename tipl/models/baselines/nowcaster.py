"""A small network that sees the past of one parameter at a time, and how it is fitted.

Loss, sizes and training are our choices, the same for all: two layers; squared errors of
displacements over the RMS of the last 20 steps and the root of the horizon, so that early and late
starts count alike; all horizons at once; the head begins at 0, which is persistence. Training takes
half a minute on one core; the state that is best on validation runs is kept.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int

from tipl.forecaster import check_request
from tipl.horizons import HORIZONS, fitted, rows_of, too_short
from tipl.models.baselines.data import Trajectory, samples
from tipl.models.baselines.network import ParameterRows, PerParameter, loss_of, standardise
from tipl.saved import SavedNetwork
from tipl.threads import threads
from tipl.training import Learner, LoopConfig, train_network
from tipl.training.starts import draw_starts
from weighttraj import Run

SCALE_STEPS = 20
"""Number of steps whose RMS is the local scale of the loss."""
ROWS_OF_A_RUN = 40_000
"""Number of examples that are drawn from one run."""
STARTS_OF_A_RUN = 300
"""Number of starts among them."""


N = TypeVar("N", bound="Nowcaster")


@dataclass(frozen=True, kw_only=True)
class NowcasterConfig:
    """Sizes of a small network."""

    horizons: tuple[int, ...] = HORIZONS
    """Horizons that it forecasts, rising."""
    context: int = 5
    """Number of snapshots that it sees, as in both papers."""
    width: int = 32
    """Number of units of a layer."""


LOOP = LoopConfig(
    n_batches=2_000, batch_size=4_096, learning_rate=3e-3, warmup=0, weight_decay=0, save_every=200
)
"""Half a minute on one core."""


@dataclass(frozen=True, eq=False)
class Nowcaster(SavedNetwork[PerParameter, NowcasterConfig]):
    """Base of both networks."""

    config_type = NowcasterConfig

    @classmethod
    @abstractmethod
    def build(cls, config: NowcasterConfig) -> PerParameter:
        """Return an untrained network."""

    @staticmethod
    @abstractmethod
    def inputs(
        window: Float64[np.ndarray, "context param"], trajectory: Trajectory
    ) -> tuple[Float64[np.ndarray, "param input"], Float64[np.ndarray, " param"]]:
        """Return what the network sees of a window, and the factor of its outputs."""

    @staticmethod
    @abstractmethod
    def groups(trajectory: Trajectory) -> np.ndarray:
        """Return the number of the network that takes each parameter."""

    @classmethod
    def fit(
        cls: type[N],
        runs: Sequence[Run],
        validation_runs: Sequence[Run] | None = None,
        *,
        horizons: Sequence[int] = HORIZONS,
        seed: int = 0,
        training: LoopConfig | None = None,
    ) -> N:
        """Train on a sample of parameters and starts of each run.

        Args:
            runs: training runs.
            validation_runs: other runs; the network that does best on them is kept.
            horizons: numbers of snapshots ahead.
            seed: seed of the sample, the first weights and the batches.
            training: settings of the loop; None: ``LOOP``.

        Raises:
            TrainError: the runs are too short.
        """
        config = NowcasterConfig(horizons=fitted(horizons))
        fitting = NowcasterFit(cls, config, seed=seed, training=training)
        for _, trajectory in samples(runs, seed):
            fitting.add(trajectory)
        for _, trajectory in samples(validation_runs or [], seed + 1):
            fitting.add(trajectory, validation=True)
        return fitting.finish()

    @torch.no_grad()
    def forecast(
        self, run: Run, starts: Sequence[int], horizons: Sequence[int]
    ) -> Float32[np.ndarray, "start horizon param"]:
        """Return phi_t and what the network adds to it."""
        check_request(run, starts, horizons)
        rows = rows_of(self.config.horizons, horizons, self.name)
        trajectory = Trajectory.of(run)
        groups = torch.from_numpy(self.groups(trajectory))
        out = np.empty((len(starts), len(horizons), run.layout.size), np.float32)
        self.network.eval()
        with threads():
            for place, window in trajectory.windows(starts, self.config.context - 1):
                x, scale = self.inputs(_filled(window, self.config.context), trajectory)
                moved = self.network(_tensor(x), _tensor(scale), groups).numpy()
                out[place] = window[-1] + moved.T[rows]
        return out


class NowcasterFit(Learner[ParameterRows], Generic[N]):
    """A fit that takes one run after the other and keeps some rows of each.

    The seed is that of the sample, the first weights and the batches; without ``training`` the loop
    runs with ``LOOP``.
    """

    def __init__(
        self,
        kind: type[N],
        config: NowcasterConfig,
        *,
        seed: int = 0,
        training: LoopConfig | None = None,
    ) -> None:
        self._kind, self._config = kind, config
        self._training = replace(training or LOOP, seed=seed)
        self._rng = np.random.default_rng(seed)
        self._rows: dict[bool, list[dict[str, np.ndarray]]] = {False: [], True: []}

    def add(self, trajectory: Trajectory, *, validation: bool = False) -> None:
        """Keep rows of one run."""
        trajectory = trajectory.sample(512, self._rng)
        count = min(STARTS_OF_A_RUN, 1 + ROWS_OF_A_RUN // len(trajectory.tensor))
        starts = draw_starts(len(trajectory) + 1 - self._config.horizons[0], count, self._rng)
        groups = self._kind.groups(trajectory)
        for place, window in trajectory.windows(starts, SCALE_STEPS):
            row = self._example(trajectory, starts[place], window, groups)
            self._rows[validation].append(row)

    def _example(
        self,
        trajectory: Trajectory,
        t: int,
        window: Float64[np.ndarray, "row param"],
        groups: np.ndarray,
    ) -> dict[str, np.ndarray]:
        importance = trajectory.importance / trajectory.importance.mean()
        rms = np.sqrt((np.diff(window, axis=0) ** 2 * importance).mean()) + 1e-30
        x, scale = self._kind.inputs(_filled(window, self._config.context), trajectory)
        target = np.full((len(groups), len(self._config.horizons)), np.nan)
        later = t + np.array([h for h in self._config.horizons if t + h < len(trajectory)])
        target[:, : len(later)] = ((trajectory.weights[later] - window[-1]) / rms).T
        return {
            "x": x,
            "scale": scale / rms,
            "group": groups,
            "target": target,
            "weight": importance,
        }

    def finish(self) -> N:
        """Train the network.

        Raises:
            TrainError: no run was long enough.
        """
        examples, self._held_out = (_examples(self._rows[part]) for part in (False, True))
        if examples is None or not examples.target.isfinite().any(0).all():
            raise too_short(self._config.horizons)
        self._examples = examples
        with TemporaryDirectory() as out:
            train_network(self._started, self._training, Path(out))
            return replace(self._kind.load(out), name=self._kind.name)

    def _started(self, _: object) -> NowcasterFit[N]:
        """Draw the first weights; the loop has set the seed."""
        self.network: PerParameter = self._kind.build(self._config)
        standardise(self.network, self._examples)
        self._roots = torch.tensor(self._config.horizons).float().sqrt()
        return self

    def batch(self, n: int) -> ParameterRows:
        """Return random rows, with replacement."""
        rng = np.random.default_rng([self._training.seed, n])
        rows = rng.integers(len(self._examples), size=self._training.batch_size)
        return self._examples[torch.from_numpy(rows)]

    def loss(
        self, network: Callable[..., torch.Tensor], batch: ParameterRows
    ) -> tuple[Float[torch.Tensor, ""], Int[torch.Tensor, ""]]:
        """Return the summed error and the number of known targets."""
        return loss_of(network, batch, self._roots)

    def validation(self) -> Sequence[ParameterRows]:
        """Return the rows of validation runs."""
        return () if self._held_out is None else (self._held_out,)

    def save(self, out: Path) -> None:
        """Write the model."""
        self._kind(self.network, self._config).save(out)


def _examples(rows: list[dict[str, np.ndarray]]) -> ParameterRows | None:
    """Return the rows of all starts together; None: there are none."""
    if not rows:
        return None
    joined = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    group = torch.from_numpy(joined.pop("group"))
    return ParameterRows(group=group, **{name: _tensor(value) for name, value in joined.items()})


def _filled(
    window: Float64[np.ndarray, "row param"], context: int
) -> Float64[np.ndarray, "context param"]:
    """Return the last snapshots; those before the run repeat the oldest one."""
    missing = max(0, context - len(window))
    return np.concatenate([np.repeat(window[:1], missing, axis=0), window[-context:]])


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
