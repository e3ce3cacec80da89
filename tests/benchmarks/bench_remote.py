"""What does it cost to read the released data set from somewhere else?

python tests/benchmarks/bench_remote.py [--save]

Servers on loopback: SeaweedFS for whole downloads, ours beside boto3's with as many threads, in
turns; and a web server that counts what opening the data set and reading one window asks for.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import boto3
from results import save

sys.path.insert(0, str(Path(__file__).parents[2]))

import weighttraj as wt
from tests.remote import servers
from weighttraj.remote.wait import AT_ONCE

RELEASED = Path(__file__).parents[2] / "datasets/inverted-pendulum-v4-ppo-v1/data"
KEYS = {"aws_access_key_id": "key", "aws_secret_access_key": "secret"}


def seconds(do: Callable[[], Any]) -> float:
    start = time.perf_counter()
    do()
    return time.perf_counter() - start


def downloads(turns: int, work: Path) -> dict[str, Any]:
    """Whole data sets from S3, each file checked, beside the plain client, which checks none."""
    with servers.seaweedfs(work) as url:
        os.environ.update(
            AWS_ACCESS_KEY_ID="key",
            AWS_SECRET_ACCESS_KEY="secret",  # noqa: S106  of the server
            AWS_REGION="us-east-1",
            AWS_ENDPOINT_URL=url,
        )
        client = boto3.client("s3", endpoint_url=url, region_name="us-east-1", **KEYS)
        client.create_bucket(Bucket="bench")
        upload = seconds(lambda: wt.upload(RELEASED, "s3://bench/data"))
        names = [o["Key"] for o in client.list_objects_v2(Bucket="bench")["Contents"]]

        def plain(folder: Path) -> None:
            for name in names:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
            with ThreadPoolExecutor(AT_ONCE) as pool:
                list(pool.map(lambda n: client.download_file("bench", n, folder / n), names))

        ratios, opened = [], []
        for turn in range(turns):
            ours = seconds(lambda t=turn: wt.download("s3://bench/data", work / f"ours{t}"))
            theirs = seconds(lambda t=turn: plain(work / f"theirs{t}"))
            ratios.append(ours / theirs)
            opened.append(seconds(lambda: wt.open("s3://bench/data").runs[7].weights[100:120]))
    return {
        "download_ratio": statistics.median(ratios),
        "open_and_window_s": statistics.median(opened),
        "upload_s": upload,
        "turns": turns,
    }


def requests() -> dict[str, Any]:
    """What opening the data set and reading one window asks of a server."""
    with servers.FileServer(RELEASED.parent) as server:
        dataset = wt.open(f"{server.url}/data")
        run = dataset.runs[7]
        run.info  # noqa: B018  opens it
        before = sum(request.sent for request in server.log)
        run.weights[100:120]
        sent = sum(request.sent for request in server.log) - before
        members = zipfile.ZipFile(RELEASED / f"runs/{run.id}.zarr.zip").infolist()
        chunks = sum(m.file_size for m in members if m.filename.startswith(("policy/weights/c",)))
        return {
            "runs": len(dataset),
            "requests": len(server.log),
            "bytes_before_the_window": before,
            "bytes_of_the_window": sent,
            "bytes_of_its_chunks": chunks,
        }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--save", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = downloads(args.turns, Path(folder)) | requests()
    print(result)
    if args.save:
        save("remote", result)
