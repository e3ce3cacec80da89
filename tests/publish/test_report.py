"""The page of a data set, made from real short runs."""

from __future__ import annotations

import base64
import io
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import weighttraj as wt
from tests.shell import shell
from tests.small import CONFIGS, learn
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.errors import FormatError, StoreExistsError
from weighttraj.format import Algorithm, EnvInfo
from weighttraj.publish.report import MARK, report

VOID = {"meta", "img", "source", "input", "link", "br", "hr"}


class Page(HTMLParser):
    """Tags and attributes; fails where tags do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, self.getpos()

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def named(self, attribute: str) -> list[str]:
        return [attrs[attribute] for _, attrs in self.tags if attribute in attrs]

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    @property
    def film(self) -> Image.Image:
        sources = [a["src"] for t, a in self.tags if t == "img"]
        return Image.open(io.BytesIO(base64.b64decode(sources[0].partition("base64,")[2])))


@pytest.fixture(scope="module")
def page(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report(small_dataset, tmp_path_factory.mktemp("page") / "report.html")


def plain_run(path: Path, snapshots: int, **info: object) -> Path:
    """A run of any trainer: a random walk of 4 weights."""
    layout = wt.ParamLayout.of({"w": ((4,), "other", ("fixed",))})
    walk = np.random.default_rng(0).standard_normal((snapshots, 4)).cumsum(0)
    with wt.RunWriter(path, wt.RunInfo(run_id="r", layout=layout, **info)) as writer:  # type: ignore[arg-type]
        for t, weights in enumerate(walk):
            writer.append(layout.flatten({"w": weights}), num_timesteps=10 * t)
    return path


def test_the_page_is_one_whole_file(page: Path) -> None:
    parsed = Page(page.read_text())
    ids = parsed.named("id")
    assert len(set(ids)) == len(ids)
    assert not [tag for tag, _ in parsed.tags if tag in ("script", "link", "iframe", "noscript")]
    for address in parsed.named("src") + parsed.named("srcset"):
        assert address.startswith("data:image/webp;base64,")
    inside = [a for a in parsed.named("href") + parsed.named("xlink:href") if a[0] == "#"]
    inside += [f"#{name}" for name in re.findall(r"url\(#([^)]+)\)", page.read_text())]
    assert {address[1:] for address in inside} <= set(ids)
    links = [a["href"] for tag, a in parsed.tags if tag == "a" and a["href"][0] != "#"]
    assert all(link.startswith(("https://arxiv.org/", "https://nips.cc/")) for link in links)
    assert "@import" not in page.read_text()
    assert page.stat().st_size < 3_000_000


def test_the_page_can_be_read_without_seeing_it(page: Path) -> None:
    parsed = Page(page.read_text())
    figures = [attrs for _, attrs in parsed.tags if attrs.get("role") == "img"]
    assert len(figures) == 8  # returns, steps, two of the spectrum, the paths of four runs
    labels = [figure["aria-label"] for figure in figures]
    assert len(set(labels)) == len(labels)
    assert all(len(label) > 30 for label in labels)
    assert all(len(a["alt"]) > 30 for tag, a in parsed.tags if tag == "img")
    headings = [int(tag[1]) for tag, _ in parsed.tags if re.fullmatch(r"h\d", tag)]
    assert headings == [1] + [2] * (len(headings) - 1)


def test_the_page_says_what_there_is(page: Path) -> None:
    text = Page(page.read_text()).text
    assert "PPO on InvertedPendulum-v4: 4 training runs, 196 snapshots" in text
    assert "4 (2 train, 2 test)" in text
    assert "122 in each snapshot" in text
    assert "all snapshots of each run" in text
    for seed in range(4):
        assert f"seed000{seed}" in text


def test_the_film_moves(page: Path) -> None:
    parsed = Page(page.read_text())
    film = parsed.film
    frames = []
    for number in range(film.n_frames):
        film.seek(number)
        frames.append(np.asarray(film.convert("RGB"), np.int16))
    assert len(frames) > 10
    changes = [np.abs(a - b).max() for a, b in zip(frames[1:], frames, strict=False)]
    assert min(changes) > 30  # the clock, at least
    still = next(a["srcset"] for tag, a in parsed.tags if tag == "source")
    assert next(a["media"] for tag, a in parsed.tags if tag == "source").startswith("(prefers-red")
    picture = Image.open(io.BytesIO(base64.b64decode(still.partition("base64,")[2])))
    assert (picture.size, getattr(picture, "n_frames", 1)) == (film.size, 1)


def test_the_same_data_give_the_same_bytes(page: Path, small_dataset: Path, tmp_path: Path) -> None:
    assert report(small_dataset, tmp_path / "again.html").read_bytes() == page.read_bytes()


def test_without_stored_returns_the_page_says_so(page: Path) -> None:
    text = Page(page.read_text()).text
    assert (
        "No returns of single policies are stored here. The figure shows train/ep_rew_mean" in text
    )
    assert "weighttraj returns DATASET" in text


def test_stored_returns_are_shown_by_mode(small_dataset: Path, tmp_path: Path) -> None:
    data = shutil.copytree(small_dataset, tmp_path / "data")
    wt.policies.fill_returns(data, wt.policies.ReturnsConfig(episodes=2, every=8))
    out = report(data, tmp_path / "report.html", film=False)
    parsed = Page(out.read_text())
    labels = [a["aria-label"] for _, a in parsed.tags if a.get("role") == "img"]
    runs = [run.mean_return()[-1] for run in wt.open(data)]
    assert any(
        "deterministic actions" in label and f"{np.median(runs):.3g} after" in label
        for label in labels
    )
    assert any("sampled actions" in label for label in labels)
    assert "No returns are stored" not in parsed.text
    assert "2 episodes of every 8th snapshot, each with its own normaliser" in parsed.text


def test_one_run_on_its_own_whose_environment_cannot_be_drawn(tmp_path: Path) -> None:
    config = CONFIGS["categorical"]
    learn(config, WeightTrajectoryCallback(tmp_path / "run.zarr", every=2))
    out = report(tmp_path / "run.zarr", tmp_path / "deep/er/report.html")
    parsed = Page(out.read_text())
    assert "only MuJoCo environments can be drawn" in parsed.text
    assert "img" not in [tag for tag, _ in parsed.tags]
    assert sum(a.get("role") == "img" for _, a in parsed.tags) == 5


def test_what_the_data_say_is_text_and_nothing_else(tmp_path: Path) -> None:
    attack = "<script>alert(1)</script>"
    env = EnvInfo(id=attack, kwargs={"x": "</pre><img src=x onerror=alert(1)>"})
    algorithm = Algorithm(name='"><b onclick=1>PPO', hyperparameters={attack: "${7*7}{{7*7}}"})
    path = plain_run(tmp_path / "r.zarr", 5, env=env, algorithm=algorithm)
    parsed = Page(report(path, tmp_path / "report.html").read_text())
    assert not {"script", "img", "b"} & {tag for tag, _ in parsed.tags}
    assert not parsed.named("onclick") + parsed.named("onerror")
    assert attack in parsed.text
    assert "{{7*7}}" in parsed.text


@pytest.mark.parametrize("snapshots", [1, 2, 3])
def test_runs_that_have_just_begun(snapshots: int, tmp_path: Path) -> None:
    path = plain_run(tmp_path / "r.zarr", snapshots)
    text = Page(report(path, tmp_path / "report.html").read_text()).text
    assert ("All snapshots have the same weights so far" in text) == (snapshots == 1)
    assert "the run does not say which environment it was trained in" in text


@pytest.mark.parametrize("value", [0, 3])
def test_weights_that_stand_still(value: int, tmp_path: Path) -> None:
    layout = wt.ParamLayout.of({"w": ((3,), "other", ("fixed",))})
    with wt.RunWriter(tmp_path / "r.zarr", wt.RunInfo(run_id="r", layout=layout)) as writer:
        for t in range(4):
            writer.append(layout.flatten({"w": [value] * 3}), num_timesteps=t)
    text = Page(report(tmp_path / "r.zarr", tmp_path / "report.html").read_text()).text
    assert "All snapshots have the same weights so far" in text


def test_only_reports_are_overwritten(tmp_path: Path) -> None:
    path, out = plain_run(tmp_path / "r.zarr", 4), tmp_path / "report.html"
    out.write_text("<!doctype html> notes of mine")
    with pytest.raises(StoreExistsError, match="is no report"):
        report(path, out)
    assert out.read_text() == "<!doctype html> notes of mine"
    with pytest.raises(StoreExistsError):
        report(path, tmp_path)
    first = report(path, out, overwrite=True).read_bytes()
    assert MARK.encode() in first
    out.write_bytes(first + b"<!-- changed -->")
    assert report(path, out).read_bytes() == first
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".report")] == []


def test_a_data_set_without_runs_has_no_report(small_dataset: Path, tmp_path: Path) -> None:
    data = shutil.copytree(small_dataset, tmp_path / "data")
    from weighttraj.store.catalog import read_dataset_info, write_dataset_info

    write_dataset_info(data, replace(read_dataset_info(data), status="collecting"))
    shutil.rmtree(data / "runs")
    with pytest.raises(FormatError, match="nothing to report"):
        report(data, tmp_path / "report.html")
    with pytest.raises(FileNotFoundError):
        report(tmp_path / "nowhere", tmp_path / "report.html")


def test_without_a_simulator_only_the_film_is_missing(tmp_path: Path) -> None:
    path = plain_run(tmp_path / "r.zarr", 5)
    code = f"""
import sys
sys.modules.update(torch=None, gymnasium=None, mujoco=None)
from weighttraj.publish.report import report
report({str(path)!r}, {str(tmp_path / "report.html")!r})
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    parsed = Page((tmp_path / "report.html").read_text())
    assert "pip install -e '.[sb3]'" in parsed.text
    assert len([a for _, a in parsed.tags if a.get("role") == "img"]) == 4


def test_the_command(tmp_path: Path) -> None:
    path, out = plain_run(tmp_path / "r.zarr", 5), tmp_path / "page.html"
    done = shell("weighttraj", "report", path, "--out", out, "--no-film")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith(str(out))
    assert "It was left out." in Page(out.read_text()).text
