"""What a writer commits, every reader reads, whatever the size of a snapshot."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from stable_baselines3 import PPO
from zarr.storage import LocalStore

import weighttraj as wt
from weighttraj import run as reader
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.errors import DamageError, FormatError
from weighttraj.format import ParamLayout, RunInfo
from weighttraj.format.schema import EnvInfo, ObsNorm, PolicySpec
from weighttraj.load import CachedWeights, WindowDataset
from weighttraj.store import codecs, decode, live
from weighttraj.tools.export import export_npy, export_safetensors
from weighttraj.tools.hdf5 import export_hdf5, import_hdf5
from weighttraj.writer import RunWriter

WIDTH = 50_000
LAYOUT = ParamLayout.of({"w": ((WIDTH,), "other", ("fixed",))})
IMAGE = (36, 36, 4)
INFO = RunInfo(
    run_id="run",
    layout=LAYOUT,
    critic_layout=LAYOUT,
    optimizer_moments=True,
    policy=PolicySpec(kind="other", observation_shape=IMAGE),
    probe_observations=5,
    obs_norm=ObsNorm(source="test", epsilon=1e-8, shape=IMAGE),
)


@pytest.fixture
def tight(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits of format, a few hundred times smaller: as if all policies were larger."""
    monkeypatch.setattr(codecs, "BLOCK_BYTES", 3 << 20)
    monkeypatch.setattr(reader, "BLOCK_BYTES", 3 << 20)
    monkeypatch.setattr(reader, "PIECE_BYTES", 1 << 20)
    monkeypatch.setattr(codecs, "MAX_CHUNK_BYTES", 4 << 20)
    monkeypatch.setattr(codecs, "MAX_CHUNK_PARAMS", 1 << 10)
    monkeypatch.setattr(codecs, "PACKED_CHUNK_BYTES", 1 << 16)
    monkeypatch.setattr(live, "_SLAB_BYTES", 1 << 18)
    monkeypatch.setattr(decode, "_WHOLE_BYTES", 1 << 20)


def write(path: Path, info: RunInfo = INFO, n: int = 7, **options: Any) -> wt.Run:
    rng = np.random.default_rng(0)
    with RunWriter(path, info, **options) as writer:
        for t in range(n):
            four = rng.standard_normal((4, WIDTH), np.float32)
            norm = (rng.normal(size=IMAGE), rng.uniform(1, 2, IMAGE), float(t + 1))
            writer.append(
                four[0],
                num_timesteps=t,
                iteration=t,
                critic=four[1],
                moments=(four[2], four[3]),
                obs_norm=norm,
            )
            writer.append_iteration(rng.standard_normal((5, *IMAGE), np.float32))
    return wt.open_run(path)


def contents(run: wt.Run) -> dict[str, bytes]:
    return {name: array[:].tobytes() for name, array in run.arrays.items()}


@pytest.mark.usefixtures("tight")
def test_large_rows_are_read_back_by_every_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", str(tmp_path / "cache"))
    run = write(tmp_path / "run.zarr")
    assert run.info.block == 3  # of 64: four vectors and an image's statistics a snapshot
    expected = contents(run)
    plain = zarr.open(LocalStore(run.path, read_only=True), mode="r")
    assert {n: plain[n][:].tobytes() for n in expected} == expected  # type: ignore[index, union-attr]
    assert wt.verify(run.path) == []
    assert wt.repair(run.path) == []
    assert [finding.check for finding in wt.lint(run.path)] == []
    for profile in ("default", "archive"):
        packed = wt.open_run(wt.pack(run.path, profile=profile))
        assert contents(packed) == expected
        assert wt.verify(packed.path) == []
    file = export_hdf5(run, tmp_path / "run.h5")
    again = wt.open(import_hdf5(file, tmp_path / "again")).runs[0]
    assert contents(again) == contents(wt.open(file).runs[0]) == expected
    assert np.array_equal(np.load(export_npy(run, tmp_path / "npy") / "weights.npy"), run.weights)
    assert export_safetensors(run, -1, tmp_path / "last.safetensors").stat().st_size > 4 * WIDTH
    assert np.array_equal(CachedWeights(run).map(), run.weights[:])
    assert np.array_equal(WindowDataset([run], window=3)[1]["weights"], run.weights[1:4])


@pytest.mark.usefixtures("tight")
def test_a_large_run_goes_on_in_the_blocks_that_it_began_with(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    with pytest.raises(KeyError), RunWriter(path, INFO):
        raise KeyError
    write(path, replace(INFO, block=2), n=5, resume=True)
    assert wt.open_run(path).info.block == 3
    write(path.with_name("other.zarr"), n=5)
    assert contents(wt.open_run(path)) == contents(wt.open_run(path.with_name("other.zarr")))


def test_runs_in_blocks_of_any_size_stay_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Earlier versions wrote 64 large rows into one shard, which readers then refused."""
    run = write(tmp_path / "run.zarr")
    expected = contents(run)
    request.getfixturevalue("tight")
    assert run.info.block == 64
    old = wt.open_run(run.path)  # 12 MB of weights in a shard, where chunks may have 4
    assert contents(old) == expected
    assert np.array_equal(old.weights[5, 40_000:], run.weights[5, 40_000:])
    assert wt.verify(old.path) == wt.repair(old.path) == []
    assert contents(wt.open_run(wt.pack(old.path))) == expected
    write(old.path.with_name("more.zarr"), n=9)


def test_a_chunk_larger_than_its_bytes_can_fill_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = ParamLayout.of({"w": ((4096,), "other", ("fixed",))})
    with RunWriter(tmp_path / "r.zarr", RunInfo(run_id="r", layout=layout)) as writer:
        for t in range(64):
            writer.append(np.full(4096, t, np.float32), num_timesteps=t)
    monkeypatch.setattr(codecs, "FREE_CHUNK_BYTES", 1 << 19)
    run = wt.open_run(tmp_path / "r.zarr")  # 1 MiB of few numbers: within the ratio
    assert np.array_equal(run.weights[:, 0], np.arange(64))
    monkeypatch.setattr(codecs, "MAX_RATIO", 2)
    with pytest.raises(FormatError, match="more memory than its bytes can fill"):
        wt.open_run(tmp_path / "r.zarr").weights[:]


@pytest.mark.usefixtures("tight")
def test_damage_in_a_large_shard_is_found(tmp_path: Path) -> None:
    monkey = decode._WHOLE_BYTES
    assert monkey < 3 * 4 * WIDTH * 4
    run = write(tmp_path / "run.zarr", n=3)
    file = next(p for p in (run.path / "policy/weights/c").rglob("*") if p.is_file())
    content = bytearray(file.read_bytes())
    content[-9] ^= 1
    file.write_bytes(content)
    with pytest.raises(DamageError, match="another checksum"):
        wt.open_run(run.path).weights[:]
    file.write_bytes(bytes(content[:-1]))
    with pytest.raises(DamageError, match="not what the shard's index says"):
        wt.open_run(run.path).weights[:]


def deep(depth: int) -> Any:
    return {"x": deep(depth - 1)} if depth else 1


@pytest.mark.parametrize(
    "info",
    [
        replace(INFO, env=EnvInfo(id="x", kwargs=deep(80))),
        replace(INFO, env=EnvInfo(id="half a character: \ud800")),
        replace(INFO, obs_norm=ObsNorm(source="test", epsilon=1e-8, shape=(0,))),
    ],
    ids=["deep", "text", "empty"],
)
def test_what_readers_would_refuse_is_refused_before_the_training(
    tmp_path: Path, info: RunInfo
) -> None:
    with pytest.raises(FormatError, match="could not be read"):
        RunWriter(tmp_path / "run.zarr", info)
    assert [p.name for p in tmp_path.iterdir() if p.suffix != ".lock"] == []


def test_a_policy_of_four_million_parameters_is_recorded_and_read(tmp_path: Path) -> None:
    arch = {"pi": [2100, 2100], "vf": [8]}
    options: dict[str, Any] = {"n_steps": 4, "batch_size": 4, "n_epochs": 2, "device": "cpu"}
    model = PPO("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": arch}, **options)
    with WeightTrajectoryCallback(tmp_path / "run.zarr", every=2) as callback:
        model.learn(4, callback=callback)
    run = wt.open_run(tmp_path / "run.zarr")
    assert (len(run), run.layout.size, run.info.block) == (2, 4_422_602, 15)
    actor = np.concatenate([p.detach().numpy().ravel() for p in callback._agent.actor.values()])
    assert np.array_equal(run.weights[-1], actor)


MEASURED = """
import resource, sys
from pathlib import Path
import numpy as np
import weighttraj as wt
from weighttraj import ParamLayout, RunInfo, RunWriter
size = int(sys.argv[2])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
path = Path(sys.argv[1]) / "run.zarr"
row = np.zeros(size, np.float32)
layout = ParamLayout.of({"w": ((size,), "other", ("fixed",))})
with RunWriter(path, RunInfo(run_id="run", layout=layout)) as writer:
    for t in range(2):
        row[t::1000] = t + 1
        writer.append(row, num_timesteps=t)
run = wt.open_run(path)
assert run.info.block == 1 and np.array_equal(run.weights[1], row)
assert wt.verify(path) == []
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10)
"""


def test_fifty_million_parameters_take_the_memory_of_a_few_snapshots(tmp_path: Path) -> None:
    size = 50_000_000
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, str(tmp_path), str(size)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 6 * 4 * size
