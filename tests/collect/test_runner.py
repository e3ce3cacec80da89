"""Recipes to data sets, and on again after being killed."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from rich.console import Console

import weighttraj as wt
from tests.shell import shell
from tests.small import SMALL, SMALL_RECIPE
from weighttraj.collect import Recipe, collect, read_recipe
from weighttraj.collect.costs import read_costs
from weighttraj.collect.settings import Seeds, Store, parse_seeds
from weighttraj.collect.tasks import Task, collect_block
from weighttraj.errors import CollectError, EngineError, FormatError, RecipeError
from weighttraj.format import RunEntry
from weighttraj.store.catalog import read_dataset_info, write_dataset_info

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
test = [2, 3]
[store]
every = 2
block = 8
probe_observations = 4
"""


@pytest.fixture
def recipe_file(tmp_path: Path) -> Path:
    path = tmp_path / "recipe.toml"
    path.write_text(TOML)
    return path


def test_a_recipe_is_read(recipe_file: Path) -> None:
    recipe = read_recipe(recipe_file)
    assert recipe.splits() == SMALL_RECIPE.splits()
    assert replace(recipe, seeds=SMALL_RECIPE.seeds) == SMALL_RECIPE


def test_our_recipes_can_be_read() -> None:
    paths = sorted(Path(__file__).parents[2].glob("datasets/*/recipe.toml"))
    assert paths
    for path in paths:
        assert read_recipe(path).splits()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("n_steps", "n_stpes"), "did you mean 'n_steps'"),
        (("[store]", "[stores]"), "did you mean 'store'"),
        (('id = "small"', ""), "missing required field `id`"),
        (("every = 2", 'every = "2"'), r"Expected `int`, got `str` - at `\$\.store\.every`"),
        (("[2, 3]", "[1, 3]"), "seed 1 in train and in test"),
        (('"0:2"', '"0-2"'), 'a range such as "0:30"'),
        (("id =", "id = ="), "no TOML"),
        (("every = 2", "every = 0"), r"(?s)every from 1 to the 96 gradient .*store.every = 0"),
        (("every = 2", "every = 97"), r"(?s)every from 1 to the 96 gradient .*store.every = 97"),
        (("= 768", "= 63"), r"(?s)at least one rollout, n_steps = 64.*total_timesteps = 63"),
        (("block = 8", "block = 0"), "store.block at least 1"),
        (("batch_size = 16", "batch_size = 65"), r"(?s)batch_size from 2 to n_steps.*= 65"),
        (("n_epochs = 2", "n_epochs = 0\ngamma = 2.0"), r"(?s)n_epochs from 1.*gamma from 0 to 1"),
    ],
)
def test_a_bad_recipe_is_one_clear_error(
    recipe_file: Path, change: tuple[str, str], message: str
) -> None:
    recipe_file.write_text(TOML.replace(*change))
    with pytest.raises(RecipeError, match=message):
        read_recipe(recipe_file)


# Each stands in line 4, of which the error must tell.
IMPOSSIBLE = [
    "learning_rate = inf",
    "learning_rate = nan",
    "learning_rate = 0.0",
    "learning_rate = 1e400",
    "ent_coef = inf",
    "vf_coef = nan",
    "gamma = 1.01",
    "gae_lambda = -0.1",
    "clip_range = 0.0",
    "clip_range_vf = 0.0",
    "max_grad_norm = 0",
    "adam_eps = 0.0",
    "log_std_init = -inf",
    "net_arch = []",
    "net_arch = [8, 0]",
    "net_arch = [1_000_000_000_000]",
    "net_arch = [60_000, 60_000]",
    "critic_arch = [-1]",
    "n_steps = 0",
    "n_epochs = 0",
    "batch_size = 0",
    "total_timesteps = 10_000_000_000_000",
    'env_id = "NoSuchEnv-v0"',
    'env_id = "os:path"',
    'env_id = "Blackjack-v1"',
]


@pytest.mark.parametrize("line", IMPOSSIBLE)
def test_an_impossible_training_is_refused_with_its_line(recipe_file: Path, line: str) -> None:
    recipe_file.write_text(f'id = "small"\n\n[ppo]\n{line}\n\n[seeds]\ntrain = [0]\n')
    key = line.split(" ")[0]
    with pytest.raises(RecipeError, match=rf"ppo\.{key} = .* \(line 4\)"):
        read_recipe(recipe_file)


@pytest.mark.parametrize(
    "seeds",
    [
        "[4_294_967_296]",
        "[-1]",
        "[0, 0]",
        '"0:2,1"',
        '"0:1000000000000"',
        '"4294967295:4294967297"',
        '"5:3"',
        '""',
    ],
)
def test_impossible_seeds_are_refused_with_their_line(recipe_file: Path, seeds: str) -> None:
    recipe_file.write_text(f'id = "small"\n[seeds]\nvalidation = []\ntrain = {seeds}\n')
    with pytest.raises(RecipeError, match=r"seeds\.train = .* \(line 4\)"):
        read_recipe(recipe_file)


def test_the_largest_seed_trains(tmp_path: Path) -> None:
    dataset = collect(one_seed(2**32 - 1), tmp_path / "dataset")
    assert [len(run) for run in dataset] == [49]


def test_all_that_is_wrong_is_said_at_once(recipe_file: Path) -> None:
    text = TOML.replace("n_epochs = 2", "n_epochs = 0\ngamma = 2.0").replace("[2, 3]", "[-1]")
    recipe_file.write_text(text + '[collect]\ncollector = "population"\npopulation = 0\n')
    with pytest.raises(RecipeError) as told:
        read_recipe(recipe_file)
    for said in ("n_epochs = 0 (line 7)", "gamma = 2.0 (line 8)", "seeds.test = [-1] (line 12)"):
        assert said in str(told.value)
    assert "collect.population = 0 (line 19)" in str(told.value)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('id = "x"\nppo = { n_epochs = 2, gamma = 2.0 }\n', 2),
        ('id = "x"\nppo.gamma = 2.0\n', 2),
        ('id = "x"\n[ "ppo" ]  # CleanRL\n\n"gamma"=2.0\n', 4),
        ('id = "x"\r\n[ppo]\r\nnet_arch = [\r\n8,\r\n8]\r\ngamma = 2.0\r\n', 6),
        ('id = "x"\nlicence = """\n[ppo]\ngamma = 2.0\n"""\n[ppo]\ngamma = 2.0\n', 7),
    ],
)
def test_a_line_is_found_however_it_is_written(recipe_file: Path, text: str, line: int) -> None:
    recipe_file.write_bytes(text.encode())
    with pytest.raises(RecipeError, match=rf"ppo\.gamma = 2\.0 \(line {line}\)"):
        read_recipe(recipe_file)


@pytest.mark.parametrize(
    ("line", "where"),
    [("gama = 0.9", "line 4"), ('gamma = "0.9"', "line 4"), ('activation = "gelu"', "line 4")],
)
def test_a_key_or_a_type_that_is_wrong_has_its_line(
    recipe_file: Path, line: str, where: str
) -> None:
    recipe_file.write_text(f'id = "small"\n\n[ppo]\n{line}\n')
    with pytest.raises(RecipeError, match=f"where: .*recipe.toml, {where}"):
        read_recipe(recipe_file)


@pytest.mark.parametrize("text", [f"a = {'9' * 5000}", "a = " + "[" * 5000, "\udcff"])
def test_a_text_that_cannot_be_read_is_one_clear_error(recipe_file: Path, text: str) -> None:
    recipe_file.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(RecipeError, match="no TOML"):
        read_recipe(recipe_file)


def test_an_impossible_recipe_writes_nothing(tmp_path: Path) -> None:
    for recipe in (
        replace(SMALL_RECIPE, ppo=replace(SMALL, learning_rate=float("inf"))),
        replace(SMALL_RECIPE, seeds=Seeds(train=[0, 2**32])),
    ):
        with pytest.raises(RecipeError):
            collect(recipe, tmp_path / "dataset")
    with pytest.raises(RecipeError, match="invalid seeds"):
        collect(SMALL_RECIPE, tmp_path / "dataset", seeds=[0, 2**32])
    assert not list(tmp_path.iterdir())


def test_false_leaves_the_change_of_the_value_unclipped(recipe_file: Path) -> None:
    recipe_file.write_text('id = "small"\n[ppo]\nclip_range_vf = false\n')
    assert read_recipe(recipe_file).ppo.clip_range_vf is None


def test_seeds() -> None:
    assert parse_seeds("7") == [7]
    assert parse_seeds([5, 2]) == [5, 2]
    with pytest.raises(RecipeError):
        parse_seeds([-1])


def test_a_data_set_is_collected(small_dataset: Path) -> None:
    dataset = wt.open(small_dataset)
    assert dataset.info.status == "complete"
    assert [run.id for run in dataset] == ["seed0000", "seed0001", "seed0002", "seed0003"]
    assert all(len(run) == 12 * 4 + 1 for run in dataset)
    assert wt.verify(small_dataset) == []
    assert not np.array_equal(dataset.runs[0].weights[-1], dataset.runs[1].weights[-1])


def one_seed(seed: int = 0) -> Recipe:
    return replace(SMALL_RECIPE, seeds=Seeds(train=[seed]))


@pytest.mark.parametrize("engine", [{}, {"scheduler": "local"}], ids=["processes", "cluster"])
def test_engines_give_the_same_bytes(
    small_dataset: Path, tmp_path: Path, engine: dict[str, str]
) -> None:
    recipe = replace(SMALL_RECIPE, seeds=Seeds(train=[0, 1]))
    dataset = collect(recipe, tmp_path / "dataset", workers=2, **engine)
    for run, same in zip(dataset, wt.open(small_dataset), strict=False):
        assert_same_arrays(run, same)


def assert_same_arrays(run: wt.Run, other: wt.Run) -> None:
    assert set(run.arrays) == set(other.arrays)
    for name in run.arrays:
        assert np.array_equal(run[name][:], other[name][:], equal_nan=True), name


def test_what_a_killed_worker_began_is_finished_by_another(
    small_dataset: Path, tmp_path: Path
) -> None:
    out = tmp_path / "dataset"
    path = out / "runs/seed0001.zarr"
    killed = []

    def kill() -> None:
        deadline = time.monotonic() + 120
        while committed(path) < 8 and time.monotonic() < deadline:
            time.sleep(0.005)
        for process in multiprocessing.active_children():
            process.kill()
            killed.append(committed(path))

    killer = threading.Thread(target=kill)
    killer.start()
    dataset = collect(replace(SMALL_RECIPE, seeds=Seeds(train=[0, 1])), out, workers=2)
    killer.join()
    assert 1 <= len(killed) <= 2
    assert killed[0] < 49
    assert wt.verify(out) == []
    for run, same in zip(dataset, wt.open(small_dataset), strict=False):
        assert_same_arrays(run, same)


def committed(path: Path) -> int:
    """Committed snapshots of a run that another process writes."""
    if not (path / "zarr.json").exists():
        return 0
    attributes = json.loads((path / "zarr.json").read_text())["attributes"]
    return int(attributes["weighttraj"]["n_committed"])


def test_collecting_again_does_nothing(tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    collect(one_seed(), out)
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    screen = io.StringIO()
    collect(one_seed(), out, console=Console(file=screen))
    assert "seed 0: complete, 49 snapshots" in screen.getvalue()
    assert before == {p: p.stat().st_mtime_ns for p in out.rglob("*")}


def test_what_a_collection_took_is_written_down_once(tmp_path: Path) -> None:
    recipe = replace(SMALL_RECIPE, ppo=replace(SMALL_RECIPE.ppo, total_timesteps=64))
    collect(recipe, tmp_path / "costs", seeds=[0])
    collect(recipe, tmp_path / "costs", seeds=[0, 2], workers=2)
    collect(recipe, tmp_path / "costs", seeds=[0, 2])  # there is nothing left to do
    first, second = read_costs(tmp_path / "costs")
    assert (first["seeds"], second["seeds"]) == ([0], [2])
    assert min(first["cpu_s"], second["cpu_s"]) > 0
    collect(recipe, tmp_path / "costs")
    assert wt.verify(tmp_path / "costs") == []  # it is no object of the data set


def test_it_says_for_whom_it_waits(small_dataset: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(small_dataset, tmp_path / "disk/small")
    data.symlink_to(tmp_path / "disk/small")  # one lock, by whatever name
    said = Console(file=io.StringIO(), width=200)
    waiting = threading.Thread(target=collect, args=(SMALL_RECIPE, data), kwargs={"console": said})
    with FileLock(tmp_path / "disk/.small.lock"):
        waiting.start()
        waiting.join(5)
        assert waiting.is_alive()
        assert "waiting for another process" in said.file.getvalue()  # type: ignore[attr-defined]
    waiting.join(60)
    assert not waiting.is_alive()


def test_seeds_can_be_added(tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    collect(one_seed(), out)
    dataset = collect(one_seed(), out, seeds=[7])
    assert [(run.info.seed, run.split) for run in dataset] == [(0, "train"), (7, "")]


def test_a_killed_collector_goes_on_where_it_was(
    small_dataset: Path, recipe_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "dataset"
    command = [sys.executable, "-m", "weighttraj.cli", "collect", str(recipe_file)]
    command += ["--out", str(out), "--seeds", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    path = out / "runs/seed0000.zarr"
    deadline = time.monotonic() + 120
    while committed(path) < 8 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    run = wt.open_run(path)
    whole = wt.open(small_dataset).runs[0]
    assert 8 <= len(run) < 49
    assert wt.verify(path) == []
    assert np.array_equal(run.weights[:], whole.weights[: len(run)])

    again = shell("weighttraj", "collect", recipe_file, "--out", out, "--seeds", 0)
    assert again.returncode == 0, again.stderr
    said = " ".join(again.stdout.split())
    assert f"interrupted after {len(run)} committed snapshots" in said
    assert "continuing after the last" in said
    assert not path.exists()
    run = wt.open_run(path)  # packed meanwhile
    assert run.info.status == "complete"
    assert_same_arrays(run, whole)
    assert wt.verify(path) == []


def test_ctrl_c_stops_every_worker_and_starts_no_other_seed(
    recipe_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "dataset"
    text = TOML.replace("= 768", "= 76_800").replace('"0:2"', '"0:4"').replace("[2, 3]", "[]")
    recipe_file.write_text(text)
    command = [sys.executable, "-m", "weighttraj.cli", "collect", str(recipe_file)]
    command += ["--out", str(out), "--workers", "2"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while len(list(out.glob("runs/*.zarr"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    time.sleep(0.3)
    os.killpg(process.pid, signal.SIGINT)  # an impatient second time
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "give the same command again" in said
    assert "Traceback" not in said
    runs = sorted(out.glob("runs/*.zarr"))
    assert [path.name for path in runs] == ["seed0000.zarr", "seed0001.zarr"]
    assert {wt.open_run(path).info.status for path in runs} == {"crashed"}
    assert wt.verify(out) == []


def test_a_run_that_does_not_repeat_itself_starts_over(small_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "dataset"
    info = wt.open(small_dataset).runs[0].info
    size = info.layout.size
    with (
        pytest.raises(ZeroDivisionError),
        wt.RunWriter(out / "runs/seed0000.zarr", info) as writer,
    ):
        for _ in range(3):  # another machine's numbers
            writer.append(
                np.ones(size, np.float32),
                num_timesteps=0,
                obs_norm=(np.zeros(4), np.ones(4), 1.0),
                ret_norm=(np.array(0.0), np.array(1.0), 1.0),
            )
        raise ZeroDivisionError
    entry = RunEntry(id="seed0000", path="runs/seed0000.zarr", seed=0, split="train")
    info = read_dataset_info(small_dataset)
    write_dataset_info(out, replace(info, runs=(entry,), status="collecting"))
    screen = io.StringIO()
    dataset = collect(one_seed(), out, console=Console(file=screen, width=1000))
    assert "does not repeat its committed snapshots" in screen.getvalue()
    assert "starting over as seed0000-2" in screen.getvalue()
    assert [(run.id, len(run)) for run in dataset] == [("seed0000-2", 49)]
    assert len(wt.open_run(out / "runs/seed0000.zarr")) == 3


def test_a_recipe_without_seeds_collects_nothing(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="nothing to collect"):
        collect(replace(SMALL_RECIPE, seeds=Seeds()), tmp_path / "dataset")
    assert list(tmp_path.iterdir()) == []


def test_impossible_settings_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="impossible values"):
        collect(replace(one_seed(), store=Store(every=10**6)), tmp_path / "dataset")
    assert list(tmp_path.iterdir()) == []


def test_a_worker_that_does_not_see_the_folder_says_so(tmp_path: Path) -> None:
    task = Task(recipe=one_seed(), seed=0, path=tmp_path / "elsewhere/runs/seed0000.zarr")
    with pytest.raises(CollectError, match=r"(?s)does not see the data set.*all machines share"):
        collect_block([task], lambda *_: None)
    assert list(tmp_path.iterdir()) == []


def test_another_recipe_does_not_touch_a_data_set(small_dataset: Path) -> None:
    other = replace(SMALL_RECIPE, ppo=replace(SMALL_RECIPE.ppo, gamma=0.9))
    with pytest.raises(
        CollectError, match=r"(?s)another recipe.*'ppo.gamma': 0.99}.*'ppo.gamma': 0.9}"
    ):
        collect(other, small_dataset)


def test_a_folder_of_something_else_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(CollectError, match=r"thesis\.tex"):
        collect(one_seed(), tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failing_run_leaves_the_others_whole(tmp_path: Path, workers: int) -> None:
    out = tmp_path / "dataset"
    recipe = replace(SMALL_RECIPE, seeds=Seeds(train=[0, 1, 2]))
    collect(replace(recipe, seeds=Seeds(train=[0])), out)
    (out / "runs/seed0001.zarr").mkdir()
    (out / "runs/seed0001.zarr/zarr.json").write_text('{"attributes": {}}')
    with pytest.raises(CollectError, match=r"(?s)1 of 3 runs failed.*seed 1.*run of weighttraj"):
        collect(recipe, out, workers=workers)
    for name in ("seed0000", "seed0002"):
        assert wt.open_run(out / f"runs/{name}.zarr").info.status == "complete"
        assert not (out / f"runs/{name}.zarr").exists()  # packed, listed so, and gone
    assert [entry.path.endswith(".zip") for entry in read_dataset_info(out).runs] == [
        True,
        False,
        True,
    ]


def test_no_workers_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match="workers at least 1"):
        collect(one_seed(), tmp_path / "dataset", workers=0)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_environment_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    recipe = replace(one_seed(), ppo=replace(SMALL, env_id="NoSuchEnv-v0"))
    with pytest.raises(RecipeError, match=r"env_id = 'NoSuchEnv-v0': Environment .* doesn't exist"):
        collect(recipe, tmp_path / "dataset", workers=1)
    assert list(tmp_path.iterdir()) == []


def test_damaged_lines_of_costs_are_left_out_and_links_refused(tmp_path: Path) -> None:
    assert read_costs(tmp_path) == []
    file = tmp_path / ".costs.jsonl"
    file.write_bytes(b'{"seeds": [1]}\n\xff\n' + b"[" * 100_000 + b'\n7\n{"seeds": [2]}\n')
    assert read_costs(tmp_path) == [{"seeds": [1]}, {"seeds": [2]}]
    file.rename(tmp_path / "other")
    file.symlink_to(tmp_path / "other")
    with pytest.raises(FormatError, match="link"):
        read_costs(tmp_path)
