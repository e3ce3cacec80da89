"""Published, deleted here, loaded by name in another process, trained on and judged."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.remote import hub as stand_in
from tests.remote.conftest import CREDENTIALS, make_bucket
from tests.remote.scenario import MODEL

ROOT = Path(__file__).parents[2]
RELEASED = ROOT / "datasets/inverted-pendulum-v4-ppo-v1"


@pytest.fixture(params=["hub", "s3"])
def addresses(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[tuple[str, str]]:
    """Where the data set and the model go."""
    if request.param == "hub":
        with stand_in.running() as hub:
            monkeypatch.setenv("HF_ENDPOINT", hub.url)
            monkeypatch.setenv("HF_TOKEN", stand_in.TOKEN)
            monkeypatch.setenv("HF_HUB_DISABLE_XET", "1")  # the stand-in has Git LFS only
            monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
            yield "hf://us/inverted-pendulum-v4-ppo-v1", "hf://us/gate"
        return
    url = request.getfixturevalue("seaweedfs_url")
    bucket = make_bucket(url, "everywhere", monkeypatch)
    assert os.environ["AWS_ACCESS_KEY_ID"] == CREDENTIALS["aws_access_key_id"]
    yield f"{bucket.address}/inverted-pendulum-v4-ppo-v1", f"{bucket.address}/gate"


def scenario(*arguments: object, **environment: str) -> str:
    command = [sys.executable, "-m", "tests.remote.scenario", *map(str, arguments)]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_everywhere(addresses: tuple[str, str], tmp_path: Path) -> None:
    here = tmp_path / "released"
    shutil.copytree(RELEASED / "data", here)
    scenario("publish", *addresses, here)
    shutil.rmtree(here)
    models = {"WEIGHTTRAJ_MODELS_PATH": str(tmp_path / "models")}
    told = json.loads(scenario("use", *addresses, tmp_path / "out", **models).splitlines()[-1])
    assert told["runs"] == 50
    name = addresses[1].rpartition("/")[2]
    assert {"persistence", name, "tipl"} <= set(told["judged"])
    assert (tmp_path / "store").is_dir()
    assert MODEL not in told["judged"]
