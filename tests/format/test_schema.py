from __future__ import annotations

import json

import pytest

from weighttraj.errors import FormatError, NewerFormatError
from weighttraj.format import DatasetInfo, EnvInfo, ParamLayout, RunEntry, RunInfo
from weighttraj.format.schema import FORMAT_VERSION, load_json, parse, to_json

LAYOUT = ParamLayout.of({"w": ((2, 3), "weight", ("hidden_0", "observation"))})
INFO = RunInfo(run_id="run", layout=LAYOUT, env=EnvInfo(id="CartPole-v1", kwargs={"a": [1.5]}))


def changed(**values: object) -> bytes:
    return json.dumps(to_json(INFO) | values).encode()


def read(text: bytes) -> RunInfo:
    return parse(load_json(text, "here"), RunInfo, "here")


def test_metadata_survives_json() -> None:
    assert read(changed()) == INFO


def test_a_newer_format_is_refused_with_the_way_out() -> None:
    with pytest.raises(NewerFormatError, match="pip install --upgrade weighttraj"):
        read(changed(format_version=FORMAT_VERSION + 1))


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[1]",
        b'"\xff"',
        b"[" * 100_000,
        changed(run_id="../../etc"),
        changed(run_id=""),
        changed(n_committed=-1),
        changed(block=0),
        changed(status="lost"),
        changed(layout={"params": [{"name": "w"}]}),
        changed(layout=None),
    ],
)
def test_bad_metadata_is_one_clear_error(text: bytes) -> None:
    with pytest.raises(FormatError):
        read(text)


def test_a_layout_of_terabytes_is_refused_before_anything_is_allocated() -> None:
    huge = {"name": "w", "shape": [2**40], "offset": 0, "role": "weight", "axes": ["a"]}
    with pytest.raises(FormatError, match=r"2\*\*31"):
        read(changed(layout={"params": [huge]}))


@pytest.mark.parametrize("path", ["../run.zarr", "/etc", "runs/other.zarr", "runs/../run.zarr"])
def test_a_data_set_cannot_point_out_of_its_folder(path: str) -> None:
    with pytest.raises(FormatError, match="must lie in its data set"):
        RunEntry(id="run", path=path)


def test_run_ids_are_unique() -> None:
    entry = RunEntry(id="run", path="runs/run.zarr")
    with pytest.raises(FormatError, match="unique"):
        DatasetInfo(id="set", runs=(entry, entry))


@pytest.mark.parametrize("value", [float("nan"), object()])
def test_values_that_json_cannot_hold_are_refused(value: object) -> None:
    info = RunInfo(run_id="run", layout=LAYOUT, env=EnvInfo(id="x", kwargs={"a": value}))
    with pytest.raises(FormatError, match="JSON cannot"):
        to_json(info)
