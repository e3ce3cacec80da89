"""Files appear whole or not at all, and nothing is written through a link."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.disk import grow
from weighttraj.atomic import (
    appearing,
    appending,
    drafting,
    links_in,
    lock_of,
    remove_abandoned,
    replace_file,
    replacing,
)
from weighttraj.errors import FormatError, StoreExistsError

MINE = "mine"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A stranger's folder, beside a file and a folder of ours."""
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside/file").write_text(MINE)
    (tmp_path / "data").mkdir()
    return tmp_path / "data"


def untouched(data: Path) -> bool:
    outside = data.parent / "outside"
    return [p.name for p in outside.iterdir()] == ["file"] and (
        outside / "file"
    ).read_text() == MINE


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"old")
    with replacing(file) as new:
        new.write(b"new")
        new.flush()
        assert file.read_bytes() == b"old"
    assert file.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [file]


def test_a_failure_leaves_the_old_file_and_no_draft(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), replacing(file) as new:
        new.write(b"new")
        raise ZeroDivisionError
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_the_mode_of_a_new_file_is_the_usual_one(tmp_path: Path) -> None:
    replace_file(tmp_path / "one", b"")
    (tmp_path / "other").write_bytes(b"")
    assert (tmp_path / "one").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_drafts_of_two_writers_do_not_meet(tmp_path: Path) -> None:
    with replacing(tmp_path / "file") as one, replacing(tmp_path / "file") as other:
        one.write(b"one")
        other.write(b"other")
        assert len(list(tmp_path.iterdir())) == 2
    assert (tmp_path / "file").read_bytes() == b"one"  # its block ended last


@pytest.mark.parametrize("name", ["tables", "tables/deep", "tables/deep/file"])
@pytest.mark.parametrize("target", ["outside", "outside/file", "nowhere"])
def test_no_link_below_the_root_is_followed(data: Path, name: str, target: str) -> None:
    (data / name).parent.mkdir(parents=True, exist_ok=True)
    (data / name).symlink_to(data.parent / target)
    with pytest.raises(FormatError, match="link"):
        replace_file(data / "tables/deep/file", b"theirs", root=data)
    assert untouched(data)
    assert not (data.parent / "nowhere").exists()
    assert list(links_in(data)) == [
        f"{data / name}: a link to {data.parent / target}; the data must be plain files"
    ]


def test_the_root_may_be_reached_through_a_link(data: Path) -> None:
    (data.parent / "link").symlink_to(data)
    replace_file(data.parent / "link/tables/file", b"x", root=data.parent / "link")
    assert (data / "tables/file").read_bytes() == b"x"


def test_a_users_own_link_to_a_folder_is_followed(data: Path) -> None:
    (data / "mine").symlink_to(data.parent / "outside")
    replace_file(data / "mine/file", b"x")
    assert (data.parent / "outside/file").read_bytes() == b"x"


def test_a_hard_link_is_replaced_and_not_written_to(data: Path) -> None:
    os.link(data.parent / "outside/file", data / "file")
    replace_file(data / "file", b"x", root=data)
    assert untouched(data)


def test_a_link_swapped_in_while_we_write_is_not_followed(data: Path) -> None:
    """The folder that was opened stays the folder that is written to."""
    (data / "tables").mkdir()
    with replacing(data / "tables/file", root=data) as file:
        file.write(b"theirs")
        (data / "tables").rename(data / "moved")
        (data / "tables").symlink_to(data.parent / "outside")
    assert untouched(data)
    assert (data / "moved/file").read_bytes() == b"theirs"


@pytest.mark.parametrize("name", ["folder", "folder/file"])
def test_nothing_is_added_through_a_link(data: Path, name: str) -> None:
    (data / name).parent.mkdir(exist_ok=True)
    (data / name).symlink_to(data.parent / "outside" / name.removeprefix("folder").strip("/"))
    with (
        pytest.raises(FormatError, match="link"),
        appending(data / "folder/file", root=data) as file,
    ):
        file.write(b"theirs")
    assert untouched(data)


def test_a_folder_in_the_place_of_a_file_is_one_error(data: Path) -> None:
    (data / "file").mkdir()
    with pytest.raises(FormatError, match="where it belongs"):
        replace_file(data / "file", b"", root=data)
    (data / "tables").write_bytes(b"")
    with pytest.raises(FormatError, match="where it belongs"):
        replace_file(data / "tables/file", b"", root=data)
    assert sorted(p.name for p in data.iterdir()) == ["file", "tables"]


def test_a_lock_is_no_link(data: Path) -> None:
    (data / "lock").symlink_to(data.parent / "outside/file")
    with pytest.raises(FormatError, match="link"):
        lock_of(data / "lock").acquire()
    assert untouched(data)


def test_drafts_of_killed_processes_are_removed_and_links_left_alone(data: Path) -> None:
    target = data / "run.zip"
    code = (
        "import os, sys; from pathlib import Path; from weighttraj.atomic import drafting\n"
        "with drafting(Path(sys.argv[1])) as folder:\n"
        "    (folder / 'half').write_text('half'); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(target)], check=False)
    (old,) = data.iterdir()
    assert (old / "half").exists()
    (data.parent / "outside/lock").touch()
    trap = data / ".run.zip.trap.draft"
    trap.symlink_to(data.parent / "outside")
    with drafting(target) as folder:
        remove_abandoned(target)  # whose lock is held is not abandoned
        assert folder.is_dir()
        assert not old.exists()
    assert list(data.iterdir()) == [trap]
    (data.parent / "outside/lock").unlink()
    assert untouched(data)


def test_a_dangling_link_is_no_new_path(data: Path) -> None:
    (data / "out").symlink_to(data.parent / "nowhere")
    with pytest.raises(StoreExistsError, match="a link"), appearing(data / "out") as draft:
        draft.mkdir()


def test_a_full_disk_names_the_file_and_leaves_nothing(disk: Path) -> None:
    with pytest.raises(OSError, match=r"No space left on device: .*page\.html"):
        replace_file(disk / "page.html", bytes(1 << 20))
    assert list(disk.iterdir()) == []
    grow(disk, "4m")
    replace_file(disk / "page.html", bytes(1 << 20))
    assert [p.name for p in disk.iterdir()] == ["page.html"]


TOO_LARGE = """
import resource, signal, sys
from pathlib import Path
from weighttraj.atomic import replace_file
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    replace_file(Path(sys.argv[1]), bytes(5000))
except OSError as error:
    print(error)
"""


def test_a_file_that_may_not_grow_leaves_nothing(tmp_path: Path) -> None:
    assert hasattr(resource, "RLIMIT_FSIZE")
    command = [sys.executable, "-c", TOO_LARGE, str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "File too large" in done.stdout
    assert str(tmp_path / "file") in done.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["a pipe", "a hard link", "a device"])
def test_nothing_is_added_to_what_is_no_file_of_the_data_alone(data: Path, kind: str) -> None:
    if kind == "a pipe":  # which would be waited for
        os.mkfifo(data / "file")
    elif kind == "a hard link":
        os.link(data.parent / "outside/file", data / "file")
    else:
        (data / "file").symlink_to("/dev/null")
    with pytest.raises(FormatError), appending(data / "file", root=data) as file:
        file.write(b"theirs")
    assert untouched(data)
