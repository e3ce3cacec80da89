"""One family of errors. Each says what is wrong: expected, got, where, and what to do."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from weighttraj.text import printable, shortened

_LONGEST = 4000
"""Characters of one part of a message: what is quoted may be a stranger's."""


class WeightTrajError(Exception):
    """Base of every error that this package raises on purpose."""

    def __init__(
        self,
        what: str,
        *,
        expected: object = None,
        got: object = None,
        where: object = None,
        do: str | None = None,
    ) -> None:
        lines = [_told(what)]
        for label, value in (
            ("expected", expected),
            ("got", got),
            ("where", where),
            ("what to do", do),
        ):
            if value is not None:
                lines.append(f"  {label}: {_told(value)}")
        self.message = "\n".join(lines)
        super().__init__(self.message)

    def __reduce__(self) -> tuple[object, ...]:
        """Survive the trip from a worker process, where only positional arguments are replayed."""
        return (_rebuild, (type(self), self.message))


def _told(value: object) -> str:
    """Show a part of a message; none of its lines looks like another part."""
    return printable(shortened(str(value), _LONGEST), lines=True).replace("\n", "\n    ")


def _rebuild(kind: type[WeightTrajError], message: str) -> WeightTrajError:
    error = kind("")
    error.message, error.args = message, (message,)
    return error


class FormatError(WeightTrajError, ValueError):
    """What lies on disk, or is about to, does not follow the format."""


class NewerFormatError(FormatError):
    """A store was written by a later version of the format than this reader knows."""


class DamageError(FormatError):
    """Committed data is missing or its checksum is wrong."""


class RowError(WeightTrajError, IndexError):
    """Rows that an array does not have."""


class StoreExistsError(WeightTrajError, FileExistsError):
    """The path to be written exists."""


class StoreLockedError(WeightTrajError, RuntimeError):
    """Another process is writing this run."""


class SnapshotError(WeightTrajError, ValueError):
    """A snapshot that cannot be stored: wrong shape, or values that are not finite."""


class ReplayError(WeightTrajError, RuntimeError):
    """A run that was to be continued did not repeat its committed snapshots."""


class CollectError(WeightTrajError, ValueError):
    """A training set-up that cannot be collected."""


class RecipeError(WeightTrajError, ValueError):
    """A recipe that cannot be followed."""


class PolicyError(WeightTrajError, ValueError):
    """A stored policy that cannot be rebuilt or run."""


class WindowError(WeightTrajError, ValueError):
    """Windows that the stored runs cannot give."""


class CacheError(WeightTrajError, OSError):
    """The cache of decoded weights cannot be used: no space, or no right to write."""


class EngineError(WeightTrajError, RuntimeError):
    """Tasks that could not be done where they were to be done."""


class LoaderError(WeightTrajError, ValueError):
    """A loader's saved state does not fit the loader it is given to."""


class RemoteError(WeightTrajError, OSError):
    """A server cannot be reached, refuses, or answers what it should not."""


class RegistryError(WeightTrajError, ValueError):
    """Data sets that cannot be found, combined, split, searched, published or deleted as asked."""


class MissingExtraError(WeightTrajError, ImportError):
    """An optional dependency is not installed."""


@contextlib.contextmanager
def needs(extra: str) -> Iterator[None]:
    """Import optional dependencies inside; where one is not installed, say what installs it.

    Raises:
        MissingExtraError: a module is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"this part of the package needs {error.name}, which is not installed",
            where=f"optional dependencies [{extra}]",
            do=f"in the clone: pip install -e '.[{extra}]'",
        ) from error
