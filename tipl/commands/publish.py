"""``tipl release``, ``tipl card`` and ``tipl push``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from tipl.zoo.card import write_card
from tipl.zoo.metrics import read_metrics
from tipl.zoo.release import release as release_model
from tipl.zoo.remote import push as push_model
from weighttraj.remote.address import here, new_path
from weighttraj.terminal import say


def release(
    folder: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(metavar="FOLDER", help="folder of a trained model"),
    ],
    name: Annotated[str, tyro.conf.arg(help="name of the released model")],
    results: Annotated[
        Path | None, tyro.conf.arg(help="results.json of the evaluation of the released model")
    ] = None,
    checks: Annotated[
        Path | None, tyro.conf.arg(help="file that `tipl check` wrote for it")
    ] = None,
    rows: Annotated[
        tuple[Path, ...], tyro.conf.arg(help="rows.csv of several tasks, for the card")
    ] = (),
    log: Annotated[bool, tyro.conf.arg(help="keep some lines of the log of the training")] = True,
) -> None:
    """Add a model to the released ones: first as a draft, then with its evaluation."""
    out = release_model(here(folder), name, results=results, checks=checks, rows=rows, log=log)
    say(f"model in {out}")
    if read_metrics(out) is None:
        say(f"a draft: evaluate it with `tipl evaluate {name} ...`, then give --results")


def card(
    name: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL", help="a released model")
    ],
    out: Annotated[Path, tyro.conf.arg(help="folder of the cards")] = Path("cards/models"),
) -> None:
    """Write the card of a model; in an existing card, replace only the figures."""
    say(f"card in {write_card(name, new_path(out))}")


def push(
    model: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="MODEL", help="a folder, or a released model"),
    ],
    address: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="ADDRESS", help="hf://organisation/name, or s3://bucket/name"),
    ],
    private: Annotated[
        bool, tyro.conf.arg(help="make a new repository on the hub private")
    ] = False,
    card: Annotated[
        Path | None, tyro.conf.arg(help="file of its card; a released model has one")
    ] = None,
) -> None:
    """Publish a model with its card, on the Hugging Face hub or in an object store."""
    say(f"published: {push_model(model, address, private=private, card=card)}")
