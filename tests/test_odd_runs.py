"""Runs that are short, still, huge, tiny or broken: each command says what it did with them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import weighttraj as wt
from weighttraj import cli, writer
from weighttraj.errors import PolicyError, WindowError
from weighttraj.format import ParamLayout, RunInfo
from weighttraj.format.schema import EnvInfo, PolicySpec
from weighttraj.load import ResumableLoader, SnapshotDataset, WindowDataset
from weighttraj.policies.batch import load_policies
from weighttraj.publish.walk import walk
from weighttraj.writer import RunWriter

LAYOUT = ParamLayout.of(
    {"w": ((2, 4), "weight", ("action", "observation")), "b": ((2,), "bias", ("action",))}
)
POLICY = PolicySpec(
    kind="mlp", head="categorical", activation="tanh", layers=(("w", "b"),), observation_shape=(4,)
)
WALK = np.random.default_rng(0).standard_normal((12, 10)).astype(np.float32)
ODD = {
    "none": WALK[:0],
    "one": WALK[:1],
    "two": WALK[:2],
    "constant": np.tile(WALK[:1], (12, 1)),
    "a straight line": np.arange(12, dtype=np.float32)[:, None] * np.ones(10, np.float32),
    "to and fro": np.where(np.arange(12)[:, None] % 2, WALK[0], -WALK[0]),
    "huge": np.sign(WALK) * np.float32(3e38),
    "tiny": WALK * np.float32(1e-40),
    "broken": np.where(np.arange(12)[:, None] >= 7, np.float32("nan"), WALK),
    "infinite": np.where(np.arange(12)[:, None] == 11, np.float32("inf"), WALK),
    "nothing but NaN": np.full((12, 10), np.nan, np.float32),
}


@pytest.fixture
def odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    # Our writer refuses weights that are not finite; others may not.
    monkeypatch.setattr(writer, "check_finite", lambda name, row: row)
    monkeypatch.setenv("WEIGHTTRAJ_CACHE", str(tmp_path / "cache"))
    info = RunInfo(run_id="odd", layout=LAYOUT, policy=POLICY, env=EnvInfo(id="CartPole-v1"))
    path = tmp_path / "odd.zarr"
    with RunWriter(path, info) as writing:
        for t, row in enumerate(ODD[request.param]):
            writing.append(row, num_timesteps=t, iteration=t)
    return path


def command(*arguments: object) -> int:
    """Give a command in this process; an error that is not one of ours goes through."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["weighttraj", *map(str, arguments)])
        try:
            cli.main()
        except SystemExit as end:
            return int(end.code or 0)
    return 0


@pytest.mark.parametrize("odd", ODD, indirect=True)
def test_every_command_takes_it_or_says_why_not(odd: Path, tmp_path: Path) -> None:
    rows, broken = wt.open_run(odd).weights[:], not np.isfinite(wt.open_run(odd).weights[:]).all()
    assert command("show", odd) == 0
    assert command("verify", odd) == int(broken)
    again = len(np.unique(rows, axis=0)) < len(rows)
    assert command("lint", odd) == int(broken or again or not len(rows))
    assert command("report", odd, "--no-film", "--out", tmp_path / "page.html") == 0
    for profile in ("default", "archive"):
        packed = wt.open_run(wt.pack(odd, profile=profile, out=tmp_path / "x.zarr.zip"))
        assert packed.weights[:].tobytes() == rows.tobytes()
    assert command("export", odd, "--to", "hdf5", "--out", tmp_path / "x.h5") == 0
    assert wt.open(tmp_path / "x.h5").runs[0].weights[:].tobytes() == rows.tobytes()
    assert command("import", tmp_path / "x.h5", "--out", tmp_path / "back") == 0
    assert command("export", odd, "--to", "npy", "--out", tmp_path / "npy") == 0
    assert np.load(tmp_path / "npy/weights.npy").tobytes() == rows.tobytes()


@pytest.mark.parametrize("odd", ODD, indirect=True)
def test_loaders_give_all_rows_or_say_why_not(odd: Path) -> None:
    run = wt.open_run(odd)
    for kind, window in ((SnapshotDataset, 1), (lambda runs: WindowDataset(runs, window=2), 2)):
        if len(run) < window:
            with pytest.raises(WindowError, match="shorter than a window"):
                kind([run])
            continue
        loader = ResumableLoader(kind([run]), batch_size=4, shuffle=False)
        t = np.concatenate([batch["t"] for batch in loader])
        assert t.tolist() == list(range(window - 1, len(run)))


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ("broken", "5 of 12 snapshots have weights that are NaN or infinite, the first at t = 7."),
        ("infinite", "1 of 12 snapshots have weights that are NaN or infinite"),
        ("nothing but NaN", "12 of 12 snapshots have weights"),
    ],
    indirect=["odd"],
)
def test_a_page_says_which_snapshots_are_not_finite(odd: Path, said: str, tmp_path: Path) -> None:
    assert command("report", odd, "--out", tmp_path / "page.html") == 0
    page = (tmp_path / "page.html").read_text()
    assert said in page
    assert "Run odd has weights that are NaN or infinite." in page  # in place of the film


@pytest.mark.parametrize("odd", ["broken"], indirect=True)
def test_what_is_finite_of_a_broken_run_is_measured(odd: Path) -> None:
    found = walk(wt.open_run(odd))
    steps = np.linalg.norm(np.diff(WALK[:7].astype(np.float64), axis=0), axis=1)
    np.testing.assert_allclose(found.steps[:6], steps)
    assert np.isnan(found.steps[6:]).all()
    assert (found.rows.tolist(), found.broken.tolist()) == (list(range(7)), list(range(7, 12)))
    singular = np.linalg.svd(WALK[:7].astype(np.float64), compute_uv=False)
    np.testing.assert_allclose(found.singular, singular, rtol=1e-6)


@pytest.mark.parametrize("odd", ["broken"], indirect=True)
def test_a_policy_of_broken_weights_does_not_act(
    odd: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("returns", odd, "--episodes", 1, "--every", 4) == 0
    assert "2 snapshots have weights that are NaN or infinite" in capsys.readouterr().out
    run = wt.open_run(odd)
    assert np.flatnonzero(np.isfinite(run.returns[:, 0])).tolist() == [0, 4]
    for load in (run.load_policy, lambda t: load_policies(run, [0, t])):
        with pytest.raises(PolicyError, match=r"(?s)does not act.*snapshot 11"):
            load(11)
