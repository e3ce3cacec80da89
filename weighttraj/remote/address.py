"""Where a data set is that is not a folder here."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NoReturn

from weighttraj.errors import RegistryError

SCHEMES = ("hf", "s3", "gs", "az", "https", "http", "file")
"""What an address can begin with."""

_ADDRESS = re.compile(r"([a-z0-9]+)://(.+)")
_HUB = re.compile(
    r"hf://(?:datasets/)?(?P<repo>[\w.-]+/[\w.-]+)(?:@(?P<revision>[\w.-]+))?(?:/(?P<name>.+))?"
)
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True)
class RemotePath:
    """An object below a remote root, such as ``runs/seed0000.zarr.zip`` of a data set.

    It is no path of this machine: functions that need one get an error that says how to have one.
    """

    root: str
    """Address of the data set; on the hub with its revision: ``hf://org/name@main``."""
    part: str = ""
    """Path below the root; empty: the root itself."""

    @classmethod
    def parse(cls, address: str, revision: str | None = None) -> RemotePath:
        """Understand an address.

        Args:
            address: ``hf://org/name``, ``s3://``, ``gs://`` or ``az://`` and a bucket and prefix,
                ``https://`` and a folder, ``file://`` and a path.
            revision: of a hub repository: a branch, tag or commit.

        Raises:
            RegistryError: it is none of these, or has no revisions.
        """
        match = _ADDRESS.fullmatch(address.rstrip("/"))
        if match is None or match[1] not in SCHEMES:
            raise _unknown(address)
        if match[1] != "hf":
            if revision is not None:
                raise RegistryError(
                    "only the hub keeps revisions",
                    expected="no revision, or an address hf://org/name",
                    got=f"revision {revision!r} of {address}",
                    do="leave the revision out: each version is a data set of its own",
                )
            return cls(address.rstrip("/"))
        hub = _HUB.fullmatch(match[0])
        if hub is None:
            raise _unknown(address)
        if revision is not None and hub["revision"] not in (None, revision):
            raise RegistryError(
                "the address names another revision",
                expected=revision,
                got=hub["revision"],
                where=address,
                do="name it once",
            )
        at = revision or hub["revision"] or "main"
        return cls(f"hf://{hub['repo']}@{at}", hub["name"] or "")

    @property
    def scheme(self) -> str:
        """``s3``, ``hf``, ``https``..."""
        return self.root.partition("://")[0]

    @property
    def name(self) -> str:
        """Last part, as of a path."""
        return PurePosixPath(self.part or self.repository.partition("://")[2]).name

    @property
    def repository(self) -> str:
        """Address without a revision."""
        return self.root.partition("@")[0] if self.scheme == "hf" else self.root

    @property
    def commit(self) -> str | None:
        """Revision on the hub, once it is a commit."""
        revision = self.root.partition("@")[2] if self.scheme == "hf" else ""
        return revision if _COMMIT.fullmatch(revision) else None

    def absolute(self) -> RemotePath:
        """An address is always absolute."""
        return self

    def as_object(self) -> RemotePath:
        """The same, as an object in a folder, where only an address was given."""
        if self.part:
            return self
        root, _, part = self.root.rpartition("/")
        return RemotePath(root, part)

    def __truediv__(self, part: str) -> RemotePath:
        return RemotePath(self.root, f"{self.part}/{part}" if self.part else part)

    def __str__(self) -> str:
        return f"{self.root}/{self.part}" if self.part else self.root

    def __fspath__(self) -> NoReturn:
        raise RegistryError(
            "this needs the files on this machine",
            expected="a path, or the id of a data set that is here",
            got=str(self),
            do=f"weighttraj download {self.root}",
        )


Place = Path | RemotePath
"""Where something lies: here, or somewhere else."""


def is_remote(path: object) -> bool:
    """Whether something is an address rather than a path or an id."""
    return isinstance(path, RemotePath) or "://" in str(path)


def here(path: str | Place) -> Path:
    """A path of this machine.

    Raises:
        RegistryError: it is an address.
    """
    if is_remote(path):
        return Path(path if isinstance(path, RemotePath) else RemotePath.parse(str(path)))
    return Path(path)


def _unknown(address: str) -> RegistryError:
    return RegistryError(
        "this is no address of a data set",
        expected="hf://organisation/name, s3://bucket/prefix, gs://, az://, https://, file://",
        got=address,
        do="correct it",
    )


__all__ = ["SCHEMES", "Place", "RemotePath", "here", "is_remote"]
