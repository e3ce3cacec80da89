"""Modules that register environments, imported because a user named them."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from weighttraj.errors import CollectError


def import_modules(names: Sequence[str]) -> None:
    """Import modules that register environments, also from the current folder.

    Raises:
        CollectError: there is no such module, it fails, or it registers nothing.
    """
    if names and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # as `python -m` does; the command's own folder is another
    for name in names:
        known, before = name in sys.modules, _registered()
        try:
            importlib.import_module(name)
        except Exception as error:  # the module's own code may raise anything
            raise CollectError(
                f"the module {name!r} cannot be imported",
                expected="a module's name as Python imports it, such as my_envs for my_envs.py",
                got=f"{type(error).__name__}: {error}",
                where=f"--import {name}",
                do="give the command in the module's folder, or install the module",
            ) from error
        if not known and _registered() == before:
            raise CollectError(
                f"the module {name!r} registers no environment",
                expected="a call of gymnasium.register when it is imported",
                where=f"--import {name}",
                do="name the module that calls gymnasium.register",
            )


def _registered() -> dict[str, int]:
    """Return which registration each id has."""
    import gymnasium

    return {name: id(spec) for name, spec in gymnasium.registry.items()}
