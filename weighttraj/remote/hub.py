"""What is special about the Hugging Face hub: commits, tokens, where files are."""

from __future__ import annotations

from typing import Any

from weighttraj.errors import RemoteError, missing_extra
from weighttraj.remote.address import RemotePath


def client() -> Any:
    """``huggingface_hub``.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import huggingface_hub
        import huggingface_hub.constants
        import huggingface_hub.errors  # it loads its modules when they are named
    except ModuleNotFoundError as error:
        raise missing_extra("huggingface_hub", "hub") from error
    return huggingface_hub


def pinned(place: RemotePath) -> RemotePath:
    """The same, at the commit that its revision is now: later commits change nothing for a reader.

    Raises:
        RemoteError: there is no such repository or revision, or the hub cannot be reached.
    """
    if place.commit is not None:
        return place
    repo, revision = _parts(place.root)
    hub = client()
    try:
        commit = hub.HfApi().repo_info(repo, revision=revision, repo_type="dataset").sha
    except Exception as error:
        raise hub_error(error, place.root) from error
    return RemotePath(f"hf://{repo}@{commit}", place.part)


def resolve_url(root: str) -> str:
    """Where the files of a repository are, over HTTP."""
    repo, revision = _parts(root)
    return f"{client().constants.ENDPOINT}/datasets/{repo}/resolve/{revision}"


def headers() -> dict[str, str]:
    """Who we are, if we have said so."""
    token = client().get_token()
    return {"authorization": f"Bearer {token}"} if token else {}


def hub_error(error: Exception, where: str) -> RemoteError:
    """An error of the hub's client as ours, with its cause."""
    hub = client()
    do = "see whether the hub can be reached, and try again"
    if isinstance(error, hub.errors.OfflineModeIsEnabled):
        do = "unset HF_HUB_OFFLINE, or name a data set that was downloaded before"
    elif isinstance(error, hub.errors.RepositoryNotFoundError | hub.errors.RevisionNotFoundError):
        do = "correct the name; if it is private: hf auth login, or set HF_TOKEN"
    return RemoteError(
        "the hub does not do what was asked",
        got=f"{type(error).__name__}: {' '.join(str(error).split())[:400]}",
        where=where,
        do=do,
    )


def _parts(root: str) -> tuple[str, str]:
    """Repository and revision of a root."""
    repo, _, revision = root.removeprefix("hf://").partition("@")
    return repo, revision


__all__ = ["client", "headers", "hub_error", "pinned", "resolve_url"]
