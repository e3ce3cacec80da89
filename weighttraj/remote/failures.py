"""What a client of object stores says when something fails, in words that a user would use."""

from __future__ import annotations

import os
import re

from weighttraj.errors import RemoteError
from weighttraj.remote.wait import TIMEOUT

_DUMP = "\n\nDebug source"
_REFUSED = re.compile(r"(?s)status code: (400|416|501)(?!.*RequestTimeout)")
"""Answers that stay the same, however often is asked; S3 also says 400 where it waited too long."""
_CAUSE = re.compile(r'(?:message|error): "([^"]+)"|kind: (\w+),?\s*}')
_XML = re.compile(r"(?s)<\?xml.*?<Code>([^<]*)</Code>\s*<Message>([^<]*)</Message>.*")
_NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound|bucket does not exist", re.IGNORECASE)
_DENIED = re.compile(
    r"status code: (401|403)|AccessDenied|InvalidAccessKeyId|SignatureDoesNotMatch"
)
_CREDENTIALS = {
    "hf": "hf auth login, or set HF_TOKEN; ask for access if the repository is gated",
    "s3": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; for a public bucket "
    "AWS_SKIP_SIGNATURE=true",
    "gs": "set GOOGLE_APPLICATION_CREDENTIALS; for a public bucket GOOGLE_SKIP_SIGNATURE=true",
    "az": "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY; for a public container "
    "AZURE_SKIP_SIGNATURE=true",
}
_REGION = re.compile(
    r"PermanentRedirect|AuthorizationHeaderMalformed|IllegalLocationConstraint|configured region"
)
_NOBODY = re.compile(r"//169\.254\.169\.254/|Account must be specified|credential")
_CONNECTION = (
    (
        r"dns error|lookup address|Name or service not known",
        "the server's name is not known",
        "correct the address, or the endpoint in the environment; check the network",
    ),
    (
        r"(?i)certificate|UnknownIssuer|\btls\b|\bssl\b",
        "there is no secure connection to the server",
        "correct the address; if the server's certificate is your own, let this machine trust it",
    ),
    (
        r"proxy|tunnel",
        "the proxy does not let the request pass",
        "correct HTTPS_PROXY and HTTP_PROXY, or name the server in NO_PROXY",
    ),
)
"""Pattern of what hindered a connection, what is wrong, and what to do."""
_PROXIES = ("HTTPS_PROXY", "https_proxy", "HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy")
_URL = re.compile(r"https?://\S+")


class BrokenOffError(RemoteError):
    """An answer ended in the middle; what came is good."""


class NoPartsError(RemoteError):
    """The server sends whole objects only."""


class RefusedError(RemoteError):
    """The server answers, but not what it was asked."""


def failure(error: Exception, scheme: str, where: str) -> Exception:
    """Return an error of ``obstore`` as one of ours: one line for what it says in thirty.

    Missing objects are ``FileNotFoundError``, existing ones ``FileExistsError``.
    """
    from obstore import exceptions

    text, _, details = str(error).partition(_DUMP)
    got = " ".join(_XML.sub(r"\1: \2", text).split())[:400]
    if isinstance(error, exceptions.AlreadyExistsError | FileExistsError):
        return FileExistsError(where)
    if isinstance(error, FileNotFoundError):
        return no_bucket(where) if _NO_BUCKET.search(text) else FileNotFoundError(where)
    if isinstance(error, exceptions.NotSupportedError):
        dataset = where.rpartition("/runs/")[0] or where
        do = f"weighttraj download '{dataset}', and open what it makes"
        return NoPartsError(
            "the server cannot send parts of an object", got=got, where=where, do=do
        )
    what, do = _explained(error, scheme, text, details)
    if causes := [first or second for first, second in _CAUSE.findall(details)]:
        got += f" ({causes[-1]})"
    kind = RefusedError if _REFUSED.search(text) else RemoteError
    return kind(what, got=got, where=where, do=do)


def unusable(error: Exception, scheme: str, where: object) -> RemoteError:
    """Return the error for an address, or settings, of which no client can be made."""
    text = " ".join(str(error).partition(_DUMP)[0].split())[:400]
    if _NOBODY.search(text):
        what, do = "no credentials for this address were found", _CREDENTIALS[scheme]
    else:
        what = "this address cannot be used"
        do = "correct the address, or the environment variables that say how to reach it"
    return RemoteError(what, got=text, where=where, do=do)


def is_final(error: Exception) -> bool:
    """Return whether asking again would give the same error."""
    return " retries, " in str(error) or _REFUSED.search(str(error)) is not None


def no_bucket(where: str) -> RemoteError:
    """Return the error for something that lies in no bucket, container or folder."""
    return RemoteError(
        "there is no such bucket",
        expected="a bucket that exists: it is not made here",
        where=where,
        do="correct the address or the endpoint, or make the bucket",
    )


def too_large(limit: int, got: int, where: str) -> RemoteError:
    """Return the error for an answer that is not read because it is too large."""
    return RemoteError(
        "the answer of the server is larger than it may be",
        expected=f"at most {limit} bytes",
        got=f"{got} bytes",
        where=where,
        do="do not use data from a source that you do not trust",
    )


def _explained(error: Exception, scheme: str, text: str, details: str) -> tuple[str, str]:
    """Return what is wrong, and what to do."""
    from obstore import exceptions

    credentials = _CREDENTIALS.get(scheme, "give the server your credentials")
    if _NOBODY.search(text):
        return "no credentials for this address were found", credentials
    if _REGION.search(text):
        do = "set AWS_REGION to the region of the bucket, or AWS_ENDPOINT_URL to its server"
        return "the bucket is in another region", do
    hindered = _URL.sub("", details.partition("kind: Connect")[2])
    for pattern, what, do in _CONNECTION:
        if re.search(pattern, hindered):
            return what, do
    denied = exceptions.PermissionDeniedError | exceptions.UnauthenticatedError | PermissionError
    if isinstance(error, denied) or _DENIED.search(text):
        return "access denied", "check its permissions" if scheme == "file" else credentials
    proxy = ", by the proxy that is set" if any(v in os.environ for v in _PROXIES) else ""
    do = f"see whether the server can be reached{proxy}, and try again; {TIMEOUT} says how long"
    return "a remote object cannot be reached", do
