"""Released models: they come with the package and are loaded by name."""

from tipl.zoo.lookup import load, names
from tipl.zoo.metrics import Metrics

__all__ = ["Metrics", "load", "names"]
