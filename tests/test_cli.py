"""The commands as a shell sees them: exit codes, and errors without a traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import weighttraj as wt
from tests.shell import process
from tests.shell import shell as run


@pytest.mark.parametrize(
    "arguments",
    [
        ("weighttraj", "--help"),
        ("weighttraj", "collect", "--help"),
        ("tipl", "train", "tipl", "--help"),
        ("tipl", "evaluate", "--help"),
    ],
)
def test_help_teaches(arguments: tuple[str, ...]) -> None:
    done = run(*arguments)
    assert done.returncode == 0
    assert "usage" in done.stdout
    assert len(done.stdout) > 300


def test_show_and_verify(small_dataset: Path) -> None:
    assert "4 runs" in run("weighttraj", "show", small_dataset).stdout
    shown = run("weighttraj", "show", small_dataset / "runs/seed0000.zarr.zip").stdout
    assert "<policy/weights float32 {'time': 49, 'param': 122}>" in shown
    done = run("weighttraj", "verify", small_dataset)
    assert (done.returncode, done.stdout.strip()) == (0, f"{small_dataset}: whole")


def test_verify_fails_on_damage(tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    with wt.RunWriter(tmp_path / "r.zarr", wt.RunInfo(run_id="r", layout=layout)) as writer:
        writer.append(layout.flatten({"w": [1, 2, 3]}), num_timesteps=0)
    (tmp_path / "r.zarr/policy/weights/c/0/0").unlink()
    done = process("weighttraj", "verify", tmp_path / "r.zarr")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "policy/weights/c/0/0: missing" in done.stdout
    assert "expected: the object policy/weights/c/0/0" in done.stdout


def test_a_data_set_goes_out_and_comes_back(small_dataset: Path, tmp_path: Path) -> None:
    file = tmp_path / "small.h5"
    assert run("weighttraj", "export", small_dataset, "--to", "hdf5", "--out", file).returncode == 0
    assert "4 runs" in run("weighttraj", "show", file).stdout
    assert run("weighttraj", "import", file, "--out", tmp_path / "back").returncode == 0
    done = run("weighttraj", "verify", tmp_path / "back", "--deep", "--replay", 5)
    assert done.stdout.strip().endswith("back: whole")
    assert "nothing suspicious" in run("weighttraj", "lint", tmp_path / "back").stdout


def test_repair_mends_and_cuts(tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    with wt.RunWriter(
        tmp_path / "r.zarr", wt.RunInfo(run_id="r", layout=layout, block=2)
    ) as writer:
        for t in range(5):
            writer.append(layout.flatten({"w": [t, 2, 3]}), num_timesteps=t)
    (tmp_path / "r.zarr/policy/weights/c/1/0").write_bytes(b"")
    (tmp_path / "r.zarr/index/phase/zarr.json").unlink()
    done = run("weighttraj", "repair", tmp_path / "r.zarr")
    assert done.returncode == 1
    assert "mended" in done.stdout
    assert "damaged after row 2 of 5; --cut drops what follows" in " ".join(done.stdout.split())
    done = run("weighttraj", "repair", tmp_path / "r.zarr", "--cut")
    assert done.returncode == 0
    assert len(wt.open_run(tmp_path / "r.zarr")) == 2


@pytest.mark.parametrize("to", ["safetensors", "sb3"])
def test_a_snapshot_that_is_not_there_is_one_message(
    to: str, small_dataset: Path, tmp_path: Path
) -> None:
    run_path, out = small_dataset / "runs/seed0000.zarr.zip", tmp_path / "out"
    done = run("weighttraj", "export", run_path, "--to", to, "--t", 99_999, "--out", out)
    assert done.returncode == 1
    assert done.stderr.startswith("error: there are no such rows")
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_pack_and_cache(small_dataset: Path, tmp_path: Path) -> None:
    source = small_dataset / "runs/seed0000.zarr.zip"
    out = tmp_path / "small.zarr.zip"
    done = run("weighttraj", "pack", source, "--profile", "archive", "--out", out)
    assert done.stdout.strip() == str(out)
    assert wt.open_run(out).info.profile == "archive"
    assert "MB" in run("weighttraj", "cache").stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("weighttraj", "show", "nowhere"), "no data set or run at nowhere"),
        (("weighttraj", "collect", "nowhere.toml"), "nowhere.toml"),
        (("weighttraj", "report"), "name a data set"),
        (
            ("tipl", "train", "tipl", "--data", "nowhere", "--out", "x"),
            "no data set or run at nowhere",
        ),
    ],
)
def test_errors_are_one_message(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run(*arguments)
    assert done.returncode in (1, 2)
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_a_misspelt_option_is_answered_with_the_right_one() -> None:
    done = process("tipl", "train", "tipl", "--data", "a", "--out", "b", "--n-batchs", "3")
    assert done.returncode == 2
    assert "--n-batches" in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "unbuffered"),
    [
        (("weighttraj", "show"), ""),  # few bytes, which wait in a buffer to the end
        (("weighttraj", "show"), "1"),
        (("weighttraj", "list"), ""),  # printed by Rich
        (("tipl", "--help"), "1"),
    ],
)
def test_a_reader_that_has_seen_enough_is_no_error(
    arguments: tuple[str, ...], unbuffered: str, small_dataset: Path
) -> None:
    program, *rest = arguments
    if rest == ["show"]:
        rest.append(str(small_dataset))
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", f"{program}.cli", *rest],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_module_is_a_command_too() -> None:
    command = [sys.executable, "-m", "weighttraj", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"weighttraj {wt.__version__}\n")


def test_own_runs_become_a_data_set(small_dataset: Path, tmp_path: Path) -> None:
    runs = sorted((small_dataset / "runs").glob("*.zip"))[:2]
    more = ("--split", "seed0000=train", "seed0001=test", "--version", "3", "--licence", "CC0-1.0")
    done = run("weighttraj", "create", tmp_path / "mine", *runs, *more)
    assert done.returncode == 0, done.stderr
    made = wt.open(tmp_path / "mine")
    assert [(r.id, r.split) for r in made] == [("seed0000", "train"), ("seed0001", "test")]
    assert (made.info.id, made.info.version, made.info.licence) == ("mine", "3", "CC0-1.0")
    done = run("weighttraj", "upload", runs[0], f"file://{tmp_path}/there")
    assert done.returncode == 1
    assert "weighttraj create OUT" in done.stderr
