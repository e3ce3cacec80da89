"""WNN and NiNo's MLP, re-implemented from their papers.

Neither follows a flip of signs: their units are no odd functions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from torch import nn

from tipl.models.baselines.data import Trajectory
from tipl.models.baselines.network import Perceptron, PerParameter, Streams
from tipl.models.baselines.nowcaster import Nowcaster, NowcasterConfig


@dataclass(frozen=True, eq=False)
class WNN(Nowcaster):
    """Weight nowcaster network.

    After "Learning to Boost Training by Periodic Nowcasting Near Future Weights" (Jang et al.,
    ICML 2023). The paper fixes: the last five values of a parameter and their differences go
    through two streams of fully connected layers, which are joined; values are scaled by their
    range within the window; what comes out is added to the newest value; weights and biases have
    networks of their own. Ours: values are taken relative to the newest one (the range of a
    parameter is 1e-3 of its value here: its value over its range is no input); snapshots in place
    of epochs; layers of 32.

    It sees a step in proportion to the range of its own parameter. So the scale of the steps does
    not matter, and a parameter that rests cannot be forecast.
    """

    name: str = "wnn"
    kind = "wnn"

    @classmethod
    def build(cls, config: NowcasterConfig) -> PerParameter:
        """Return an untrained network."""
        inputs, outputs = 2 * (config.context - 1), len(config.horizons)
        networks: list[nn.Module] = [Streams(inputs, config.width, outputs) for _ in range(2)]
        return PerParameter(networks, inputs, config.horizons)

    @staticmethod
    def inputs(
        window: Float64[np.ndarray, "context param"], trajectory: Trajectory
    ) -> tuple[Float64[np.ndarray, "param input"], Float64[np.ndarray, " param"]]:
        """Return values relative to the newest and differences, over the range of the window."""
        extent = np.ptp(window, axis=0)
        seen = np.concatenate([(window - window[-1])[:-1], np.diff(window, axis=0)])
        return (seen / np.maximum(extent, np.finfo(np.float32).tiny)).T, extent

    @staticmethod
    def groups(trajectory: Trajectory) -> np.ndarray:
        """Return 0 for weights, 1 for biases and deviations."""
        return np.where(trajectory.matrix, 0, 1)


@dataclass(frozen=True, eq=False)
class NinoMLP(Nowcaster):
    """NiNo without its graph: a perceptron for each parameter.

    After "Accelerating Training with Neuron Interaction and Nowcasting Networks" (Knyazev et al.,
    ICLR 2025, arXiv:2409.04434), where it is called WNN+. The paper fixes: the last five states of
    a parameter, scaled by the mean and the deviation of its layer over these states; all horizons
    at once; what comes out, times the deviation, is added to the newest value. Ours: the newest
    state and four differences instead of five states (the same numbers, but a step is 1e-3 of the
    deviation of its layer and would be lost), each standardised over the training runs; layers
    of 32.

    The scale of a layer does not fall with the steps, so the scale of the steps matters, and the
    network has to find out when a run has slowed down.
    """

    name: str = "nino-mlp"
    kind = "nino-mlp"

    @classmethod
    def build(cls, config: NowcasterConfig) -> PerParameter:
        """Return an untrained network."""
        networks: list[nn.Module] = [Perceptron(config.context, config.width, len(config.horizons))]
        return PerParameter(networks, config.context, config.horizons)

    @staticmethod
    def inputs(
        window: Float64[np.ndarray, "context param"], trajectory: Trajectory
    ) -> tuple[Float64[np.ndarray, "param input"], Float64[np.ndarray, " param"]]:
        """Return the newest scaled state and scaled differences."""
        mean, deviation = _layer_scales(window, trajectory)
        newest = (window[-1] - mean) / deviation
        return np.concatenate([newest[None], np.diff(window, axis=0) / deviation]).T, deviation

    @staticmethod
    def groups(trajectory: Trajectory) -> np.ndarray:
        """Return 0 for all."""
        return np.zeros(len(trajectory.tensor), np.int64)


def _layer_scales(
    window: Float64[np.ndarray, "context param"], trajectory: Trajectory
) -> tuple[Float64[np.ndarray, " param"], Float64[np.ndarray, " param"]]:
    """Return mean and deviation of each parameter's tensor over a window."""
    tensor = trajectory.tensor
    counts = np.bincount(tensor)
    mean = (np.bincount(tensor, window.mean(0)) / counts)[tensor]
    squares = np.bincount(tensor, ((window - mean) ** 2).mean(0)) / counts
    return mean, (np.sqrt(squares) + 1e-6)[tensor]
