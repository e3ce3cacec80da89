"""Data sets by their ids: which are here, what they hold, and new ones made of old ones.

``local`` finds and deletes, ``search`` asks all runs of all data sets, ``derive`` combines data
sets and splits one anew.
"""

from weighttraj.registry.derive import combine, split
from weighttraj.registry.local import LocalDataset, delete, local_datasets
from weighttraj.registry.search import search

__all__ = ["LocalDataset", "combine", "delete", "local_datasets", "search", "split"]
