"""Data sets that populations make: resumed after a kill, repeated, kept apart from SB3's."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rich.console import Console

import weighttraj as wt
from tests.collect.test_runner import assert_same_arrays, committed
from tests.disk import grow
from tests.shell import shell
from tests.small import SMALL, SMALL_RECIPE
from weighttraj.collect import Recipe, collect, read_recipe, replay
from weighttraj.collect.settings import Collect, Seeds
from weighttraj.errors import CollectError, RecipeError
from weighttraj.format import DatasetInfo, RunEntry
from weighttraj.store.catalog import read_dataset_info, write_dataset_info
from weighttraj.tools.repair import seal

QUICK = replace(SMALL_RECIPE, seeds=Seeds(train=[0, 1]), collect=Collect(collector="population"))


def of_seed(dataset: wt.Dataset, seed: int) -> wt.Run:
    (run,) = dataset.select(seed=seed)
    return run


TOML = """
id = "small"
[ppo]
total_timesteps = 768
n_steps = 64
batch_size = 16
n_epochs = 2
critic_arch = [8, 8]
[seeds]
train = "0:2"
[collect]
collector = "population"
[store]
every = 2
block = 8
probe_observations = 4
"""


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("quick") / "dataset"
    collect(QUICK, out)
    return out


def test_a_recipe_names_its_collector(tmp_path: Path) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(TOML)
    assert read_recipe(path) == replace(QUICK, seeds=Seeds(train="0:2"))
    path.write_text(TOML.replace("[store]", "population = 0\n[store]"))
    with pytest.raises(RecipeError, match="population at least 1"):
        read_recipe(path)
    path.write_text(TOML.replace('"population"', '"cleanrl"'))
    with pytest.raises(RecipeError, match=r"cleanrl.*\$\.collect\.collector"):
        read_recipe(path)


def test_a_killed_population_goes_on_in_any_grouping(quick: Path, tmp_path: Path) -> None:
    recipe, out = tmp_path / "recipe.toml", tmp_path / "dataset"
    recipe.write_text(TOML)
    command = [sys.executable, "-m", "weighttraj.cli", "collect", str(recipe), "--out", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    paths = [out / f"runs/seed{seed:04d}.zarr" for seed in (0, 1)]
    deadline = time.monotonic() + 120
    while min(map(committed, paths)) < 8 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert all(8 <= committed(path) < 49 for path in paths)
    recipe.write_text(TOML.replace("[store]", "population = 1\n[store]"))
    again = shell("weighttraj", "collect", recipe, "--out", out)
    assert again.returncode == 0, again.stderr
    assert "continuing after the last" in " ".join(again.stdout.split())
    dataset = wt.open(out)
    assert wt.verify(out) == []
    for seed in (0, 1):
        assert_same_arrays(of_seed(dataset, seed), of_seed(wt.open(quick), seed))


def test_ctrl_c_stops_every_population(tmp_path: Path) -> None:
    recipe, out = tmp_path / "recipe.toml", tmp_path / "dataset"
    text = TOML.replace("= 768", "= 76_800").replace('"0:2"', '"0:4"')
    recipe.write_text(text.replace("[store]", "population = 2\n[store]"))
    command = [sys.executable, "-m", "weighttraj.cli", "collect", str(recipe)]
    command += ["--out", str(out), "--workers", "2"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    paths = [out / f"runs/seed{seed:04d}.zarr" for seed in range(4)]
    deadline = time.monotonic() + 120
    while min(map(committed, paths)) < 8 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in said
    assert {wt.open_run(path).info.status for path in paths} == {"crashed"}
    assert wt.verify(out) == []


def test_one_that_does_not_repeat_itself_starts_over_alone(quick: Path, tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    info = of_seed(wt.open(quick), 0).info
    with wt.RunWriter(out / "runs/seed0000.zarr", info) as writer:  # another machine's numbers
        writer.append(
            np.ones(info.layout.size, np.float32),
            num_timesteps=0,
            obs_norm=(np.zeros(4), np.ones(4), 1.0),
            ret_norm=(np.array(0.0), np.array(1.0), 1.0),
        )
        writer.flush()
        writer._closed = True  # killed
        writer._lock.release()
    entry = RunEntry(id="seed0000", path="runs/seed0000.zarr", seed=0, split="train")
    of_set = read_dataset_info(quick)
    write_dataset_info(out, replace(of_set, runs=(entry,), status="collecting"))
    screen = io.StringIO()
    dataset = collect(QUICK, out, console=Console(file=screen, width=1000))
    assert "starting over as seed0000-2" in screen.getvalue()
    assert {run.id for run in dataset} == {"seed0000-2", "seed0001"}
    for seed in (0, 1):
        assert_same_arrays(of_seed(dataset, seed), of_seed(wt.open(quick), seed))


def test_a_run_that_cannot_be_written_leaves_the_others_whole(tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    config = replace(SMALL, total_timesteps=128, n_steps=64)
    recipe = replace(QUICK, ppo=config, seeds=Seeds(train=[0, 1, 2]))
    with (
        wt.RunWriter(out / "runs/seed0001.zarr", wt.RunInfo(run_id="x", layout=LAYOUT)),
        pytest.raises(CollectError, match=r"(?s)1 of 3 runs failed.*seed 1.*another process"),
    ):
        write_dataset_info(out, replace(described(recipe), status="collecting"))
        collect(recipe, out)
    for seed in (0, 2):
        assert wt.open_run(out / f"runs/seed{seed:04d}.zarr").info.status == "complete"


def test_a_full_disk_leaves_finished_runs_as_they_are(quick: Path, disk: Path) -> None:
    out = disk / "data"
    grow(disk, "4m")
    collect(replace(QUICK, seeds=Seeds(train=[0])), out)
    finished = (out / "runs/seed0000.zarr.zip").read_bytes()
    used = sum(p.stat().st_blocks * 512 for p in disk.rglob("*"))
    grow(disk, str(used + (100 << 10)))
    with pytest.raises((CollectError, OSError), match="No space left on device"):
        collect(QUICK, out)
    assert (out / "runs/seed0000.zarr.zip").read_bytes() == finished
    grow(disk, "4m")
    for run, same in zip(collect(QUICK, out), wt.open(quick), strict=True):
        assert_same_arrays(run, same)
    assert wt.verify(out, deep=True) == []


LAYOUT = wt.ParamLayout.of({"w": ((1,), "weight", ("a",))})


def described(recipe: Recipe) -> Any:
    document = json.loads(json.dumps(asdict(recipe))) | {"seeds": recipe.seeds.by_split()}
    return DatasetInfo(id=recipe.id, version=recipe.version, recipe=document)


def test_replaying_refuses_a_recipe_of_which_there_can_be_no_runs(
    quick: Path, tmp_path: Path
) -> None:
    out = tmp_path / "dataset"
    shutil.copytree(quick, out)
    info = read_dataset_info(out)
    for change in ({"n_steps": 0}, {"net_arch": [0]}, {"env_id": "NoSuchEnv-v0"}):
        ppo = {**info.recipe["ppo"], **change}
        write_dataset_info(out, replace(info, recipe={**info.recipe, "ppo": ppo}))
        with pytest.raises(RecipeError, match=rf"(?s)ppo\.{next(iter(change))} = .*where: {out}"):
            replay(out, 3)


def test_replaying_finds_an_honest_population_and_another(quick: Path) -> None:
    assert replay(quick, 6, seed=1) == []
    info = read_dataset_info(quick)
    ppo = {**info.recipe["ppo"], "learning_rate": 1e-3}
    write_dataset_info(quick, replace(info, recipe={**info.recipe, "ppo": ppo}))
    try:
        (problem,) = replay(quick, 9)
    finally:
        write_dataset_info(quick, info)
    assert "snapshot 1 of 9 is the first that differs" in problem


def test_a_data_set_keeps_its_collector(quick: Path) -> None:
    with pytest.raises(CollectError, match=r"(?s)another recipe.*'collect.collector': 'pop"):
        collect(replace(QUICK, collect=Collect()), quick)
    smaller = replace(QUICK, collect=Collect(collector="population", population=3))
    assert len(collect(smaller, quick)) == 2


def test_a_data_set_that_is_older_than_a_setting_has_its_default(
    small_dataset: Path, tmp_path: Path
) -> None:
    info = read_dataset_info(small_dataset)
    young = ("activation", "ortho_init", "log_std_init")
    ppo = {name: value for name, value in info.recipe["ppo"].items() if name not in young}
    old = {**{n: v for n, v in info.recipe.items() if n != "collect"}, "ppo": ppo}
    out = tmp_path / "dataset"
    shutil.copytree(small_dataset, out)
    write_dataset_info(out, replace(info, recipe=old))
    seal(out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert len(collect(SMALL_RECIPE, out)) == 4
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert replay(out, 3) == []
    relu = replace(SMALL_RECIPE, ppo=replace(SMALL_RECIPE.ppo, activation="relu"))
    with pytest.raises(CollectError, match=r"(?s)another recipe.*'ppo.activation': 'tanh'.*'relu'"):
        collect(relu, out)


# What a population cannot do


class Scaled(gym.Wrapper[Any, Any, Any, Any]):
    pass


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"env_id": "CartPole-v1"}, "env_id = CartPole-v1"),
        ({"env_id": "Pendulum-v1"}, "env_id = Pendulum-v1"),
        ({"env_id": "Humanoid-v5"}, "env_id = Humanoid-v5"),
        ({"env_id": "WrappedPendulum-v0"}, "env_id = WrappedPendulum-v0"),
        ({"batch_size": 24, "n_steps": 72}, "batch_size = 24"),
        ({"batch_size": 48}, "n_steps = 64"),
    ],
)
def test_what_it_cannot_do_names_the_other_collector(
    change: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    if "WrappedPendulum-v0" not in gym.registry:
        wrapper = gym.envs.registration.WrapperSpec("Scaled", f"{__name__}:Scaled", {})
        gym.register(
            "WrappedPendulum-v0",
            "gymnasium.envs.mujoco.inverted_pendulum_v4:InvertedPendulumEnv",
            additional_wrappers=(wrapper,),
        )
    recipe = replace(QUICK, ppo=replace(QUICK.ppo, **change))
    with pytest.raises(RecipeError, match=rf'(?s)collector = "sb3".*{reason}'):
        collect(recipe, tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()
