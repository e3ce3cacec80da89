"""One training loop for every network of ours.

``config`` says how a network is trained, ``loop`` trains it, ``checkpoint`` keeps the state from
which a training goes on, ``parallel`` lets several processes share each batch, ``progress`` shows
the bar, and ``starts`` draws the starts that are trained on.
"""

from tipl.training.config import LoopConfig, change
from tipl.training.loop import Examples, Learner, train_network

__all__ = ["Examples", "Learner", "LoopConfig", "change", "train_network"]
