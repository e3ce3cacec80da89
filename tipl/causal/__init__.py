"""tipl-causal: the Transformer of TIPL on the path up to now, in directions of that path."""

from tipl.causal.forecaster import Causal
from tipl.causal.train import CausalTrainConfig, train_causal

__all__ = ["Causal", "CausalTrainConfig", "train_causal"]
