"""Makes Gymnasium environments: errors that help, and no notes meant for authors of models."""

from __future__ import annotations

import contextlib
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym

from weighttraj.errors import CollectError


def make(env_id: str, **kwargs: Any) -> gym.Env[Any, Any]:
    """``gymnasium.make`` for registered ids only.

    Gymnasium takes ``module:Name`` for an order to import that module. Ids come from data, and
    data must not run code, so such ids are refused.

    Raises:
        CollectError: the id is not registered, or a package that it needs is missing.
    """
    try:
        if ":" in env_id:
            raise gym.error.NameNotFound("ids with a module are refused")
        with _quiet():
            return gym.make(env_id, **kwargs)
    except (gym.error.Error, ImportError) as error:
        raise CollectError(
            "the environment cannot be made",
            expected="an id in gymnasium's registry, such as InvertedPendulum-v4",
            got=f"{env_id!r}: {error}",
            do="print the ids with gymnasium.pprint_registry(), or import the package that "
            "registers yours; MuJoCo's come with pip install 'weighttraj[sb3]'",
        ) from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence deprecations that only the environments' authors can act on."""
    with quiet_mujoco(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*is out of date.*", DeprecationWarning)
        yield


@contextlib.contextmanager
def quiet_mujoco() -> Iterator[None]:
    """Without MuJoCo's own messages, which it also writes to MUJOCO_LOG.TXT in the current folder.

    They tell of deprecated models, and of unstable simulations. Threads may enter it side by side.
    """
    global _quiet_depth
    try:
        import mujoco
    except ModuleNotFoundError:
        yield
        return
    with _quiet_lock:
        _quiet_depth += 1
        mujoco.set_mju_user_warning(_ignore)
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_depth -= 1
            if not _quiet_depth:
                mujoco.set_mju_user_warning(None)


_quiet_depth = 0
_quiet_lock = threading.Lock()


def _ignore(message: str) -> None:
    pass
