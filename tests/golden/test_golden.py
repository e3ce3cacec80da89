"""Files of every format version stay readable. They are never written again."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from tests.golden.make import INFO, ROWS, probes, snapshot

V1 = Path(__file__).parent / "v1"


@pytest.mark.parametrize("path", [V1 / "dataset", V1 / "dataset.h5"], ids=["zarr", "hdf5"])
def test_version_1_reads_as_it_was_written(path: Path) -> None:
    dataset = wt.open(path)
    assert [(run.id, run.split) for run in dataset] == [
        ("default", "train"),
        ("archive", "validation"),
        ("folder", "test"),
    ]
    for run in dataset:
        assert len(run) == ROWS
        for t in range(ROWS):
            values = snapshot(t, run.info)
            assert np.array_equal(run.weights[t], values["weights"])
            for name in ("num_timesteps", "iteration", "epoch", "gradient_step", "phase"):
                assert run[f"index/{name}"][t] == values[name], name
            assert np.array_equal(run.learning_rate[t], values["learning_rate"], equal_nan=True)


@pytest.mark.parametrize("run_id", ["default", "archive"])
@pytest.mark.parametrize("path", [V1 / "dataset", V1 / "dataset.h5"], ids=["zarr", "hdf5"])
def test_version_1_keeps_what_belongs_to_a_snapshot(path: Path, run_id: str) -> None:
    run = wt.open(path)[run_id]
    for t in range(ROWS):
        values = snapshot(t, INFO)
        for name in ("obs_norm", "ret_norm"):
            stats = getattr(run, name)(t)
            for got, said in zip((stats.mean, stats.var, stats.count), values[name], strict=True):
                assert np.array_equal(got, said)
        said = values["train"].get("approx_kl", np.nan)
        assert np.array_equal(run["train/approx_kl"][t], said, equal_nan=True)
        assert np.array_equal(run["critic/weights"][t], values["critic"])
        assert np.array_equal(run["optimizer/exp_avg"][t], values["moments"][0])
        assert np.array_equal(run["optimizer/exp_avg_sq"][t], values["moments"][1])
    for i in range(ROWS // 2):
        assert np.array_equal(run["probe/observations"][i], probes(i))
    assert run.info.policy == INFO.policy
    assert run.info.layout == INFO.layout
    assert run.info.env == INFO.env
    assert run.load_policy(3).predict(np.zeros(2))[0].shape == (1,)


def test_version_1_is_whole() -> None:
    assert wt.verify(V1 / "dataset", deep=True) == []
    assert wt.verify(V1 / "dataset.h5") == []


def test_version_1_can_be_packed_anew(tmp_path: Path) -> None:
    run = wt.open_run(V1 / "dataset/runs/folder.zarr")
    for profile in ("default", "archive"):
        packed = wt.open_run(wt.pack(run.path, profile=profile, out=tmp_path / f"{profile}.zip"))
        assert np.array_equal(packed.weights[:], run.weights[:])


def test_the_golden_files_are_not_written_to(tmp_path: Path) -> None:
    """Reading leaves no lock and no draft behind, so git would show nothing."""
    copy = tmp_path / "v1"
    shutil.copytree(V1, copy)
    before = sorted(copy.rglob("*"))
    wt.verify(copy / "dataset", deep=True)
    wt.lint(copy / "dataset")
    assert sorted(copy.rglob("*")) == before
