"""A short film of the policy at some moments of training, as one animated WebP."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from weighttraj.publish.curves import Curve
from weighttraj.publish.episodes import Episode, Moments, Stage, choose
from weighttraj.publish.scene import PANEL, SCALE, Pose, camera_for, draw
from weighttraj.publish.source import number
from weighttraj.publish.svg import short
from weighttraj.run import Run

SECONDS = 6.0
"""Length of the film."""

MAX_BYTES = 1_500_000
"""Size of the film; a larger one is made again at a lower quality."""

STAGES = 3
"""Choose the moments, play, draw."""

_SIZE = (344, 236)  # of a panel; two of them side by side are legible on a telephone
_CAPTION = 52
_GAP = 6
_BACK = (22, 27, 34)
_TEXT, _SOFT, _ACCENT = (232, 237, 243), (158, 171, 187), (232, 165, 60)
_INTERVAL = 0.06  # seconds from one frame to the next, about
_SHORTEST, _SLOWEST = 3.0, 5.0
_QUALITIES = (80, 60, 40, 20, 5)


@dataclass(frozen=True, kw_only=True)
class Film:
    """The film and what there is to say of it."""

    run: str
    """Id of the run."""
    episodes: list[Episode]
    """The panels, in their order; each shows the beginning of an episode."""
    moments: Moments
    """How they were chosen."""
    seed: int
    """Of the first state of each episode."""
    slow: float
    """How many times slower than the simulation it plays."""
    animation: bytes
    """WebP, plays in a loop."""
    still: bytes
    """WebP of one frame."""
    size: tuple[int, int]
    """Width and height in pixels."""


@dataclass(frozen=True, kw_only=True)
class _Timing:
    stride: int
    """Environment steps from one frame to the next."""
    frames: int
    milliseconds: int
    """Time from one frame to the next."""
    slow: float
    """How many times slower than the simulation that is."""


def film(run: Run, *, seed: int = 0, advance: Callable[[], None] = lambda: None) -> Film:
    """Play and draw the episodes.

    Args:
        run: with at least one snapshot.
        seed: of the first state of each episode.
        advance: called after each of ``STAGES`` stages.

    Raises:
        CollectError: the environment cannot be made here.
        PolicyError: the policy cannot be rebuilt, or the environment is not MuJoCo's.
    """
    stage = Stage(run)
    shown = math.ceil(SECONDS / stage.dt)
    episodes = []
    try:
        chosen = choose(run, seed)
        advance()
        for t in chosen.snapshots:
            episodes.append(stage.play(run, t, seed=seed, shown=shown))
    finally:
        stage.close()
    advance()
    timing = _timing(max(len(e.placements) - 1 for e in episodes), stage.dt)
    frames = _frames(stage, chosen, episodes, timing)
    advance()
    return Film(
        run=run.id,
        episodes=episodes,
        moments=chosen,
        seed=seed,
        slow=timing.slow,
        animation=_encode(frames, timing.milliseconds),
        still=_encode(frames[len(frames) // 3 : len(frames) // 3 + 1], 0),
        size=frames[0].size,
    )


def _timing(steps: int, dt: float) -> _Timing:
    """Real time, if the longest episode lasts some seconds; slower if all end at once."""
    slow = float(np.clip(_SHORTEST / max(steps * dt, 1e-9), 1, _SLOWEST))
    slow = slow if slow > 1.25 else 1.0
    stride = max(1, round(_INTERVAL / (dt * slow)))
    frames = min(math.ceil(steps / stride), int(SECONDS / (stride * dt * slow))) + 1
    milliseconds = max(20, round(1000 * stride * dt * slow))
    return _Timing(stride=stride, frames=max(frames, 2), milliseconds=milliseconds, slow=slow)


def _frames(
    stage: Stage, chosen: Moments, episodes: list[Episode], timing: _Timing
) -> list[Image.Image]:
    fonts = {n: _font(n) for n in (14, 16, 19)} | {0: _font(13 * SCALE)}
    poses = [_poses(stage, episode, timing) for episode in episodes]
    camera = camera_for([p for some in poses for p in some], stage.view, _SIZE, _CAPTION)
    legend = _legend(chosen.curve, episodes, fonts)
    ended: dict[int, Image.Image] = {}  # panels that move no more
    frames = []
    for frame in range(timing.frames):
        step = frame * timing.stride
        cells = []
        for i, episode in enumerate(episodes):
            if i not in ended:
                pose = poses[i][min(frame, len(poses[i]) - 1)]
                cell = _panel(i, episode, step, draw(pose, stage.view, camera, fonts[0]), fonts)
                if step >= len(episode.rewards):
                    ended[i] = cell
            cells.append(ended.get(i, cell))
        frames.append(_mosaic([*cells, _clock(legend, step * stage.dt, frame, timing, fonts)]))
    return frames


def _poses(stage: Stage, episode: Episode, timing: _Timing) -> list[Pose]:
    """Return what is seen in each frame, to the end of the episode, and there."""
    places = episode.placements[:: timing.stride]
    if len(episode.placements) > len(episode.rewards):  # all of it is shown
        places.append(episode.placements[-1])
    return [stage.pose(place) for place in places]


def _mosaic(cells: list[Image.Image]) -> Image.Image:
    """Two columns."""
    width, height = _SIZE
    rows = -(-len(cells) // 2)
    size = (2 * width + 3 * _GAP, rows * height + (rows + 1) * _GAP)
    picture = Image.new("RGB", size, _BACK)
    for i, cell in enumerate(cells):
        row, column = divmod(i, 2)
        picture.paste(cell, (_GAP + column * (width + _GAP), _GAP + row * (height + _GAP)))
    return picture


def _panel(
    i: int, episode: Episode, step: int, image: Image.Image, fonts: dict[int, Any]
) -> Image.Image:
    """Draw one episode at one time, with its caption; dimmed when it is over."""
    over = step >= len(episode.rewards)
    if over:
        image = Image.blend(image, Image.new("RGB", image.size, PANEL), 0.55)
    pencil = ImageDraw.Draw(image)
    pencil.rectangle([(0, 0), (image.width, _CAPTION - 4)], fill=PANEL)
    title = f"t = {episode.t:,}, {short(episode.num_timesteps)} env steps"
    _badge(pencil, (18, 16), i + 1, fonts[14])
    pencil.text((36, 16), title, fill=_TEXT, font=fonts[19], anchor="lm")
    total = number(float(episode.rewards.sum()))
    line = f"return {total} in {len(episode.rewards):,} steps"
    pencil.text((36, 38), line, fill=_ACCENT, font=fonts[16], anchor="lm")
    if over:
        why = "ended" if episode.terminated else "time limit"
        text = f"{why} after {len(episode.rewards):,} steps"
        at = (image.width / 2, (image.height + _CAPTION) / 2)
        pencil.text(at, text, fill=_TEXT, font=fonts[19], anchor="mm")
    return image


def _legend(curve: Curve, episodes: list[Episode], fonts: dict[int, Any]) -> Image.Image:
    """Draw the returns over the training, with a mark for each panel."""
    image = Image.new("RGB", _SIZE, _BACK)
    known = np.isfinite(curve.returns)
    if not known.any():
        return image
    steps, returns = curve.steps[known], curve.returns[known]
    left, top, right, bottom = 22, 50, _SIZE[0] - 22, _SIZE[1] - 74
    low, high = float(returns.min()), float(returns.max())

    def place(step: float) -> tuple[float, float]:
        share = (float(np.interp(step, steps, returns)) - low) / ((high - low) or 1)
        return left + (right - left) * step / (steps[-1] or 1), bottom - (bottom - top) * share

    large = image.resize((SCALE * _SIZE[0], SCALE * _SIZE[1]))
    line = [(SCALE * x, SCALE * y) for x, y in map(place, steps.tolist())]
    ImageDraw.Draw(large).line(line, fill=_SOFT, width=2 * SCALE, joint="curve")
    image = large.reduce(SCALE)
    pencil = ImageDraw.Draw(image)
    for i, episode in enumerate(episodes):
        _badge(pencil, place(episode.num_timesteps), i + 1, fonts[14])
    title = f"return {number(low)} to {number(high)}, over training"
    pencil.text((left, 18), title, fill=_SOFT, font=fonts[16], anchor="lm")
    return image


def _clock(
    legend: Image.Image, time: float, frame: int, timing: _Timing, fonts: dict[int, Any]
) -> Image.Image:
    """The last cell: the curve, the time in the simulation, and how much of the film is over."""
    image = legend.copy()
    pencil = ImageDraw.Draw(image)
    left, right, height = 22, image.width - 22, image.height
    slow = f", {timing.slow:.2g} times slower" if timing.slow > 1 else ""
    pencil.text((left, height - 34), f"{time:.1f} s{slow}", fill=_TEXT, font=fonts[16], anchor="lm")
    done = left + (right - left) * frame / (timing.frames - 1)
    pencil.line([(left, height - 16), (right, height - 16)], fill=PANEL, width=4)
    pencil.line([(left, height - 16), (done, height - 16)], fill=_ACCENT, width=4)
    return image


def _badge(pencil: Any, at: tuple[float, float], text: int, font: Any) -> None:
    """A number in a disc."""
    x, y = at
    pencil.ellipse([(x - 10, y - 10), (x + 10, y + 10)], fill=_ACCENT)
    pencil.text((x, y), str(text), fill=_BACK, font=font, anchor="mm")


def _font(size: int) -> Any:
    """Return a font that comes with matplotlib: the same pixels on every machine."""
    return ImageFont.truetype(str(Path(mpl.get_data_path(), "fonts/ttf/DejaVuSans.ttf")), size)


def _encode(frames: list[Image.Image], milliseconds: int) -> bytes:
    """WebP, no larger than ``MAX_BYTES`` if the lowest quality can do it."""
    for quality in _QUALITIES:
        buffer = io.BytesIO()
        options: dict[str, Any] = {"quality": quality, "method": 2}
        if len(frames) > 1:
            options |= {"save_all": True, "append_images": frames[1:], "loop": 0}
            options |= {"duration": milliseconds, "kmin": 0, "kmax": 0}  # changes only
        frames[0].save(buffer, "WEBP", **options)
        if buffer.tell() <= MAX_BYTES:
            break
    return buffer.getvalue()
