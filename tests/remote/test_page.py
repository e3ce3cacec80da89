"""The page about publishing, against a stand-in for the hub and a real S3 server."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import tipl
import weighttraj as wt
from tests.pages import ROOT, run_page
from tests.remote import hub as stand_in
from tests.remote.conftest import make_bucket
from weighttraj.registry import create, write_card


def test_publish_and_load(
    reader: Path,
    few_released: Path,
    hub: stand_in.Hub,
    moto_url: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    make_bucket(moto_url, "bucket", monkeypatch)
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", f"{reader}/store:{few_released.parent}")
    runs = [str(run.path) for run in wt.open(few_released)]
    for name, address in (
        ("my-data-v1", ""),
        ("name", "hf://organisation/"),
        ("name", "s3://bucket/"),
    ):
        path = reader / "store" / name
        create(runs, path, splits={"seed0040": "test"})
        write_card(path)
        if address:
            wt.upload(path, address + name)
            shutil.rmtree(path)
    names = run_page(ROOT / "docs/publish.md")
    assert names["window"].shape == (20, 122)
    assert len(names["copy"]) == 5
    assert [len(run) for run in names["part"]] == [241, 241]
    assert wt.verify("data/demo/published/inverted-pendulum-v4-ppo-v1") == []
    assert len(wt.open("hf://organisation/my-data-v1")) == 5
    assert tipl.load("hf://organisation/gate").causal
