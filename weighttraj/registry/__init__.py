"""Data sets by their ids: which are here, what they hold, new ones, and those elsewhere.

``local`` finds and deletes, ``search`` asks all runs of all data sets, ``derive`` makes a data set
of runs, or of others; ``card`` says what one is, ``upload`` publishes it, ``download`` brings one
here, and ``load`` opens it by its name, wherever it is.
"""

from weighttraj.registry.card import write_card
from weighttraj.registry.derive import combine, create, select, split
from weighttraj.registry.download import download
from weighttraj.registry.load import load_dataset
from weighttraj.registry.local import LocalDataset, delete, find, local_datasets
from weighttraj.registry.search import search
from weighttraj.registry.upload import upload

__all__ = [
    "LocalDataset",
    "combine",
    "create",
    "delete",
    "download",
    "find",
    "load_dataset",
    "local_datasets",
    "search",
    "select",
    "split",
    "upload",
    "write_card",
]
