"""MuJoCo's bodies as flat shapes, without OpenGL: machines without a display have none.

Each geom is drawn as the silhouette of its projection along one axis of the world, which for the
shapes of locomotion and control is what one sees from afar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float64
from PIL import Image, ImageDraw

PANEL = (34, 42, 53)
GROUND = (50, 60, 74)
GRID = (46, 55, 68)
GRID_TEXT = (120, 134, 152)

SCALE = 2
"""Pixels that are drawn for each one that is shown, in both directions: smooth edges."""

_CIRCLE = np.linspace(0, 2 * np.pi, 28, endpoint=False)
_RING = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=1)
_SPACINGS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
_MOST_VISIBLE_GROUP = 2  # MuJoCo hides the others too
_OUTLINE = 0.45
_BELOW = 24  # pixels below the floor, for distances
_KINDS = mujoco.mjtGeom

Color = tuple[int, int, int]
Points = Float64[np.ndarray, "point 2"]


@dataclass(frozen=True, kw_only=True)
class View:
    """From where a model is looked at: from the side (x to the right, z up) or from above."""

    across: tuple[int, int]
    """Axes of the world that are to the right and up."""
    follow: bool
    """Whether the camera goes where the model goes; else it stands still."""
    body: int
    """What it follows."""
    floor: float | None
    """Height of the floor, in m, seen from the side; None: there is none, or it is all around."""

    @property
    def top(self) -> bool:
        """Whether it is from above."""
        return self.across == (0, 1)


@dataclass(frozen=True, kw_only=True)
class Shape:
    """The silhouette of a geom."""

    points: Points
    """Corners of a convex polygon, m."""
    depth: float
    """Distance towards the eye, m."""
    color: Color
    """Of its inside."""


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Where the geoms of a model are at one time."""

    places: Float64[np.ndarray, "geom 3"]
    """Centres in the world, m."""
    turns: Float64[np.ndarray, "geom 3 3"]
    """Rotations to the world."""
    focus: Float64[np.ndarray, " 3"]
    """Centre of mass of the body that a view follows, m."""


@dataclass(frozen=True, kw_only=True)
class Pose:
    """What is seen of a model at one time."""

    shapes: list[Shape]
    """From the farthest to the nearest."""
    focus: Float64[np.ndarray, " 2"]
    """Place that the camera follows, m; zero where it stands still."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """How metres become pixels."""

    center: Float64[np.ndarray, " 2"]
    """Place in the middle of the picture, m, relative to the focus."""
    scale: float
    """Pixels for each metre."""
    size: tuple[int, int]
    """Width and height of the picture in pixels."""

    def pixels(self, points: Points, focus: Float64[np.ndarray, " 2"]) -> Points:
        """Places in the picture; y counts from its top."""
        width, height = self.size
        at = (points - focus - self.center) * self.scale
        flipped: np.ndarray = at * [1, -1] + [width / 2, height / 2]
        return flipped


def view_of(model: Any) -> View:
    """The view at which most is seen: from above if everything turns about z, else the side."""
    kinds, axes = model.jnt_type, model.jnt_axis
    turns = axes[kinds == mujoco.mjtJoint.mjJNT_HINGE]
    free = model.njnt > 0 and kinds[0] == mujoco.mjtJoint.mjJNT_FREE
    slides = model.njnt > 0 and kinds[0] == mujoco.mjtJoint.mjJNT_SLIDE
    top = not free and len(turns) > 0 and bool((np.abs(turns[:, 2]) > 0.99).all())
    planes = np.flatnonzero(model.geom_type == _KINDS.mjGEOM_PLANE)
    return View(
        across=(0, 1) if top else (0, 2),
        follow=bool(free or (slides and not model.jnt_limited[0])),
        body=int(model.jnt_bodyid[0]) if model.njnt else 0,
        floor=float(model.geom_pos[planes[0], 2]) if len(planes) and not top else None,
    )


def placement_of(data: Any, view: View) -> Placement:
    """Return a copy of what the simulation says now."""
    return Placement(
        places=data.geom_xpos.copy(),
        turns=data.geom_xmat.reshape(-1, 3, 3).copy(),
        focus=data.subtree_com[view.body].copy(),
    )


def pose_of(model: Any, placement: Placement, view: View) -> Pose:
    """Silhouettes of all visible geoms; planes, meshes and height fields have none."""
    away = 3 - sum(view.across)
    shapes = []
    for geom in range(model.ngeom):
        rgba = model.geom_rgba[geom]
        points = _surface(model, placement, geom, view)
        if points is not None and rgba[3] > 0 and model.geom_group[geom] <= _MOST_VISIBLE_GROUP:
            # From the side one looks along +y, from above along -z.
            towards = placement.places[geom, away] * (1 if view.top else -1)
            still = bool(model.geom_bodyid[geom] == 0)
            depth = -np.inf if still else float(towards)
            shapes.append(Shape(points=hull(points), depth=depth, color=_color(rgba, still=still)))
    focus = np.zeros(2)
    if view.follow:
        focus = placement.focus[list(view.across)] * ([1, 1] if view.top else [1, 0])
    return Pose(shapes=sorted(shapes, key=lambda s: s.depth), focus=focus)


def camera_for(poses: Sequence[Pose], view: View, size: tuple[int, int], top: int) -> Camera:
    """Return a camera that keeps nearly all of what happens in the picture.

    Args:
        poses: at least one.
        view: of all of them.
        size: width and height of the picture in pixels.
        top: pixels at its upper edge that stay free.
    """
    lows, highs = [], []
    for pose in poses:
        points = np.concatenate([s.points for s in pose.shapes] or [np.zeros((1, 2))]) - pose.focus
        lows.append(points.min(0))
        highs.append(points.max(0))
    low, high = np.quantile(lows, 0.02, axis=0), np.quantile(highs, 0.98, axis=0)
    if view.floor is not None and view.follow:
        low[1] = view.floor
    if view.follow:
        low[0], high[0] = -max(-low[0], high[0]), max(-low[0], high[0])
    below = _BELOW if view.follow and not view.top else 0
    width, height = size[0] * 0.92, (size[1] - top - below) * 0.92
    scale = float(min(width / max(high[0] - low[0], 0.1), height / max(high[1] - low[1], 0.1)))
    center = (low + high) / 2 + [0, (top - below) / 2 / scale]
    return Camera(center=center, scale=scale, size=size)


def draw(pose: Pose, view: View, camera: Camera, font: Any) -> Image.Image:
    """Draw the scene at the camera's size.

    Args:
        pose: what is seen.
        view: from where.
        camera: how large.
        font: of the distances, at ``SCALE`` times its size; None: none are written.
    """
    width, height = (SCALE * n for n in camera.size)
    image = Image.new("RGB", (width, height), PANEL)
    pencil = ImageDraw.Draw(image)
    _draw_grid(pencil, pose, view, camera, font)
    for shape in pose.shapes:
        corners = camera.pixels(shape.points, pose.focus) * SCALE
        edge = tuple(int(c * _OUTLINE) for c in shape.color)
        pencil.polygon([tuple(p) for p in corners], fill=shape.color, outline=edge, width=SCALE + 1)
    return image.reduce(SCALE)


def hull(points: Points) -> Float64[np.ndarray, "corner 2"]:
    """Return corners of the convex hull, in order (Andrew's monotone chain)."""
    ordered = sorted({(x, y) for x, y in points.round(9).tolist()})
    if len(ordered) < 3:
        return np.array(ordered)

    def chain(way: list[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for x, y in way:
            while len(kept) > 1:
                (ax, ay), (bx, by) = kept[-2:]
                if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                    break
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def _surface(model: Any, placement: Placement, geom: int, view: View) -> Points | None:
    """Return points of the picture whose hull is the silhouette; None: the geom has none."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    across = list(view.across)
    place, turned = placement.places[geom][across], placement.turns[geom][across]
    if kind == _KINDS.mjGEOM_SPHERE:
        return np.asarray(place + size[0] * _RING)
    if kind == _KINDS.mjGEOM_CAPSULE:
        half = turned[:, 2] * size[1]
        return np.concatenate([place + half + size[0] * _RING, place - half + size[0] * _RING])
    if kind == _KINDS.mjGEOM_CYLINDER:
        half, rim = turned[:, 2] * size[1], size[0] * _RING @ turned[:, :2].T
        return np.concatenate([place + half + rim, place - half + rim])
    if kind == _KINDS.mjGEOM_BOX:
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8) * size[:, None]
        return np.asarray(place + (turned @ corners).T)
    if kind == _KINDS.mjGEOM_ELLIPSOID:
        return np.asarray(place + _ellipse(turned * size))
    return None


def _ellipse(axes: Float64[np.ndarray, "2 3"]) -> Points:
    """Outline of a projected ellipsoid: where a direction of the picture is farthest."""
    reach = _RING @ axes  # (point, 3)
    return np.asarray((reach / np.linalg.norm(reach, axis=1, keepdims=True)) @ axes.T)


def _color(rgba: Any, *, still: bool) -> Color:
    """Return the model's colour, a little brighter; what cannot move is muted."""
    red, green, blue = (0.25 + 0.75 * float(c) for c in rgba[:3])
    if still:
        grey = (red + green + blue) / 3
        red, green, blue = (0.45 * grey + 0.25 * c for c in (red, green, blue))
    return (int(255 * red), int(255 * green), int(255 * blue))


def _draw_grid(pencil: Any, pose: Pose, view: View, camera: Camera, font: Any) -> None:
    """Lines at round distances: what the background of a moving camera moves by."""
    width, height = (SCALE * n for n in camera.size)
    spacing = next((s for s in _SPACINGS if s * camera.scale >= 44), _SPACINGS[-1])
    middle = pose.focus + camera.center
    reach = np.array(camera.size) / camera.scale / 2
    floor = height + 1.0
    if view.floor is not None:
        floor = float(camera.pixels(np.array([[0, view.floor]]), pose.focus)[0, 1]) * SCALE
    for axis in (0, 1) if view.top else (0,):
        first, last = ((middle[axis] + way * reach[axis]) / spacing for way in (-1, 1))
        for number in range(int(np.ceil(first)), int(np.floor(last)) + 1):
            at = np.zeros((1, 2))
            at[0, axis] = number * spacing
            place = float(camera.pixels(at, pose.focus)[0, axis]) * SCALE
            line = [(place, 0), (place, height)] if axis == 0 else [(0, place), (width, place)]
            pencil.line(line, fill=GRID, width=SCALE)
    if floor < height:
        pencil.rectangle([(0, floor), (width, height)], fill=GROUND)
    if font is not None and view.follow and not view.top:
        _draw_distances(pencil, pose, camera, spacing, floor, font)


def _draw_distances(
    pencil: Any, pose: Pose, camera: Camera, spacing: float, floor: float, font: Any
) -> None:
    """Metres from the origin, below the floor."""
    reach = camera.size[0] / camera.scale / 2
    x = pose.focus[0] + camera.center[0]
    step = spacing * max(1, int(np.ceil(70 / (spacing * camera.scale))))
    for number in range(int(np.ceil((x - reach) / step)), int(np.floor((x + reach) / step)) + 1):
        place = float(camera.pixels(np.array([[number * step, 0.0]]), pose.focus)[0, 0]) * SCALE
        pencil.line([(place, floor), (place, floor + 5 * SCALE)], fill=GRID_TEXT, width=SCALE)
        text = f"{number * step:g} m".replace("-", "\u2212")
        half = font.getlength(text) / 2
        if half <= place <= SCALE * camera.size[0] - half:
            pencil.text((place, floor + 4 * SCALE), text, fill=GRID_TEXT, font=font, anchor="ma")
