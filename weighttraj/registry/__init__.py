"""Data sets by their ids: which are here, what they hold, and new ones.

``local`` finds and deletes, ``search`` asks all runs of all data sets, ``derive`` makes a data set
of runs, or of others.
"""

from weighttraj.registry.derive import combine, create, split
from weighttraj.registry.local import LocalDataset, delete, local_datasets
from weighttraj.registry.search import search

__all__ = ["LocalDataset", "combine", "create", "delete", "local_datasets", "search", "split"]
