"""What is special about the Hugging Face hub: commits, tokens, where files are."""

from __future__ import annotations

from typing import Any
from urllib.parse import quote

from weighttraj.errors import RemoteError, needs
from weighttraj.remote.address import RemotePath, Root
from weighttraj.remote.wait import within


def client() -> Any:
    """Return the module ``huggingface_hub``.

    Raises:
        MissingExtraError: it is not installed.
    """
    with needs("hub"):
        import huggingface_hub
        import huggingface_hub.constants
        import huggingface_hub.errors  # it loads its modules when they are named
    return huggingface_hub


def pinned(place: RemotePath) -> RemotePath:
    """Return the place at the commit that its revision is now, so that later commits do not matter.

    Raises:
        RemoteError: there is no such repository or revision, or the hub cannot be reached in time.
    """
    if place.commit is not None:
        return place
    hub, root = client(), place.root

    def ask() -> Any:
        return hub.HfApi().repo_info(root.host, revision=root.revision, repo_type="dataset").sha

    try:
        return place.at(within(ask, place))
    except RemoteError:
        raise
    except Exception as error:
        raise hub_error(error, place) from error


def resolve_url(root: Root) -> str:
    """Return the URL below which the files of a repository are."""
    revision = quote(root.revision, safe="")
    return f"{client().constants.ENDPOINT}/datasets/{root.host}/resolve/{revision}"


def headers() -> dict[str, str]:
    """Return the header that holds the user's token, if there is one."""
    token = client().get_token()
    return {"authorization": f"Bearer {token}"} if token else {}


def hub_error(error: Exception, where: object) -> RemoteError:
    """Return an error of the hub's client as one of this package."""
    hub = client()
    status = getattr(getattr(error, "response", None), "status_code", None)
    what, do = "the hub does not do what was asked", "see what it answers, and try again"
    if isinstance(error, hub.errors.OfflineModeIsEnabled):
        do = "unset HF_HUB_OFFLINE, or name a data set that was downloaded before"
    elif isinstance(error, hub.errors.RepositoryNotFoundError | hub.errors.RevisionNotFoundError):
        do = "correct the name; if it is private: hf auth login, or set HF_TOKEN"
    elif status in (401, 403):
        do = "hf auth login, or set HF_TOKEN to a token that may do this; ask for access if the "
        do += "repository is gated"
    elif status is None and not isinstance(error, ValueError):
        what, do = "the hub cannot be reached", "check the network, HF_ENDPOINT and the proxy"
    return RemoteError(
        what,
        got=f"{type(error).__name__}: {' '.join(str(error).split())[:400]}",
        where=where,
        do=do,
    )
