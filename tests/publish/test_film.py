"""Films: pictures of real MuJoCo models, and the moments that they show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from PIL import Image, ImageFont

import weighttraj as wt
from weighttraj import environments
from weighttraj.publish import film as films
from weighttraj.publish.episodes import Stage, moments
from weighttraj.publish.scene import Pose, camera_for, draw, hull, placement_of, pose_of, view_of

NAMES = {
    "InvertedPendulum": ("side", False),
    "InvertedDoublePendulum": ("side", False),
    "HalfCheetah": ("side", True),
    "Hopper": ("side", True),
    "Walker2d": ("side", True),
    "Swimmer": ("top", True),
    "Reacher": ("top", False),
}
SIZE = (240, 160)


@pytest.fixture(scope="module")
def run(small_dataset: Path) -> wt.Run:
    return wt.open(small_dataset).runs[0]


@pytest.mark.parametrize("version", ["v4", "v5"])
@pytest.mark.parametrize("name", NAMES)
def test_every_environment_gives_a_picture(name: str, version: str) -> None:
    env = environments.make(f"{name}-{version}")
    env.reset(seed=0)
    inner: Any = env.unwrapped
    view = view_of(inner.model)
    assert ("top" if view.top else "side", view.follow) == NAMES[name]
    poses = []
    for _ in range(5):
        env.step(env.action_space.sample())
        poses.append(pose_of(inner.model, placement_of(inner.data, view), view))
    env.close()
    camera = camera_for(poses, view, SIZE, 20)
    image = np.asarray(draw(poses[0], view, camera, ImageFont.load_default(20)), np.int16)
    empty = draw(Pose(shapes=[], focus=poses[0].focus), view, camera, ImageFont.load_default(20))
    shown = (np.abs(image - np.asarray(empty, np.int16)).max(2) > 40).mean()
    assert 0.005 < shown < 0.6
    assert len(poses[0].shapes) == sum(inner.model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    inside = [camera.pixels(s.points, poses[0].focus) for s in poses[0].shapes]
    assert np.concatenate(inside).min() > -5


SHAPES = """
<mujoco><worldbody><body><freejoint/>
  <geom type="box" size=".1 .2 .3"/> <geom type="sphere" size=".4"/>
  <geom type="cylinder" size=".1 .5"/> <geom type="ellipsoid" size=".1 .2 .6"/>
  <geom type="capsule" size=".1 .3" euler="0 90 0"/>
  <geom type="sphere" size="9" rgba="1 0 0 0"/> <geom type="sphere" size="9" group="3"/>
</body></worldbody></mujoco>
"""


def test_silhouettes_have_the_size_of_their_geoms() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = view_of(model)
    pose = pose_of(model, placement_of(data, view), view)
    reach = [tuple(shape.points.max(0).round(2)) for shape in pose.shapes]
    assert reach == [(0.1, 0.3), (0.4, 0.4), (0.1, 0.5), (0.1, 0.6), (0.4, 0.1)]


def test_the_hull_is_convex_and_ordered() -> None:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5], [0.5, 0.0]])
    assert hull(square).tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]
    assert hull(square[:1]).tolist() == [[0, 0]]


def test_moments_are_where_the_return_rises() -> None:
    t = np.arange(0, 110, 10)
    values = np.array([0, 0, 10, 26, 40, 51, 60, 80, 90, 100, 70.0])
    assert moments(t, values) == (0, 30, 50, 70, 90)
    values[7] = np.nan
    assert moments(t, values) == (0, 30, 50, 80, 90)


def test_moments_are_five_even_if_all_is_learnt_at_once() -> None:
    t = np.arange(100)
    for values in (np.where(t < 40, 0.0, 1.0), np.full(100, np.nan), np.zeros(100)):
        found = moments(t, values)
        assert len(found) == 5
        assert found[0] == 0
    assert moments(np.arange(2), np.zeros(2)) == (0, 1)


def test_an_episode_is_the_evaluators(run: wt.Run) -> None:
    stage = Stage(run)
    episode = stage.play(run, -1, seed=3, shown=5)
    stage.close()
    expected = wt.policies.evaluate(run.load_policy(-1), run, episodes=1, seed=3)
    assert episode.rewards.sum() == expected.returns[0]
    assert len(episode.rewards) == expected.lengths[0]
    assert len(episode.placements) == 6
    assert episode.terminated


def test_short_episodes_are_shown_slowly() -> None:
    slow = films._timing(10, 0.04)
    assert slow.slow == 5
    assert slow.frames >= 10
    real = films._timing(1000, 0.05)
    assert (real.slow, real.stride) == (1, 1)
    assert real.frames * real.milliseconds == pytest.approx(6000, rel=0.05)


def test_a_film_stays_small(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (5, 60, 60, 3), dtype=np.uint8)
    frames = [Image.fromarray(frame) for frame in noise]
    best = films._encode(frames, 50)
    monkeypatch.setattr(films, "MAX_BYTES", len(best) - 1)
    assert len(films._encode(frames, 50)) < len(best)
