"""tipl-causal: the Transformer of TIPL on the path up to now, in directions of that path."""

from tipl.models.causal.forecaster import Causal
from tipl.models.causal.network import CausalConfig
from tipl.models.causal.train import CausalTrainConfig, train_causal

__all__ = ["Causal", "CausalConfig", "CausalTrainConfig", "train_causal"]
