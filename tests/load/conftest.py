"""An empty cache for each test, and a run of several pieces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def wide_run(tmp_path_factory: pytest.TempPathFactory) -> wt.Run:
    """300 snapshots of 20,000 parameters: 24 MB, a moment's work to decode. Not to be changed."""
    path = tmp_path_factory.mktemp("wide") / "wide.zarr"
    layout = wt.ParamLayout.of({"w": ((20_000,), "other", ("fixed",))})
    info = wt.RunInfo(run_id="wide", layout=layout, block=8)
    rows = np.random.default_rng(0).normal(size=(300, 20_000)).astype(np.float32)
    with wt.RunWriter(path, info) as writer:
        for t, row in enumerate(rows):
            writer.append(row, num_timesteps=t)
    return wt.open_run(path)
