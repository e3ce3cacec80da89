"""A stand-in for the hub: as much of its HTTP API as its own client and ours ask for.

Repositories of data sets and models are kept in memory, as commits of whole trees. Large files go
through Git LFS, and are read from another path, as from the hub's network of copies.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import http.server
import json
import re
import threading
import time
import urllib.parse
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.remote.servers import LOOPBACK, Server

TOKEN = "hf_ours"  # noqa: S105  of the stand-in
LARGE = (".zip", ".parquet", ".safetensors")


@dataclass
class Repository:
    """One repository: its commits, from the first to the last, and names of some."""

    private: bool = False
    trees: dict[str, dict[str, bytes]] = field(default_factory=dict)
    refs: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, tree: dict[str, bytes], branch: str = "main") -> str:
        content = "".join(f"{p} {hashlib.sha256(c).hexdigest()}\n" for p, c in sorted(tree.items()))
        sha = hashlib.sha1(f"{len(self.trees)}\n{content}".encode()).hexdigest()  # noqa: S324
        self.trees[sha] = tree
        self.refs[branch] = sha
        return sha

    def resolve(self, revision: str) -> str | None:
        if revision in self.trees:
            return revision
        return self.refs.get(revision) or self.tags.get(revision)


@dataclass
class Hub:
    """The stand-in."""

    url: str = ""
    repositories: dict[str, Repository] = field(default_factory=dict)
    large: dict[str, bytes] = field(default_factory=dict)
    log: list[tuple[str, str]] = field(default_factory=list)
    faults: list[tuple[str, int]] = field(default_factory=list)
    slow: float = 0
    """Seconds before each answer."""

    def files(self, repository: str, revision: str = "main") -> dict[str, bytes]:
        found = self.repositories[repository]
        return found.trees[found.resolve(revision) or ""]


@contextlib.contextmanager
def running() -> Iterator[Hub]:
    hub = Hub()

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def do_GET(self) -> None:
            Answer(hub, self).go()

        do_HEAD = do_POST = do_PUT = do_DELETE = do_GET  # noqa: N815

        def log_message(self, *args: Any) -> None:
            pass

    server = Server((LOOPBACK, 0), Handler)
    hub.url = f"http://{LOOPBACK}:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class Answer:
    """The answer to one request."""

    def __init__(self, hub: Hub, handler: http.server.BaseHTTPRequestHandler) -> None:
        self.hub, self.handler = hub, handler
        self.quoted = urllib.parse.urlsplit(handler.path).path
        self.path = urllib.parse.unquote(self.quoted)
        self.body = handler.rfile.read(int(handler.headers.get("Content-Length") or 0))
        if handler.headers.get("Transfer-Encoding") == "chunked":
            self.body = b"".join(_chunks(handler.rfile))
        self.known = handler.headers.get("Authorization") == f"Bearer {TOKEN}"

    def go(self) -> None:
        method = self.handler.command
        time.sleep(self.hub.slow)
        self.hub.log.append((method, self.path))
        for index, (pattern, status) in enumerate(self.hub.faults):
            if re.search(pattern, self.path):
                del self.hub.faults[index]
                return self.json({"error": "told to fail"}, status)
        for pattern, methods, do in ROUTES:
            match = re.fullmatch(pattern, self.quoted)  # a quoted slash is part of a revision
            if match is not None and method in methods:
                found = match.groupdict().items()
                return do(self, **{k: v and urllib.parse.unquote(v) for k, v in found})
        return self.json({"error": f"no such route: {method} {self.path}"}, 404)

    # Answers

    def json(self, content: Any, status: int = 200, **headers: str) -> None:
        self.send(
            json.dumps(content).encode(), status, {"Content-Type": "application/json"} | headers
        )

    def send(
        self, content: bytes, status: int = 200, headers: dict[str, str] | None = None
    ) -> None:
        self.handler.send_response(status)
        for name, value in ({"Content-Length": str(len(content))} | (headers or {})).items():
            self.handler.send_header(name, value)
        self.handler.end_headers()
        if self.handler.command != "HEAD":
            self.handler.wfile.write(content)

    def ranged(self, content: bytes, headers: dict[str, str]) -> None:
        match = re.fullmatch(r"bytes=(\d*)-(\d*)", self.handler.headers.get("Range") or "")
        if match is None:
            return self.send(content, headers=headers)
        size = len(content)
        start = int(match[1]) if match[1] else max(0, size - int(match[2]))
        stop = min(size, int(match[2]) + 1) if match[1] and match[2] else size
        span = {"Content-Range": f"bytes {start}-{stop - 1}/{size}"}
        return self.send(content[start:stop], 206, headers | span)

    def missing(self, what: str) -> None:
        self.json({"error": f"{what} not found"}, 404, **{"X-Error-Code": what})

    def repository(self, kind: str | None, repo: str) -> Repository | None:
        found = self.hub.repositories.get(f"{kind or 'models'}/{repo}")
        return None if found is None or (found.private and not self.known) else found

    # Requests

    def create(self) -> None:
        asked = json.loads(self.body)
        if not self.known:
            return self.json({"error": "who are you?"}, 401)
        kind = f"{asked.get('type') or 'model'}s"
        key = f"{kind}/{asked['organization']}/{asked['name']}"
        url = f"{self.hub.url}/{key.removeprefix('models/')}"
        if key in self.hub.repositories:
            return self.json({"error": "you already created it", "url": url}, 409)
        private = bool(asked.get("private")) or asked.get("visibility") == "private"
        self.hub.repositories[key] = Repository(private=private)
        self.hub.repositories[key].commit({".gitattributes": b""})
        return self.json({"url": url})

    def info(self, kind: str, repo: str, revision: str | None = None) -> None:
        found = self.repository(kind, repo)
        if found is None:
            return self.missing("RepoNotFound")
        sha = found.resolve(revision or "main")
        if sha is None:
            return self.missing("RevisionNotFound")
        names = [{"rfilename": name} for name in found.trees[sha]]
        return self.json(
            {"_id": sha[:24], "id": repo, "sha": sha, "private": found.private, "tags": []}
            | {"siblings": names, "disabled": False, "downloads": 0, "likes": 0}
        )

    def refs(self, kind: str, repo: str) -> None:
        found = self.repository(kind, repo)
        if found is None:
            return self.missing("RepoNotFound")

        def listed(names: dict[str, str], where: str) -> list[dict[str, str]]:
            return [
                {"name": n, "ref": f"refs/{where}/{n}", "targetCommit": c} for n, c in names.items()
            ]

        branches, tags = listed(found.refs, "heads"), listed(found.tags, "tags")
        return self.json({"branches": branches, "tags": tags, "converts": []})

    def tag(self, kind: str, repo: str, revision: str) -> None:
        found, name = self.repository(kind, repo), json.loads(self.body)["tag"]
        if found is None:
            return self.missing("RepoNotFound")
        if name in found.tags:
            return self.json({"error": "the tag exists"}, 409)
        found.tags[name] = found.resolve(revision) or ""
        return self.json({})

    def tree(self, kind: str, repo: str, revision: str) -> None:
        found = self.repository(kind, repo)
        sha = found.resolve(revision) if found is not None else None
        if found is None or sha is None:
            return self.missing("RevisionNotFound")
        entries = []
        for path, content in found.trees[sha].items():
            oid = hashlib.sha1(content).hexdigest()  # noqa: S324
            entry: dict[str, Any] = {"type": "file", "path": path, "size": len(content), "oid": oid}
            if path.endswith(LARGE):
                digest = hashlib.sha256(content).hexdigest()
                entry["lfs"] = {"oid": digest, "size": len(content), "pointerSize": 130}
            entries.append(entry)
        return self.json(entries)

    def preupload(self, kind: str, repo: str, revision: str) -> None:
        files = [
            {"path": f["path"], "uploadMode": "lfs" if f["path"].endswith(LARGE) else "regular"}
            | {"shouldIgnore": False}
            for f in json.loads(self.body)["files"]
        ]
        return self.json({"files": files})

    def batch(self, kind: str | None, repo: str) -> None:
        objects = []
        for item in json.loads(self.body)["objects"]:
            entry = {"oid": item["oid"], "size": item["size"], "authenticated": True}
            if item["oid"] not in self.hub.large:
                href = f"{self.hub.url}/large/{item['oid']}"
                entry["actions"] = {"upload": {"href": href, "header": {}}}
            objects.append(entry)
        return self.json({"transfer": "basic", "objects": objects, "hash_algo": "sha256"})

    def put_large(self, oid: str) -> None:
        if hashlib.sha256(self.body).hexdigest() != oid:
            return self.json({"error": "other bytes"}, 400)
        self.hub.large[oid] = self.body
        return self.send(b"")

    def get_large(self, oid: str) -> None:
        return self.ranged(self.hub.large[oid], {"ETag": f'"{oid}"'})

    def commit(self, kind: str, repo: str, revision: str) -> None:
        found = self.repository(kind, repo)
        if found is None or not self.known:
            return self.json({"error": "who are you?"}, 401)
        lines = [json.loads(line) for line in self.body.splitlines() if line]
        header = lines[0]["value"]
        parent = found.refs[revision]
        if header.get("parentCommit") not in (None, parent):
            return self.json({"error": "the branch has moved on"}, 412)
        tree = dict(found.trees[parent])
        for line in lines[1:]:
            key, value = line["key"], line["value"]
            if key == "file":
                tree[value["path"]] = base64.b64decode(value["content"])
            elif key == "lfsFile":
                tree[value["path"]] = self.hub.large[value["oid"]]
            elif key == "deletedFile":
                del tree[value["path"]]
            else:
                return self.json({"error": f"no such operation: {key}"}, 400)
        sha = found.commit(tree, revision)
        url = f"{self.hub.url}/{kind}/{repo}/commit/{sha}"
        return self.json({"success": True, "commitOid": sha, "commitUrl": url})

    def resolve(self, repo: str, revision: str, name: str, kind: str | None = None) -> None:
        found = self.repository(kind, repo)
        if found is None:
            return self.missing("RepoNotFound")
        sha = found.resolve(revision)
        if sha is None:
            return self.missing("RevisionNotFound")
        if name not in found.trees[sha]:
            return self.json({"error": "no"}, 404, **{"X-Error-Code": "EntryNotFound"})
        content = found.trees[sha][name]
        headers = {"X-Repo-Commit": sha, "Accept-Ranges": "bytes"}
        if not name.endswith(LARGE):
            digest = hashlib.sha1(content).hexdigest()  # noqa: S324
            return self.ranged(content, headers | {"ETag": f'"{digest}"'})
        digest = hashlib.sha256(content).hexdigest()
        self.hub.large[digest] = content
        linked = {"X-Linked-Etag": f'"{digest}"', "X-Linked-Size": str(len(content))}
        return self.send(b"", 302, headers | linked | {"Location": self.elsewhere(digest)})

    def elsewhere(self, digest: str) -> str:
        """Another host, as the hub's network of copies is."""
        return f"{self.hub.url.replace(LOOPBACK, 'localhost')}/large/{digest}"

    def fine(self) -> None:
        return self.json({"errors": [], "warnings": [], "name": "us", "type": "user"})


KIND, REPO, REVISION = (
    r"(?P<kind>models|datasets)",
    r"(?P<repo>[^/]+/[^/]+)",
    r"(?P<revision>[^/]+)",
)
ROUTES: list[tuple[str, tuple[str, ...], Any]] = [
    ("/api/repos/create", ("POST",), Answer.create),
    (r"/api/(validate-yaml|whoami-v2)", ("GET", "POST"), Answer.fine),
    (f"/api/{KIND}/{REPO}", ("GET",), Answer.info),
    (f"/api/{KIND}/{REPO}/revision/{REVISION}", ("GET",), Answer.info),
    (f"/api/{KIND}/{REPO}/refs", ("GET",), Answer.refs),
    (f"/api/{KIND}/{REPO}/tag/{REVISION}", ("POST",), Answer.tag),
    (f"/api/{KIND}/{REPO}/tree/{REVISION}", ("GET",), Answer.tree),
    (f"/api/{KIND}/{REPO}/preupload/{REVISION}", ("POST",), Answer.preupload),
    (f"/api/{KIND}/{REPO}/commit/{REVISION}", ("POST",), Answer.commit),
    (r"/large/(?P<oid>[0-9a-f]{64})", ("PUT",), Answer.put_large),
    (r"/large/(?P<oid>[0-9a-f]{64})", ("GET", "HEAD"), Answer.get_large),
    (rf"(/(?P<kind>datasets))?/{REPO}\.git/info/lfs/objects/batch", ("POST",), Answer.batch),
    (
        rf"(/(?P<kind>datasets))?/{REPO}/resolve/{REVISION}/(?P<name>.+)",
        ("GET", "HEAD"),
        Answer.resolve,
    ),
]


def _chunks(file: Any) -> Iterator[bytes]:
    """The pieces of a body whose length was not said."""
    while size := int(file.readline().split(b";")[0], 16):
        yield file.read(size)
        file.readline()
    file.readline()
