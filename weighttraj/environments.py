"""Makes Gymnasium environments: errors that help, and no notes meant for authors of models."""

from __future__ import annotations

import contextlib
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import gymnasium as gym

from weighttraj.errors import CollectError, PolicyError, WeightTrajError
from weighttraj.format import EnvInfo


def remake(info: EnvInfo) -> gym.Env[Any, Any]:
    """Make the environment that metadata describe. They may be a stranger's.

    Raises:
        CollectError: the id is not registered here.
        PolicyError: it cannot be made again, or not with these keywords.
    """
    arguments = {k: v for k, v in info.kwargs.items() if k != "render_mode"}
    if info.cannot_remake:
        raise PolicyError(
            f"this environment cannot be made again: {'; '.join(info.cannot_remake)}",
            expected="an environment that its id and its recorded keywords make",
            got=info.id,
            do=OWN_ENVIRONMENT,
        )
    if wrong := sorted(_RESERVED & arguments.keys()):
        raise PolicyError(
            "the keywords of the environment contradict what is recorded beside them",
            expected=f"other keywords than {', '.join(sorted(_RESERVED))}",
            got=f"{info.id} with {wrong}",
            do="correct env.kwargs of the run's metadata",
        )
    if info.max_episode_steps is not None:
        arguments["max_episode_steps"] = info.max_episode_steps
    _refuse_endless_steps(arguments, info)
    with explained(info):
        env = make(info.id, **arguments)
    try:
        _refuse_endless_steps(vars(env.unwrapped), info)
    except PolicyError:
        env.close()
        raise
    return env


OWN_ENVIRONMENT = "pass a function that makes it: weighttraj.policies.evaluate(policy, my_function)"
"""What to do about an environment that cannot be made again."""
_RESERVED = {"id", "max_episode_steps"}
_FRAMES = ("frame_skip", "frameskip", "_frameskip", "action_repeat")
"""Names that environments have for the number of simulation steps in one of theirs."""
_MOST_FRAMES = 10_000


@contextlib.contextmanager
def explained(info: EnvInfo) -> Iterator[None]:
    """Turn whatever an environment raises into an error that names it and its keywords.

    Raises:
        PolicyError: the environment raised an error.
    """
    try:
        yield
    except WeightTrajError:
        raise
    except Exception as error:  # its code, and its keywords, may be a stranger's
        raise PolicyError(
            "the environment fails",
            expected="an environment that works with its recorded keywords",
            got=f"{type(error).__name__}: {str(error)[:1000]}",
            where=f"{info.id}, keywords {str(info.kwargs)[:1000]}",
            do="install the version of the environment that run.info.provenance names, or "
            + OWN_ENVIRONMENT,
        ) from error


def _refuse_endless_steps(settings: Mapping[str, Any], info: EnvInfo) -> None:
    """Refuse an environment of which a single step takes for ever, and cannot be interrupted."""
    counts = [settings.get(name) for name in _FRAMES]
    found = [n for n in counts if isinstance(n, int | float) and not 1 <= n <= _MOST_FRAMES]
    if found:
        raise PolicyError(
            "the environment simulates too many frames in a step, or none",
            expected=f"a frame skip from 1 to {_MOST_FRAMES:,}",
            got=found[0],
            where=info.id,
            do=OWN_ENVIRONMENT,
        )


def texts_of(value: Any) -> Iterator[str]:
    """Yield every string in a keyword's value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from texts_of(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from texts_of(item)


def stands_for_another(text: str) -> bool:
    """Return whether earlier versions wrote such a text for an infinite number or a function."""
    return text in ("inf", "-inf", "nan") or "<lambda>" in text or "<locals>" in text


def made_by(function: Callable[[], Any]) -> gym.Env[Any, Any]:
    """Make an environment with a user's function.

    Raises:
        PolicyError: the function fails, or returns something else.
    """
    with explained(EnvInfo(id=getattr(function, "__name__", str(function)))):
        env = function()
    if not isinstance(env, gym.Env):
        raise PolicyError(
            "the function makes no Gymnasium environment",
            expected="a gymnasium.Env",
            got=f"a {type(env).__name__}",
            where=function,
            do="return one environment, such as gymnasium.make(...); vectorised ones are not "
            "evaluated here",
        )
    return env


def time_limit(env: gym.Env[Any, Any] | None) -> int | None:
    """Return the smallest time limit among an environment's wrappers; None: there is none."""
    limits: list[int] = []
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    return min(limits, default=None)


def make(env_id: str, /, **kwargs: Any) -> gym.Env[Any, Any]:
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
            do="print the ids with gymnasium.pprint_registry(), or import the module that "
            "registers yours (--import MODULE on the command line); MuJoCo's come with "
            "pip install -e '.[sb3]' in the clone",
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
