"""Published, deleted here, loaded by name in another process, trained on and judged."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import tipl
import weighttraj as wt
from tests.remote.conftest import CREDENTIALS, make_bucket
from tests.remote.scenario import MODEL
from weighttraj.registry import write_card

ROOT = Path(__file__).parents[2]


@pytest.fixture(params=["hub", "s3"])
def addresses(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> tuple[str, str]:
    """Where the data set and the model go."""
    if request.param == "hub":
        hub = request.getfixturevalue("hub")
        # The other process reads these when it imports the client.
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        monkeypatch.setenv("HF_HUB_DISABLE_XET", "1")  # the stand-in has Git LFS only
        monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
        return "hf://us/inverted-pendulum-v4-ppo-v1", "hf://us/gate"
    url = request.getfixturevalue("seaweedfs_url")
    bucket = make_bucket(url, "everywhere", monkeypatch)
    assert os.environ["AWS_ACCESS_KEY_ID"] == CREDENTIALS["aws_access_key_id"]
    return f"{bucket.address}/inverted-pendulum-v4-ppo-v1", f"{bucket.address}/gate"


def scenario(*arguments: object, **environment: str) -> str:
    command = [sys.executable, "-m", "tests.remote.scenario", *map(str, arguments)]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_everywhere(addresses: tuple[str, str], few_released: Path, tmp_path: Path) -> None:
    here = tmp_path / "released" / few_released.name
    shutil.copytree(few_released, here)
    write_card(here)
    wt.upload(here, addresses[0])
    tipl.push(MODEL, addresses[1])
    shutil.rmtree(here)
    models = {"WEIGHTTRAJ_MODELS_PATH": str(tmp_path / "models")}
    told = json.loads(scenario(*addresses, tmp_path / "out", **models).splitlines()[-1])
    assert told["runs"] == 5
    name = addresses[1].rpartition("/")[2]
    assert {"persistence", name, "tipl"} <= set(told["judged"])
    assert (tmp_path / "store").is_dir()
    assert MODEL not in told["judged"]
