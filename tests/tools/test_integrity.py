"""verify finds, lint asks, repair mends; the manifest and the tables belong to a complete set."""

from __future__ import annotations

import contextlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import weighttraj as wt
from tests.small import SMALL_RECIPE
from tests.store.test_store import INFO, append, chunk_files, weights, write
from weighttraj.collect import collect
from weighttraj.errors import DamageError, FormatError
from weighttraj.format import Cadence, EnvInfo, ParamLayout, RunInfo
from weighttraj.store.catalog import check_manifest, read_dataset_info, write_dataset_info
from weighttraj.writer import RunWriter

LAYOUT = ParamLayout.of({"w": ((3,), "weight", ("a",)), "b": ((2,), "bias", ("a",))})


@pytest.fixture
def dataset(small_dataset: Path, tmp_path: Path) -> Path:
    shutil.copytree(small_dataset, tmp_path / "dataset")
    return tmp_path / "dataset"


# Manifest and tables


def test_a_complete_data_set_has_a_manifest_and_tables(dataset: Path) -> None:
    assert check_manifest(dataset) == []
    runs = pd.read_parquet(dataset / "tables/runs.parquet").set_index("run_id")
    snapshots = pd.read_parquet(dataset / "tables/snapshots.parquet")
    for run in wt.open(dataset):
        row = runs.loc[run.id]
        assert (row.seed, row.split, row.n_snapshots) == (run.info.seed, run.split, len(run))
        assert row.final_return == run.final_return
        mine = snapshots[snapshots.run_id == run.id]
        assert np.array_equal(mine.num_timesteps, run.num_timesteps)
        steps = np.linalg.norm(np.diff(run.weights[:].astype(float), axis=0), axis=1)
        assert np.allclose(mine.step_norm, [0, *steps])


@pytest.mark.parametrize("place", ["runs/seed0001.zarr.zip", "tables/runs.parquet", "dataset.json"])
def test_a_changed_missing_or_added_object_is_found(dataset: Path, place: str) -> None:
    whole = (dataset / place).read_bytes()
    (dataset / place).write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert wt.verify(dataset)
    (dataset / place).write_bytes(whole)
    assert wt.verify(dataset) == []
    (dataset / "extra.bin").write_bytes(b"x")
    assert "extra.bin: not in the manifest" in wt.verify(dataset)[0]
    (dataset / "extra.bin").unlink()
    if place != "dataset.json":
        (dataset / place).unlink()
        assert wt.verify(dataset)


def test_every_byte_of_the_manifest_counts(dataset: Path) -> None:
    file = dataset / "MANIFEST.sha256"
    whole = file.read_bytes()
    for place in range(0, len(whole), 3):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << (place % 8)
        file.write_bytes(bytes(flipped))
        with contextlib.suppress(FormatError):
            assert check_manifest(dataset), place
        if place % 99 == 0:
            assert wt.verify(dataset), place
    file.unlink()
    assert "manifest is missing" in wt.verify(dataset)[0]


def test_the_list_of_runs_is_not_edited_unseen(dataset: Path) -> None:
    file = dataset / "dataset.json"
    file.write_text(file.read_text().replace('"test"', '"train"', 1))
    with pytest.raises(DamageError, match="does not match its checksum"):
        wt.open(dataset)


def test_only_a_complete_data_set_is_sealed(dataset: Path) -> None:
    (dataset / "runs/seed0001.zarr.zip").unlink()
    write_dataset_info(dataset, replace(read_dataset_info(dataset), status="collecting"))
    with pytest.raises(FormatError, match="4 complete runs"):
        wt.seal(dataset)


# Repair


def test_repair_writes_tables_and_manifest_anew(dataset: Path) -> None:
    (dataset / "tables/runs.parquet").write_bytes(b"")
    (dataset / "MANIFEST.sha256").unlink()
    assert "tables and manifest written anew" in wt.repair(dataset)[-1]
    assert wt.verify(dataset, deep=True) == []
    assert wt.repair(dataset) == []


def test_repair_does_not_vouch_for_damage(dataset: Path) -> None:
    file = dataset / "runs/seed0001.zarr.zip"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(bytes(content))
    assert "not written again" in wt.repair(dataset)[-1]
    assert wt.verify(dataset)


def test_what_repair_dropped_is_collected_again_in_the_same_bytes(
    dataset: Path, small_dataset: Path
) -> None:
    file = dataset / "runs/seed0001.zarr.zip"
    file.write_bytes(file.read_bytes()[:5000])
    steps = wt.repair(dataset, cut=True)
    assert "collect the recipe again" in steps[0]
    assert [run.id for run in wt.open(dataset)] == ["seed0000", "seed0002", "seed0003"]
    collect(SMALL_RECIPE, dataset)
    assert wt.verify(dataset, deep=True) == []
    for name, array in wt.open(small_dataset)["seed0001"].arrays.items():
        assert wt.open(dataset)["seed0001"][name][:].tobytes() == array[:].tobytes(), name


def test_repair_cuts_a_run_before_its_damage(tmp_path: Path) -> None:
    run = write(tmp_path / "run.zarr", 30)
    file = chunk_files(run, "policy/weights")[2]
    file.write_bytes(file.read_bytes()[:-1])
    assert "damaged after row 16 of 30" in wt.repair(run.path)[-1]
    assert len(wt.open_run(run.path)) == 30
    assert "cut to 16 snapshots" in wt.repair(run.path, cut=True)[-1]
    assert wt.verify(run.path) == []
    cut = wt.open_run(run.path)
    assert (len(cut), cut.info.status) == (16, "crashed")
    again = write(run.path, 30, resume=True)
    assert np.array_equal(again.weights[:], weights(30))
    assert wt.verify(run.path) == []


def test_repair_removes_what_was_never_committed(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    writer = RunWriter(path, INFO)
    for t, row in enumerate(weights(8)):
        append(writer, t, row)
    writer.close("crashed")
    stray = path / "policy/weights/c/5/0"
    stray.parent.mkdir()
    stray.write_bytes(b"x")
    draft = tmp_path / ".run.zarr.123.draft"
    draft.mkdir()
    wt.repair(path)
    assert not stray.exists()
    assert not draft.exists()
    assert len(wt.open_run(path)) == 8


# Lint


def lint_of(tmp_path: Path, rows: np.ndarray, **values: object) -> list[str]:
    info = RunInfo(run_id="run", layout=LAYOUT, cadence=Cadence(every=2), **values)
    with RunWriter(tmp_path / "run.zarr", info) as writer:
        for t, row in enumerate(rows):
            writer.append(row, num_timesteps=t, gradient_step=2 * t, iteration=t)
    return [finding.check for finding in wt.lint(tmp_path / "run.zarr")]


def walk(n: int = 60) -> np.ndarray:
    steps = np.random.default_rng(0).normal(size=(n, 5))
    return np.cumsum(steps, axis=0).astype(np.float32)


def test_an_honest_run_passes(tmp_path: Path, small_dataset: Path) -> None:
    assert lint_of(tmp_path, walk()) == []
    assert wt.lint(small_dataset) == []


def test_final_weights_under_every_name_are_found(tmp_path: Path) -> None:
    rows = walk()
    rows[20:30] = rows[-1]
    assert lint_of(tmp_path, rows)[:2] == ["final", "duplicate"]


def test_a_jump_is_found(tmp_path: Path) -> None:
    rows = walk()
    rows[40:] += 500
    assert lint_of(tmp_path, rows) == ["jump"]


def test_parameters_that_never_change_are_named(tmp_path: Path) -> None:
    rows = walk()
    rows[:, 3] = 1.0
    assert lint_of(tmp_path, rows) == ["constant"]
    assert "1 of 5 parameters never change, in ['b']" in str(wt.lint(tmp_path / "run.zarr")[0])


def test_a_missing_normaliser_is_found(tmp_path: Path) -> None:
    env = EnvInfo(id="X-v0", wrappers=("NormalizeObservation",))
    assert lint_of(tmp_path, walk(), env=env) == ["normalizer"]


def test_gaps_and_counters_that_go_back_are_found(tmp_path: Path) -> None:
    info = RunInfo(run_id="run", layout=LAYOUT, cadence=Cadence(every=2))
    with RunWriter(tmp_path / "run.zarr", info) as writer:
        for t, row in enumerate(walk()):
            step = 2 * t + (4 if t > 30 else 0) - (20 if t > 50 else 0)
            writer.append(row, num_timesteps=t, gradient_step=step, iteration=0)
    findings = wt.lint(tmp_path / "run.zarr")
    assert [finding.check for finding in findings] == ["order", "gap"]
    assert "goes back at 51" in findings[0].message
    assert "before 31, 51" in findings[1].message


def test_twins_and_short_runs_are_found(dataset: Path) -> None:
    """A run whose weights are another's, as when a seed was not passed on."""
    run = wt.open(dataset)["seed0001"]
    path = dataset / "runs/seed0003.zarr"
    info = replace(run.info, run_id="seed0003", n_committed=0, n_committed_iterations=0)
    with RunWriter(path, replace(info, diagnostics=(), probe_observations=0)) as writer:
        for t in range(30, 49):
            obs, ret = run.obs_norm(t), run.ret_norm(t)
            writer.append(
                run.weights[t],
                num_timesteps=t,
                gradient_step=2 * t,
                obs_norm=(obs.mean, obs.var, obs.count),
                ret_norm=(ret.mean, ret.var, ret.count),
            )
    wt.pack(path)
    shutil.rmtree(path)
    checks = {(finding.check, finding.run) for finding in wt.lint(dataset)}
    assert checks >= {("short", "seed0003"), ("twin", "seed0001")}


def test_json_of_the_group_is_in_one_form(tmp_path: Path) -> None:
    """A flipped bit can leave JSON equal (1e-08, 1E-08); the form gives it away."""
    run = write(tmp_path / "run.zarr")
    file = run.path / "zarr.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(document, indent=2))
    assert len(wt.open_run(run.path)) == 20
    assert "not in the form in which it was written" in wt.verify(run.path)[0]
