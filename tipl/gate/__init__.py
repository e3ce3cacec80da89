"""tipl-gate: a small network, shared by all parameters, that forecasts from their own past steps.

``history`` walks along a run and keeps what is needed of its past; ``adam`` reads the optimizer's
moments, for networks that see them; ``features`` turns both into numbers; ``examples`` draws what
the network is trained on; ``train`` trains it; and ``forecaster`` is the trained network as a
forecaster.
"""

from tipl.gate.forecaster import Gate
from tipl.gate.train import GateTrainConfig, train_gate

__all__ = ["Gate", "GateTrainConfig", "train_gate"]
