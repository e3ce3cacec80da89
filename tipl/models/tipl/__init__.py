"""TIPL, the paper's model: a causal Transformer that writes the next coefficients of a policy.

Read it in this order: ``network`` is the Transformer, ``data`` makes windows of coefficients,
``train`` trains, and ``forecaster`` forecasts with what was trained.
"""

from tipl.models.tipl.forecaster import TIPL, TIPLConfig
from tipl.models.tipl.network import GPT, GPTConfig
from tipl.models.tipl.train import TrainConfig, train

__all__ = ["GPT", "TIPL", "GPTConfig", "TIPLConfig", "TrainConfig", "train"]
