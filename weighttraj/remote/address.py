"""Addresses: where a data set is that is not named by a path of this machine.

An address is read once, here, into its decoded parts; every store and URL is made from these. What
a ``%`` means depends on the scheme:

- ``file://`` is a URL: ``%20`` is a space. ``Path.as_uri()`` writes such an address.
- ``https://`` is a URL: it is sent as it is written, with its query.
- ``s3://``, ``gs://``, ``az://``: what follows the bucket is a key, character by character.
- ``hf://org/name@revision/path``: a revision ends at the first slash, where it is not
  ``refs/pr/N`` or ``refs/convert/NAME``; a slash in any other revision is written ``%2F``.

A path without a scheme is a path, and is never decoded.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn
from urllib.parse import quote, quote_from_bytes, unquote, unquote_to_bytes

from weighttraj.errors import RegistryError

BUCKETS = ("s3", "gs", "az")
WEB = ("https", "http")
SCHEMES = ("hf", *BUCKETS, *WEB, "file")
"""What an address can begin with."""

_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)
_COLLAPSED = re.compile(rf"({'|'.join((*BUCKETS, *WEB, 'hf', 'file'))}):/(?!/)(.*)", re.DOTALL)
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
_NO_TEXT = re.compile(r"[\ud800-\udfff]")
_ESCAPE = re.compile(r"%(?![0-9A-Fa-f]{2})")
_KIND = re.compile(r"(datasets|models|spaces|kernels|buckets)/(?=[^/@]+/)")
_REPOSITORY = re.compile(r"[A-Za-z0-9_][\w.-]*/[A-Za-z0-9_][\w.-]*", re.ASCII)
_SPECIAL = re.compile(r"refs/(?:convert/[\w.-]+|pr/\d+)(?=/|$)", re.ASCII)
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True, kw_only=True)
class Root:
    """The decoded parts of an address, without what lies below it. Its text is the address."""

    scheme: str
    host: str = ""
    """Bucket, ``host:port`` or ``organisation/name``; of files none."""
    path: str = ""
    """Path below the host without a slash at its end, decoded; of ``https`` as it is sent."""
    revision: str = ""
    """Branch, tag or commit, decoded; only of the hub."""
    query: str = ""
    """What every request is sent with, such as a signature; only of ``https``."""

    def __str__(self) -> str:
        return self.text()

    def text(self, part: str = "") -> str:
        """Return the address of an object below the root; it is read as the same one again."""
        if self.scheme == "file":
            path = os.fsencode(f"{self.path}/{part}" if part else self.path)
            return f"file://{quote_from_bytes(path) or '/'}"
        if self.scheme == "hf":
            base = f"hf://{self.host}@{_quoted_revision(self.revision)}"
            return f"{base}/{part}" if part else base
        name = quote(part) if self.scheme in WEB else part
        whole = "/".join(filter(None, (self.host, self.path, name)))
        return f"{self.scheme}://{whole}{f'?{self.query}' if self.query else ''}"


@dataclass(frozen=True)
class RemotePath:
    """An object below a remote root, such as ``runs/seed0000.zarr.zip`` of a data set.

    It is no path of this machine: functions that need one get an error that says how to have one.
    """

    root: Root
    """Where the data set, or the repository that holds it, is."""
    part: str = ""
    """Decoded path below the root; empty: the root itself."""

    @classmethod
    def parse(
        cls, address: str, revision: str | None = None, *, kind: str = "datasets"
    ) -> RemotePath:
        """Read an address.

        Args:
            address: ``hf://org/name``, ``s3://``, ``gs://`` or ``az://`` and a bucket and prefix,
                ``https://`` and a folder, ``file://`` and a path.
            revision: branch, tag or commit of a hub repository, not quoted.
            kind: what a repository on the hub must be: ``datasets`` or ``models``.

        Raises:
            RegistryError: it is none of these, or has no revisions.
        """
        match = _ADDRESS.fullmatch(address) or _file_without_host(address)
        scheme = match[1].lower() if match is not None else ""
        if match is None or scheme not in SCHEMES:
            raise _wrong(address, "it begins with no scheme that is known", "correct it")
        if _CONTROL.search(address) or (scheme != "file" and _NO_TEXT.search(address)):
            raise _wrong(address, "a character that no address can have", "remove it")
        if scheme == "hf":
            return _of_hub(address, match[2], revision, kind)
        if revision is not None:
            raise RegistryError(
                "only the hub keeps revisions",
                expected="no revision, or an address hf://org/name",
                got=f"revision {revision!r} of {address}",
                do="leave the revision out: each version is a data set of its own",
            )
        if scheme == "file":
            return cls(_of_file(address, match[2]))
        return cls((_of_web if scheme in WEB else _of_bucket)(address, scheme, match[2]))

    @property
    def scheme(self) -> str:
        """``s3``, ``hf``, ``https``..."""
        return self.root.scheme

    @property
    def name(self) -> str:
        """Last part, decoded, as of a path."""
        whole = "/".join(filter(None, (self.root.host, self.root.path, self.part)))
        last = whole.rstrip("/").rpartition("/")[2]
        return unquote(last) if self.scheme in WEB and not self.part else last

    @property
    def repository(self) -> str:
        """Address without revision, password and signature: what is published at it stays."""
        root = replace(self.root, query="", host=self.root.host.rpartition("@")[2])
        if self.scheme == "hf":
            return f"hf://{root.host}{f'/{self.part}' if self.part else ''}"
        return root.text(self.part)

    @property
    def commit(self) -> str | None:
        """Revision on the hub, once it is a commit."""
        return self.root.revision if _COMMIT.fullmatch(self.root.revision) else None

    def at(self, revision: str) -> RemotePath:
        """Return the same place at another revision."""
        return RemotePath(replace(self.root, revision=revision), self.part)

    def absolute(self) -> RemotePath:
        """Return the address itself: it is always absolute."""
        return self

    def as_object(self) -> RemotePath:
        """Return the same place as an object in a folder, where only an address was given."""
        if self.part:
            return self
        folder, _, part = self.root.path.rpartition("/")
        if self.scheme in WEB:
            part = unquote(part)
        if not part or "/" in part:
            raise _wrong(str(self), "it names no object", "give the address of a run")
        return RemotePath(replace(self.root, path=folder), part)

    def __truediv__(self, part: str) -> RemotePath:
        return RemotePath(self.root, f"{self.part}/{part}" if self.part else part)

    def __str__(self) -> str:
        return self.root.text(self.part)

    def __fspath__(self) -> NoReturn:
        raise RegistryError(
            "this needs the files on this machine",
            expected="a path, or the id of a data set that is here",
            got=str(self),
            do=f"weighttraj download '{self}', then name the folder that it makes",
        )


Place = Path | RemotePath
"""Where something lies: here, or somewhere else."""


def is_remote(path: object) -> bool:
    """Return whether something is an address rather than a path or an id.

    Raises:
        RegistryError: it is an address that ``pathlib.Path`` has shortened.
    """
    text = str(path)
    if isinstance(path, RemotePath) or _ADDRESS.fullmatch(text):
        return True
    shortened = _COLLAPSED.fullmatch(text)
    if shortened is None:
        return False
    if shortened[1] != "file":
        raise RegistryError(
            "an address is not a path: a path has lost one of the slashes",
            expected="the address as text",
            got=text,
            do=f"give it as text: '{shortened[1]}://{shortened[2]}'",
        )
    return True  # file:/folder is file:///folder, RFC 8089


def here(path: str | Place) -> Path:
    """Return a path of this machine.

    Raises:
        RegistryError: it is an address.
    """
    if is_remote(path):
        return Path(path if isinstance(path, RemotePath) else RemotePath.parse(str(path)))
    return Path(path)


def new_path(path: str | Path) -> Path:
    """Return the path of something that is to be written here.

    Raises:
        RegistryError: it is an address.
    """
    if _ADDRESS.fullmatch(str(path)) or _COLLAPSED.fullmatch(str(path)):
        raise RegistryError(
            "results are written on this machine, not to an address",
            expected="a path",
            got=str(path),
            do="name a folder here; a data set is published by `weighttraj upload`, a model by "
            "`tipl push`",
        )
    return Path(path)


def below(base: str, name: str) -> str:
    """Return the address of a data set whose id is looked for below another address."""
    scheme = base.partition("://")[0].lower()
    folder, mark, query = base.partition("?") if scheme in WEB else (base, "", "")
    name = quote(name) if scheme in (*WEB, "file") else name
    return f"{folder.rstrip('/')}/{name}{mark}{query}"


def _file_without_host(address: str) -> re.Match[str] | None:
    """Return the parts of ``file:/folder``, which RFC 8089 has beside ``file:///folder``."""
    match = re.fullmatch(r"(file):(/.*)", address, re.DOTALL | re.IGNORECASE)
    return match if match is not None and not match[2].startswith("//") else None


def _of_file(address: str, rest: str) -> Root:
    host, slash, path = rest.partition("/")
    if (host and host.lower() != "localhost") or not slash:
        raise _wrong(address, f"a host, {host!r}", "file:// and an absolute path: file:///folder")
    _refuse_marks(address, path, "#?")
    if _ESCAPE.search(path):
        raise _wrong(address, "a % before no two hexadecimal digits", "write a % as %25")
    decoded = os.fsdecode(unquote_to_bytes(os.fsencode("/" + path)))
    if "\0" in decoded or re.search("%2f", path, re.IGNORECASE):
        raise _wrong(address, "a name that no file can have", "correct it")
    return Root(scheme="file", path=decoded.rstrip("/"))


def _of_web(address: str, scheme: str, rest: str) -> Root:
    _refuse_marks(address, rest, "#")
    head, _, query = rest.partition("?")
    host, _, path = head.partition("/")
    path = path.removesuffix("/")
    _refuse_dots(address, unquote(path))
    if not host.rpartition("@")[2] or "\\" in head:
        raise _wrong(address, "no host", "correct it")
    return Root(scheme=scheme, host=host, path=path, query=query)


def _of_bucket(address: str, scheme: str, rest: str) -> Root:
    bucket, _, key = rest.partition("/")
    key = key.removesuffix("/")
    if re.fullmatch(r"[A-Za-z0-9$][\w.$-]*", bucket, re.ASCII) is None:
        raise _wrong(address, f"{bucket!r} for a bucket", f"{scheme}://BUCKET/PREFIX")
    if key and "" in key.split("/"):
        raise _wrong(address, "an empty name between two slashes", "leave one of the slashes out")
    _refuse_dots(address, key)
    return Root(scheme=scheme, host=bucket, path=key)


def _of_hub(address: str, rest: str, revision: str | None, kind: str) -> RemotePath:
    prefix = _KIND.match(rest)
    if prefix is not None and prefix[1] != kind:
        raise _wrong(address, f"one of the hub's {prefix[1]}", f"name one of its {kind}")
    rest = (rest[prefix.end() :] if prefix else rest).removesuffix("/")
    repository, mark, after = rest.partition("@")
    if mark and repository.count("/") == 1:
        special = _SPECIAL.match(after)
        named = special[0] if special else after.partition("/")[0]
        part, named = after[len(named) + 1 :], unquote(named)
    else:  # an @ further on is part of a name
        mark, named = "", ""
        organisation, _, name = rest.partition("/")
        name, _, part = name.partition("/")
        repository = f"{organisation}/{name}"
    if _REPOSITORY.fullmatch(repository) is None or ".." in repository:
        raise _wrong(address, f"{repository!r} for a repository", "hf://ORGANISATION/NAME")
    if part and "" in part.split("/"):
        raise _wrong(address, "an empty name between two slashes", "leave one of the slashes out")
    _refuse_dots(address, part)
    if revision is not None and mark and named != revision:
        raise RegistryError(
            "the address names another revision",
            expected=revision,
            got=named,
            where=address,
            do="name it once",
        )
    wanted = named if mark else (revision if revision is not None else "main")
    if re.fullmatch(r"[^\s~^:?*\[\\@]+", wanted) is None or ".." in wanted or wanted[0] == "/":
        raise _wrong(address, f"{wanted!r} for a revision", "name a branch, tag or commit")
    return RemotePath(Root(scheme="hf", host=repository, revision=wanted), part)


def _quoted_revision(revision: str) -> str:
    """Return a revision as the hub's own client writes it in an address."""
    return revision if _SPECIAL.fullmatch(revision) else quote(revision, safe="")


def _refuse_marks(address: str, text: str, marks: str) -> None:
    for mark in marks:
        if mark in text:
            raise _wrong(
                address, f"a {mark}, which ends the path of a URL", f"write it as {quote(mark)}"
            )


def _refuse_dots(address: str, path: str) -> None:
    """No name is ``.`` or ``..``: servers and clients do not agree on what these lead to."""
    if {".", ".."} & set(path.split("/")):
        raise _wrong(address, "a name that is . or ..", "write the address without it")


def _wrong(address: str, got: str, do: str) -> RegistryError:
    return RegistryError(
        "this is no address of a data set",
        expected="hf://organisation/name, s3://bucket/prefix, gs://, az://, https://, file://",
        got=f"{address!r}: {got}",
        do=do,
    )
