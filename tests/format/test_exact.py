"""Values that JSON lacks are written so that they come back, or refused by name."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import weighttraj as wt
from weighttraj.errors import FormatError
from weighttraj.format import EnvInfo, ParamLayout, PolicySpec, RunInfo
from weighttraj.format.exact import decode, encode_exactly
from weighttraj.format.schema import load_json, parse, to_json

LAYOUT = ParamLayout.of({"w": ((2,), "other", ("fixed",))})
INFO = RunInfo(run_id="run", layout=LAYOUT)


class Level(IntEnum):
    EASY = 1


def of_kwargs(value: Any) -> RunInfo:
    return replace(INFO, env=EnvInfo(id="x", kwargs={"range": value}))


@pytest.mark.parametrize(
    "value",
    [
        math.inf,
        (0.7, math.inf),
        [0.7, -math.inf, (1, [2, ()])],
        {"a": (1,), "b": {"c": [math.inf]}},
        "inf",
        2**64 - 1,
        True,
        None,
        {},
    ],
)
def test_keywords_come_back_with_the_same_types(value: Any) -> None:
    text = json.dumps(to_json(of_kwargs(value)), allow_nan=False).encode()
    back = parse(load_json(text, "here"), RunInfo, "here")
    assert back.env is not None
    assert repr(back.env.kwargs["range"]) == repr(value)


@pytest.mark.parametrize(
    "value",
    [
        math.nan,
        np.float64(1.5),
        np.float32(1.5),
        np.zeros(2),
        b"bytes",
        {1, 2},
        {1: "a"},
        2**64,
        Level.EASY,
        Path("here"),
        Path,
        math.sqrt,
        "\ud800",
        {"$float": "inf"},
        {"$tuple": [1]},
        1 + 2j,
    ],
)
def test_what_would_come_back_as_another_value_is_refused(value: Any) -> None:
    with pytest.raises(FormatError, match=r"(?s)JSON cannot.*where: .*range\[1\]"):
        encode_exactly((0, value), "range")


def test_tags_that_nobody_wrote_are_not_taken_for_numbers() -> None:
    for value in ({"$float": "nan"}, {"$float": 1}, {"$tuple": 1}, {"$float": "inf", "b": 1}):
        assert decode(value) == value


def test_infinite_bounds_are_stored(tmp_path: Path) -> None:
    policy = PolicySpec(
        kind="other", action_shape=(2,), action_low=(-math.inf, 0), action_high=(math.inf, 1)
    )
    with wt.RunWriter(tmp_path / "run.zarr", replace(INFO, policy=policy)) as writer:
        writer.append(np.zeros(2, np.float32), num_timesteps=0)
    text = (tmp_path / "run.zarr/zarr.json").read_text()
    json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert wt.open_run(tmp_path / "run.zarr").info.policy == policy


def test_a_field_that_json_cannot_hold_is_named() -> None:
    info = replace(INFO, policy=PolicySpec(kind="other", action_low=(0, math.nan)))
    with pytest.raises(FormatError, match=r"policy\.action_low\[1\]"):
        to_json(info)
    with pytest.raises(FormatError, match=r"env\.kwargs\.range"):
        to_json(of_kwargs(math.sqrt))
