"""Released models: they come with the package, or from the hub, and are loaded by name."""

from tipl.zoo.lookup import load, names
from tipl.zoo.metrics import Metrics
from tipl.zoo.remote import push

__all__ = ["Metrics", "load", "names", "push"]
