"""Pages whose figures come from result files say what the files say."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import torch

import tipl
import weighttraj as wt
from tests.pages import QUICKER, blocks, run_command, run_page
from tipl.live.results import read_live
from tipl.report.live import render
from tipl.report.markdown import places, rewrite

DOCS = Path(__file__).parents[1] / "docs"
STUDIES = Path(__file__).parents[1] / "docs/studies"


@pytest.mark.parametrize("name", sorted(path.stem for path in STUDIES.glob("*.md")))
def test_the_page_says_what_was_measured(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(STUDIES))
    study = importlib.import_module(name)
    page = study.STUDY.page.read_text()
    assert study.STUDY.insert(page) == page, f"the page is stale: run python docs/studies/{name}.py"
    stale = page.replace("|---|", "|---:|")
    assert study.STUDY.insert(stale) == page != stale


GUIDES = (
    "install quickstart glossary read collect train evaluate jump-ahead publish bring-your-own "
    "supported clusters design"
)


@pytest.mark.parametrize("name", [*GUIDES.split(), "../weighttraj/format/FORMAT"])
def test_a_guide_begins_with_what_its_reader_can_do(name: str) -> None:
    _, first, *_ = (DOCS / f"{name}.md").read_text().split("\n\n")
    assert first.startswith("After this page you ")


def test_install(reader: Path) -> None:
    run_page(DOCS / "install.md", skip=("pip install", "make "))
    assert (reader / ".local/share/bash-completion/completions/tipl").stat().st_size > 1000


def test_quickstart(reader: Path) -> None:
    shorter = {
        "--n-batches 200 --warmup": "--n-batches 4 --warmup",
        "--episodes 5": "--episodes 1",
        "--quick --horizons 1 10 50 --return-horizons 10 50 --starts 100 --workers 2": (
            f"{QUICKER} --horizons 1 10 --return-horizons 10"
        ),
        "tipl-inverted-pendulum-v4 tipl-gate": "tipl-gate",  # the README's test evaluates both
    }
    names = run_page(DOCS / "quickstart.md", shorter)
    assert names["after"] > names["before"] + 100
    assert Path("data/demo/report/report.html").exists()


def test_bring_your_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page(DOCS / "bring-your-own.md")
    for path in tmp_path.glob("data/mine/*.zarr"):
        assert wt.verify(path) == []
    made = wt.open("data/mine/all")
    assert {run.id: (run.split, len(run)) for run in made} == {
        "cartpole": ("train", 33),
        "pendulum": ("", 18),
        "checkpoints": ("test", 4),
    }
    run = made["cartpole"]
    assert run.phase.tolist() == [-1, *[0, 1, 2, 3] * 8]
    assert run["index/epoch"][:].tolist() == [-1, *[1, 2, 3, 4] * 8]
    before, after = names["returns"].returns.mean(1)
    assert after > before


@pytest.mark.filterwarnings("ignore:Numcodecs codecs:zarr.errors.ZarrUserWarning")
def test_read(reader: Path) -> None:
    run_page(DOCS / "index.md")
    names = run_page(DOCS / "read.md")
    assert names["weights"].shape == (122, 1951)
    assert names["batch"]["weights"].shape == (28, 122)  # the last one of an epoch
    assert torch.isfinite(names["error"]).all()
    assert len(wt.open("data/demo/divided.h5")) == 5


def test_collect(reader: Path) -> None:
    run_page(DOCS / "collect.md", {"--episodes 5": "--episodes 1"})
    assert len(wt.open("data/both")) == 7
    assert wt.verify("data/both") == []


@pytest.mark.parametrize("skip", [("torchrun",), pytest.param((), marks=pytest.mark.long)])
def test_train(
    reader: Path, brief_released: Path, monkeypatch: pytest.MonkeyPatch, skip: tuple[str, ...]
) -> None:
    """Two ranks of `torchrun` train in tests/tipl/test_distributed.py as well."""
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(brief_released.parent))
    shorter = {
        "--n-batches 200 --warmup": "--n-batches 4 --warmup",
        "--out data/demo/tipl-2 --n-batches 100": "--out data/demo/tipl-2 --n-batches 4",
        "--starts 100 --n-batches 100": "--starts 10 --n-batches 4",
        "--starts 100 --n-batches 400": "--starts 10 --n-batches 4",
        "n_batches=50": "n_batches=4",
        "--steps 500": "--steps 4",
    }
    run_page(DOCS / "train.md", shorter, skip)
    made = {"tipl", "tipl-python", "tipl-gate", "tipl-drift", "tipl-causal"}
    for name in made if skip else made | {"tipl-2"}:
        assert tipl.load(f"data/demo/{name}").name == name


def test_clusters_by_hand(reader: Path) -> None:
    """But for SLURM, which would have to be installed."""
    (_, text), *_ = blocks(DOCS / "clusters.md")
    recipe = reader / "datasets/demo/recipe.toml"
    recipe.write_text(recipe.read_text().replace("= 768", "= 128"))
    for long, short in {
        "inverted-pendulum-v4-ppo-v1": "demo",
        "--nworkers 8": "--nworkers 1",
    }.items():
        assert long in text
        text = text.replace(long, short)
    scheduler, worker, collect = (line.partition("#")[0] for line in text.splitlines())
    with ExitStack() as stack:
        begun = stack.enter_context(background(f"{scheduler} --host 127.0.0.1 --port 0"))
        assert begun.stderr is not None
        address = next(filter(None, (re.search(r"tcp://[\d.:]+", line) for line in begun.stderr)))[
            0
        ]
        stack.enter_context(background(worker.replace("tcp://host:8786", address)))
        run_command(f"{collect.replace('tcp://host:8786', address)} --out data/clusters")
    assert wt.verify("data/clusters") == []


@contextmanager
def background(command: str) -> Iterator[subprocess.Popen[str]]:
    """A server, for a while."""
    program, *arguments = shlex.split(command)
    path = Path(sys.executable).with_name(program)
    with subprocess.Popen([path, *arguments], stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()


def test_evaluate(reader: Path, brief_released: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(brief_released.parent))
    names = run_page(DOCS / "evaluate.md", {"--quick": QUICKER, "--episodes 5": "--episodes 1"})
    assert names["after"] > names["before"] + 100
    assert "half-step" in names["results"].forecasters
    board = Path("data/demo/leaderboard/leaderboard.md").read_text()
    assert "| theirs | 1 | " in board
    assert "| relex-50 | 2 | " in board


def test_live(reader: Path) -> None:
    names = run_page(DOCS / "jump-ahead.md", {"16 * 2048": "2 * 2048", "first=3": "first=1"})
    assert [jump.iteration for jump in names["callback"].jumps] == [1]
    results = read_live(reader / "data/demo/study/test/results.json")
    assert {one.arm: len(one.curves) for one in results.series} == {
        "ppo": 3,
        "outer-step": 3,
        "ema": 3,
    }


@pytest.mark.parametrize("page", ["docs/live.md", "docs/live-tables.md", "README.md"])
def test_the_study_of_trainings_says_what_was_measured(
    page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(DOCS.parent)
    text = Path(page).read_text()
    sources = {place.source for place in places(text) if place.source.startswith("docs/studies")}
    assert sources
    for source in sources:
        folder = os.path.relpath(Path(source).parent, Path(page).parent)
        results = read_live(Path(source))
        again = rewrite(
            text,
            "live",
            source,
            lambda part: render(results, Path(source), folder, part),  # noqa: B023
        )
        assert again == text, f"the page is stale: run tipl report {source} --into {page}"


def test_the_example_shows_both_curves(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = (DOCS.parent / "examples/jump_ahead.py").read_text()
    for long, short in {"16 * 2048": "2 * 2048", "first=3": "first=1"}.items():
        assert long in script
        script = script.replace(long, short)
    exec(compile(script, "jump_ahead.py", "exec"), {})  # noqa: S102
    shown = capsys.readouterr().out
    assert shown.count("episode_reward=") == 4
    assert "after iteration 1: 20 snapshots ahead, accepted" in shown


def test_the_page_of_what_is_supported_says_what_was_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(DOCS))
    supported = importlib.import_module("supported")
    results, page = json.loads(supported.FILE.read_text()), supported.PAGE.read_text()
    assert supported.insert(page, results) == page, "stale: run docs/supported.py --render"
    assert {title: list(rows) for title, rows in results["rows"].items()} == {
        title: list(rows) for title, rows in supported.ROWS.items()
    }
    results["rows"]["Policies (PPO, Pendulum)"]["tanh"]["recorded"] = "no: for this test"
    assert "for this test" in supported.insert(page, results)


@pytest.mark.parametrize("name", ["PPO", "RecurrentPPO"])
def test_a_row_of_what_is_supported_comes_out_the_same_again(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(DOCS))
    supported = importlib.import_module("supported")
    title = next(iter(supported.ROWS))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        row = supported.attempt(supported.ROWS[title][name])
    assert row == json.loads(supported.FILE.read_text())["rows"][title][name]
