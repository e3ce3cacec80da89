"""A small network that sees the past of one parameter at a time, and how it is fitted.

Loss, sizes and training are ours, the same for all: two layers; squared errors of displacements
over the RMS of the last 20 steps and the root of the horizon, so that early and late starts count
alike; all horizons at once; the head begins at 0, which is persistence. Starts are drawn half
evenly, half on a logarithmic scale. Half a minute of training on one core.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float32, Float64
from safetensors.torch import save_file

from tipl.baselines.files import ARRAYS, load_network, read_config, write
from tipl.baselines.horizons import HORIZONS, fitted, rows_of
from tipl.baselines.networks import (
    Examples,
    PerParameter,
    TrainingConfig,
    standardise,
    train,
)
from tipl.baselines.trajectory import Trajectory, samples
from tipl.errors import TrainError
from tipl.forecast import check_request
from tipl.threads import threads
from weighttraj import Run

SCALE_STEPS = 20
"""Steps whose RMS is the local scale of the loss."""
ROWS_OF_A_RUN = 40_000
"""Examples that are drawn from one run."""
STARTS_OF_A_RUN = 300
"""Starts among them."""


N = TypeVar("N", bound="Nowcaster")


@dataclass(frozen=True, kw_only=True)
class NowcasterConfig:
    """Sizes of a small network."""

    horizons: tuple[int, ...] = HORIZONS
    """Horizons that it forecasts, rising."""
    context: int = 5
    """Snapshots that it sees, as in both papers."""
    width: int = 32
    """Units of a layer."""


@dataclass(frozen=True, eq=False)
class Nowcaster(ABC):
    """What both networks have in common."""

    network: PerParameter
    """The network and its scales."""
    config: NowcasterConfig
    """Its sizes."""
    kind: ClassVar[str]
    name: ClassVar[str]
    causal = True

    @staticmethod
    @abstractmethod
    def build(config: NowcasterConfig) -> PerParameter:
        """An untrained network."""

    @staticmethod
    @abstractmethod
    def inputs(
        window: Float64[np.ndarray, "context param"], trajectory: Trajectory
    ) -> tuple[Float64[np.ndarray, "param input"], Float64[np.ndarray, " param"]]:
        """What the network sees of a window, and what its outputs are multiplied by."""

    @staticmethod
    @abstractmethod
    def groups(trajectory: Trajectory) -> np.ndarray:
        """Which network takes each parameter."""

    @classmethod
    def fit(
        cls: type[N],
        runs: Sequence[Run],
        validation_runs: Sequence[Run] | None = None,
        *,
        horizons: Sequence[int] = HORIZONS,
        seed: int = 0,
        training: TrainingConfig | None = None,
    ) -> N:
        """Train on a sample of parameters and starts of each run.

        Args:
            runs: training runs.
            validation_runs: other runs; the network that does best on them is kept.
            horizons: how far to look.
            seed: of the sample, the first weights and the batches.
            training: how; None: as it is by default.

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
        """phi_t and what the network adds to it.

        Raises:
            ForecastError: it was not trained for such a horizon.
        """
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

    def save(self, path: str | Path) -> None:
        """Write config.json and model.safetensors."""
        write(path, {"kind": self.kind, **asdict(self.config)})
        save_file(self.network.state_dict(), Path(path) / ARRAYS)

    @classmethod
    def load(cls: type[N], path: str | Path) -> N:
        """Read a saved one; every parameter must be there.

        Raises:
            FileNotFoundError: there is no forecaster in the folder.
            ModelError: the files are another's, or damaged.
        """
        config = read_config(path, cls.kind, NowcasterConfig)
        return cls(load_network(cls.build(config), path), config)


class NowcasterFit(Generic[N]):
    """A fit that takes one run after the other and keeps some rows of each.

    Args:
        kind: which network.
        config: its sizes.
        seed: of the sample, the first weights and the batches.
        training: how it is trained; None: as it is by default.
    """

    def __init__(
        self,
        kind: type[N],
        config: NowcasterConfig,
        *,
        seed: int = 0,
        training: TrainingConfig | None = None,
    ) -> None:
        self._kind, self._config, self._seed = kind, config, seed
        self._training = training or TrainingConfig()
        self._rng = np.random.default_rng(seed)
        self._rows: dict[bool, list[dict[str, np.ndarray]]] = {False: [], True: []}

    @property
    def name(self) -> str:
        """Of what comes out."""
        return self._kind.name

    def add(self, trajectory: Trajectory, *, validation: bool = False) -> None:
        """Look at one run."""
        trajectory = trajectory.sample(512, self._rng)
        count = min(STARTS_OF_A_RUN, 1 + ROWS_OF_A_RUN // len(trajectory.tensor))
        last = len(trajectory) - 1 - self._config.horizons[0]
        if last < 1:
            return
        u = self._rng.uniform(size=count)
        even, early = 1 + u * last, np.exp(u * np.log(last + 1))  # the learning phase is short
        starts = np.unique(np.where(np.arange(count) % 2, even, early).astype(int))
        groups = self._kind.groups(trajectory)
        for place, window in trajectory.windows(starts.tolist(), SCALE_STEPS):
            row = self._example(trajectory, int(starts[place]), window, groups)
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
        """Train.

        Raises:
            TrainError: no run was long enough.
        """
        examples, validation = (_examples(self._rows[part]) for part in (False, True))
        if examples is None or not examples.target.isfinite().any(0).all():
            raise TrainError(
                "the runs are too short to train for each horizon",
                expected=f"runs of more than {max(self._config.horizons) + 2} snapshots",
                do="train for fewer horizons, or collect longer runs",
            )
        with torch.random.fork_rng(devices=[]), threads():
            torch.manual_seed(self._seed)
            network = self._kind.build(self._config)
            standardise(network, examples)
            train(
                network,
                examples,
                validation,
                self._config.horizons,
                self._training,
                self._seed,
            )
        return self._kind(network, self._config)


def _examples(rows: list[dict[str, np.ndarray]]) -> Examples | None:
    """Rows of all starts in one; None: there are none."""
    if not rows:
        return None
    joined = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
    group = torch.from_numpy(joined.pop("group"))
    return Examples(group=group, **{name: _tensor(value) for name, value in joined.items()})


def _filled(
    window: Float64[np.ndarray, "row param"], context: int
) -> Float64[np.ndarray, "context param"]:
    """The last snapshots; the oldest one again and again before the beginning of the run."""
    missing = max(0, context - len(window))
    return np.concatenate([np.repeat(window[:1], missing, axis=0), window[-context:]])


def _tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


__all__ = ["Nowcaster", "NowcasterConfig", "NowcasterFit"]
