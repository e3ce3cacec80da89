"""Networks whose forecasts are no copies, as they are drawn and not trained."""

from __future__ import annotations

import torch

from tipl.models.causal import Causal
from tipl.models.causal.forecaster import CausalModelConfig
from tipl.models.causal.network import CausalConfig, CausalGPT
from tipl.models.gate import Gate
from tipl.models.gate.forecaster import GateModelConfig
from tipl.models.gate.network import GateConfig, GateNetwork

HORIZONS = (1, 2, 5)
GATE = GateConfig(horizons=HORIZONS, phases=5, width=16, experts=3)
CAUSAL = CausalConfig(
    horizons=HORIZONS, rank=3, window=30, block_size=6, phases=4, n_layer=1, n_head=2, n_embd=16
)


def lively_gate(every: int = 2, sizes: GateConfig = GATE) -> Gate:
    """All parameters are drawn."""
    torch.manual_seed(0)
    network = GateNetwork(sizes)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return Gate(network, GateModelConfig(network=sizes, every=every))


def lively_causal(every: int = 2) -> Causal:
    """The head is drawn."""
    torch.manual_seed(0)
    network = CausalGPT(CAUSAL)
    torch.nn.init.normal_(network.head.weight, std=0.1)
    return Causal(network, CausalModelConfig(network=CAUSAL, every=every))
