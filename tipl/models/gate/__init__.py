"""tipl-gate: a small network, shared by all parameters, that forecasts from their own past steps.

``network`` is the network; ``history`` walks along a run and keeps what is needed of its past;
``adam`` reads the optimizer's moments, for networks that see them; ``features`` turns both into
numbers; ``data`` draws examples, ``train`` trains, and ``forecaster`` forecasts.
"""

from tipl.models.gate.forecaster import Gate
from tipl.models.gate.network import GateConfig
from tipl.models.gate.train import GateTrainConfig, train_gate

__all__ = ["Gate", "GateConfig", "GateTrainConfig", "train_gate"]
