"""Servers on loopback, started and stopped by the tests: what data sets are read from."""

from __future__ import annotations

import contextlib
import email.utils
import http.server
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LOOPBACK = "127.0.0.1"


@dataclass
class Request:
    """One request that a server answered."""

    method: str
    path: str
    range: str | None
    sent: int


@dataclass(frozen=True)
class Long:
    """A fault: the answer is announced to have so many bytes, and has them."""

    size: int


@dataclass(frozen=True)
class Drip:
    """A fault: the bytes of the answer come a few at a time, with a pause before them."""

    pause: float
    bytes_at_once: int = 1


@dataclass
class FileServer:
    """A folder over HTTP, with ranges; counts what it is asked, and misbehaves as it is told."""

    folder: Path
    suffixes: bool = True
    """Whether it answers requests for the last bytes."""
    log: list[Request] = field(default_factory=list)
    faults: list[tuple[str, Any]] = field(default_factory=list)
    """What to do wrong, once each: a pattern of the path, and a status, ``cut`` or a change."""
    url: str = ""
    needs: str = ""
    """The query without which nothing is found."""

    def fault(
        self, pattern: str, what: int | str | Long | Drip | Callable[[bytes], bytes], times: int = 1
    ) -> None:
        self.faults += [(pattern, what)] * times

    def take(self, path: str) -> Any:
        for index, (pattern, what) in enumerate(self.faults):
            if re.search(pattern, path):
                del self.faults[index]
                return what
        return None

    def __enter__(self) -> FileServer:
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True

            def do_GET(self) -> None:
                answer(self, outer)

            do_HEAD = do_GET  # noqa: N815

            def log_message(self, *args: Any) -> None:
                pass

        self._server = Server((LOOPBACK, 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        self.url = f"http://{LOOPBACK}:{self._server.server_port}"
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        for connection in self._server.connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


class Server(http.server.ThreadingHTTPServer):
    """Knows its connections, which outlive it otherwise."""

    daemon_threads = True
    block_on_close = False
    connections: tuple[socket.socket, ...] = ()

    def get_request(self) -> tuple[socket.socket, Any]:
        connection, address = super().get_request()
        self.connections = (*self.connections, connection)
        return connection, address


def answer(handler: http.server.BaseHTTPRequestHandler, server: FileServer) -> None:
    path, _, query = handler.path.partition("?")
    span, fault = handler.headers.get("Range"), server.take(path)
    file = server.folder / urllib.parse.unquote(path).lstrip("/")
    found = file.is_file() and query == server.needs
    if isinstance(fault, int | Long) or not found:
        server.log.append(Request(handler.command, path, span, 0))
        _something_else(handler, fault)
        return
    content = file.read_bytes()
    size, start, stop, status = len(content), 0, len(content), 200
    match = re.fullmatch(r"bytes=(\d*)-(\d*)", span or "")
    if match is not None:
        if not match[1] and not server.suffixes:
            server.log.append(Request(handler.command, path, span, 0))
            _head(handler, 400, {"Content-Length": "0"})
            return
        start = int(match[1]) if match[1] else max(0, size - int(match[2]))
        stop = min(size, int(match[2]) + 1) if match[1] and match[2] else size
        status = 206
    part = content[start:stop]
    part = fault(part) if callable(fault) else part
    tag = f'"{file.stat().st_mtime_ns}"'
    headers = {"Content-Length": str(len(part)), "ETag": tag, "Accept-Ranges": "bytes"}
    headers["Last-Modified"] = email.utils.formatdate(file.stat().st_mtime, usegmt=True)
    if status == 206:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    _head(handler, status, headers)
    if handler.command == "GET":
        part = part[: len(part) // 2] if fault == "cut" else part
        server.log.append(Request(handler.command, path, span, len(part)))
        with contextlib.suppress(ConnectionError):
            if isinstance(fault, Drip):
                _drip(handler, part, fault)
            else:
                handler.wfile.write(part)
    if fault == "cut":
        handler.close_connection = True


def _something_else(handler: http.server.BaseHTTPRequestHandler, fault: Any) -> None:
    """Answer without looking at the file."""
    if not isinstance(fault, Long):
        _head(handler, fault if isinstance(fault, int) else 404, {"Content-Length": "4"})
        if handler.command == "GET":
            handler.wfile.write(b"none")
        return
    _head(handler, 200, {"Content-Length": str(fault.size)})
    with contextlib.suppress(ConnectionError):
        while handler.command == "GET":
            handler.wfile.write(bytes(1 << 20))


def _drip(handler: http.server.BaseHTTPRequestHandler, content: bytes, how: Drip) -> None:
    for start in range(0, len(content), how.bytes_at_once):
        time.sleep(how.pause)
        handler.wfile.write(content[start : start + how.bytes_at_once])
        handler.wfile.flush()


def _head(
    handler: http.server.BaseHTTPRequestHandler, status: int, headers: dict[str, str]
) -> None:
    handler.send_response(status)
    for name, value in headers.items():
        handler.send_header(name, value)
    handler.end_headers()


def free_port() -> int:
    with socket.socket() as place:
        place.bind((LOOPBACK, 0))
        return int(place.getsockname()[1])


@contextlib.contextmanager
def running(
    command: list[str], url: str, log: Path, **options: Any
) -> Iterator[subprocess.Popen[bytes]]:
    """A server of its own process, from its first answer to the end."""
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, **options)
        try:
            for _ in range(600):
                if process.poll() is not None:
                    raise RuntimeError(f"{command[0]} ended: {log.read_text()[-2000:]}")
                try:
                    urllib.request.urlopen(url, timeout=1)  # noqa: S310
                    break
                except urllib.error.HTTPError:
                    break  # it answers
                except OSError:
                    time.sleep(0.1)
            else:
                raise RuntimeError(f"{command[0]} does not answer: {log.read_text()[-2000:]}")
            yield process
        finally:
            process.kill()
            process.wait()


@contextlib.contextmanager
def nginx(folder: Path, work: Path) -> Iterator[str]:
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None:
        import pytest

        pytest.skip("nginx is not installed")
    port = free_port()
    config = work / "nginx.conf"
    config.write_text(
        f"daemon off; pid {work}/pid; error_log {work}/error.log; worker_processes 1;\n"
        f"user {'root' if os.geteuid() == 0 else os.environ.get('USER', 'nobody')};\n"
        "events {}\n"
        "http { access_log off; "
        + "".join(
            f"{name}_temp_path {work}/{name}; "
            for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        + f"server {{ listen {LOOPBACK}:{port}; root {folder}; }} }}\n"
    )
    url = f"http://{LOOPBACK}:{port}"
    with running([program, "-c", str(config), "-p", str(work)], url, work / "log"):
        yield url


@contextlib.contextmanager
def without_ranges(folder: Path, work: Path) -> Iterator[str]:
    """Python's own server, which sends whole files only."""
    port = free_port()
    command = [sys.executable, "-m", "http.server", str(port), "--bind", LOOPBACK]
    url = f"http://{LOOPBACK}:{port}"
    with running(command, url, work / "log", cwd=folder):
        yield url


@contextlib.contextmanager
def moto(work: Path) -> Iterator[str]:
    port = free_port()
    command = [sys.executable, "-m", "moto.server", "-H", LOOPBACK, "-p", str(port)]
    url = f"http://{LOOPBACK}:{port}"
    with running(command, url, work / "log"):
        yield url


@contextlib.contextmanager
def seaweedfs(work: Path) -> Iterator[str]:
    program = Path(sys.executable).with_name("weed")
    ports = {name: free_port() for name in ("master", "volume", "filer", "s3")}
    keys = {"accessKey": "key", "secretKey": "secret"}
    actions = ["Admin", "Read", "List", "Tagging", "Write"]
    config = work / "s3.json"
    config.write_text(
        json.dumps({"identities": [{"name": "us", "credentials": [keys], "actions": actions}]})
    )
    (work / "data").mkdir()
    command = [
        *(
            str(program),
            "server",
            f"-dir={work / 'data'}",
            f"-ip={LOOPBACK}",
            f"-ip.bind={LOOPBACK}",
        ),
        *(f"-{name}.port={port}" for name, port in ports.items()),
        *(f"-{name}.port.grpc={free_port()}" for name in ports),
        *(
            "-filer",
            "-s3",
            f"-s3.config={config}",
            "-volume.max=500",
            "-master.volumeSizeLimitMB=64",
            "-s3.port.iceberg=0",  # on ports of their own, which another server could have
            "-s3.port.lance=0",
            "-master.telemetry=false",
        ),
    ]
    url = f"http://{LOOPBACK}:{ports['s3']}"
    with running(command, url, work / "log", cwd=work):
        yield url
