"""The gallery: an index that can be searched, a page for each data set and card, from disk."""

from __future__ import annotations

import html
import os
import re
import shutil
import subprocess
from pathlib import Path
from urllib.parse import unquote

import pytest
from rich.console import Console

from weighttraj import cli
from weighttraj.errors import StoreExistsError
from weighttraj.publish.gallery import MAX_CARD, as_html, gallery, page_name
from weighttraj.registry import LocalDataset, select, write_card

CARD = """---
datasets:
- small
---

# a-model

<!-- facts -->
It **forecasts** [weights](../../docs/results.md), see [the paper](https://arxiv.org/abs/2503.04074).

| a | b |
|---|---|
| 1 | <script>alert(1)</script> |

![picture](a-model.svg) ![far](../secret.svg)
"""


@pytest.fixture(scope="module")
def made(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, two cards, and their gallery below ``out``. Do not write to it."""
    path = tmp_path_factory.mktemp("gallery")
    select(small_dataset, path / "small", seeds=[0, 2])
    write_card(path / "small")
    (path / "cards").mkdir()
    (path / "cards/a-model.md").write_text(CARD)
    (path / "cards/a-model.svg").write_text("<svg/>")
    (path / "secret.svg").write_text("<svg/>")
    make(path, "small", "team/small")
    return path


@pytest.fixture
def place(made: Path, tmp_path: Path) -> Path:
    """What a gallery is made of, to be written to."""
    return Path(
        shutil.copytree(made, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("out"))
    )


def make(place: Path, *names: str) -> Path:
    datasets = dict.fromkeys(names or ("small",), place / "small")
    return gallery(datasets, place / "out", cards=[place / "cards/a-model.md"], film=False)


def test_every_link_leads_to_a_page(made: Path) -> None:
    index = made / "out/index.html"
    pages = sorted(page.relative_to(made / "out").as_posix() for page in index.parent.rglob("*"))
    assert pages == [
        *("cards", "cards/small.html", "cards/team~small.html"),
        *("data", "data/small.html", "data/team~small.html", "index.html"),
        *("models", "models/a-model", "models/a-model.html", "models/a-model/a-model.svg"),
    ]
    for page in index.parent.rglob("*.html"):
        for link in re.findall(r'(?:href|src)="([^"#]+)"', page.read_text()):
            if not link.startswith(("https:", "data:")):
                assert (page.parent / link).is_file(), link


def test_the_index_says_what_there_is(made: Path) -> None:
    text = html.unescape((made / "out/index.html").read_text())
    assert "2 (1 train, 1 test)" in text
    assert "It forecasts weights, see the paper." in text
    assert text.count("<svg") == 2  # learning curves
    assert "http" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", text).replace("http-equiv", "")


def test_cards_are_text_not_code(made: Path) -> None:
    text = (made / "out/models/a-model.html").read_text()
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert "facts -->" not in text
    assert "docs/results.md" not in text  # it leads nowhere from here
    assert 'href="https://arxiv.org/abs/2503.04074"' in text


def test_markdown() -> None:
    page, pictures = as_html("[a](b.md) [c](https://d) ![e](f.svg)")
    assert page == '<p>a <a href="https://d">c</a> <img src="f.svg" alt="e" /></p>\n'
    assert pictures == ["f.svg"]


def test_pages_of_two_ids_are_two() -> None:
    names = ["ns/x", "ns__x", "ns~x", "ns%2Fx", "ns x", "ns#x", "caf\u00e9", "cafe\u0301"]
    names += ["a" * 250, "a" * 249 + "b", "\u00e9" * 120]
    pages = [page_name(name) for name in names]
    assert len({page.lower() for page in pages}) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9._~%-]{1,200}", page) for page in pages)


def test_odd_ids_have_pages_that_their_links_lead_to(place: Path) -> None:
    datasets = dict.fromkeys(("ns/x", "ns__x", "a b#c%20?"), place / "small")
    index = gallery(datasets, place / "out", film=False)
    links = re.findall(r'href="([^"#]+)"', index.read_text())
    assert len(set(links)) == 6
    assert all((index.parent / unquote(link)).is_file() for link in links)


def test_a_card_of_data_and_one_of_a_model_are_two_pages(place: Path) -> None:
    shutil.copyfile(place / "cards/a-model.md", place / "cards/small.md")
    cards = [place / "cards/small.md"]
    index = gallery({"small": place / "small"}, place / "out", cards=cards, film=False)
    assert "a-model" in (index.parent / "models/small.html").read_text()
    assert "a-model" not in (index.parent / "cards/small.html").read_text()


def test_what_a_link_leads_to_is_not_published(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "secret.md").write_text("# my secret")
    (place / "secret.svg").write_text("<svg>my secret</svg>")
    for file in (place / "small/README.md", place / "cards/b-model.md"):
        file.unlink(missing_ok=True)
        file.symlink_to(place / "secret.md")
    (place / "cards/linked.svg").symlink_to(place / "secret.svg")
    with (place / "cards/a-model.md").open("a") as card:
        card.write("\n![a link](linked.svg) ![another page](b-model.md)\n")
    cards = sorted((place / "cards").glob("*.md"))
    index = gallery(
        {"small": place / "small"}, place / "out", cards=cards, film=False, console=Console()
    )
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("left out: refused to read a file") == 2
    assert not (place / "out/data").exists()
    assert "a link another page" in (index.parent / "models/a-model.html").read_text()
    pages = [page for page in index.parent.rglob("*") if page.is_file()]
    assert not [page for page in pages if b"my secret" in page.read_bytes()]


def test_pictures_of_one_name_are_those_of_their_cards(place: Path) -> None:
    other = place / "others/b-model.md"
    other.parent.mkdir()
    other.write_text("# b\n\n![picture](a-model.svg) ![odd](<my pic%20.svg>)")
    (other.parent / "a-model.svg").write_text("<svg>b</svg>")
    (other.parent / "my pic .svg").write_text("<svg>odd</svg>")
    cards = [place / "cards/a-model.md", other]
    index = gallery({}, place / "out", cards=cards, film=False)
    for name, content in {
        "a-model": ["<svg/>"],
        "b-model": ["<svg>b</svg>", "<svg>odd</svg>"],
    }.items():
        page = index.parent / f"models/{name}.html"
        shown = re.findall(r'src="([^"]+)"', page.read_text())
        assert [(page.parent / unquote(src)).read_text() for src in shown] == content


def test_cards_that_are_no_text_or_too_large_are_left_out(place: Path) -> None:
    (place / "cards/b.md").write_bytes(b"\xff\xfe")
    (place / "cards/c.md").write_bytes(b"<!--" * MAX_CARD)
    os.mkfifo(place / "cards/d.md")
    (place / "cards/e.md").write_bytes(b"<!--" * (MAX_CARD // 4))
    cards = sorted((place / "cards").glob("*.md"))
    index = gallery({}, place / "out", cards=cards, film=False)
    pages = sorted(page.name for page in (index.parent / "models").glob("*.html"))
    assert pages == ["a-model.html", "e.html"]


def test_it_is_written_again_but_nothing_else_is_replaced(place: Path) -> None:
    index = make(place)
    before = index.read_bytes()
    assert make(place).read_bytes() == before
    index.write_text("mine")
    with pytest.raises(StoreExistsError):
        make(place)
    assert index.read_text() == "mine"


def test_what_is_damaged_is_left_out(place: Path) -> None:
    (place / "small/dataset.json").write_text("{}")
    assert "Data sets</h2>" not in make(place).read_text()


@pytest.fixture
def browser(tmp_path: Path) -> list[str]:
    """A command that prints a page as Chromium has it, in as narrow a window as it can be."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("Chromium is not installed")
    quiet = ("--disable-background-networking", "--disable-component-update", "--disable-sync")
    return [
        *(program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", *quiet),
        *("--no-first-run", f"--user-data-dir={tmp_path / 'browser'}", "--window-size=400,800"),
        "--dump-dom",
    ]


def test_the_search_in_a_browser(made: Path, browser: list[str]) -> None:
    index = made / "out/index.html"

    def shown(query: str) -> list[str]:
        done = subprocess.run(
            [*browser, f"file://{index}#q={query}"], capture_output=True, text=True, check=True
        )
        entries = re.findall(r"<li data-words=[^>]*?(hidden=\"\")?>\s*<h3>(.*?)</h3>", done.stdout)
        assert len(entries) == 3
        return [name for hidden, name in entries if not hidden]

    assert shown("") == ["small", "team/small", "a-model"]
    assert shown("team%20PPO") == ["team/small"]
    assert shown("forecasts") == ["a-model"]
    assert shown("nothing") == []


MEASURE = """<script>
const page = document.documentElement
document.title = page.scrollWidth + " of " + page.clientWidth
</script>"""


def test_no_page_is_wider_than_a_narrow_window(place: Path, browser: list[str]) -> None:
    card = place / "cards/a-model.md"
    wide = "| a | b |\n|---|---|\n| " + " | ".join(["`unbroken" * 20 + "`"] * 2) + " |\n"
    card.write_text(card.read_text() + "\n" + wide + "\n```bash\n" + "long " * 100 + "\n```\n")
    index = make(place)
    for name in ("index", "models/a-model", "data/small"):
        page = index.parent / f"{name}.html"
        allowed = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page.read_text())
        page.write_text(allowed + MEASURE)
        done = subprocess.run(
            [*browser, f"file://{page}"], capture_output=True, text=True, check=True
        )
        (widths,) = re.findall(r"<title>(\d+) of (\d+)</title>", done.stdout)
        assert widths[0] == widths[1] < "600", name


def test_the_command(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here = [LocalDataset("small", place / "small")]
    monkeypatch.setattr(cli.registry, "local_datasets", lambda: here)  # not the large ones
    out = place / "made"
    cli._report(all=True, film=False, out=out, cards=place / "cards")
    assert capsys.readouterr().out.endswith("index.html\n")
    assert (out / "data/small.html").is_file()
    assert (out / "models/a-model.html").is_file()
    with pytest.raises(SystemExit):
        cli._report()
    assert "--all" in capsys.readouterr().err


def test_a_gallery_is_not_written_through_links(place: Path) -> None:
    (place / "mine").mkdir()
    for name in ("data", "models", "models/a-model", "models/a-model/a-model.svg"):
        (place / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (place / "out" / name).symlink_to(place / "mine")
        make(place)
        (place / "out" / name).unlink()
        assert list((place / "mine").iterdir()) == []
        shutil.rmtree(place / "out")


def test_a_picture_that_no_page_of_ours_has_put_there_stays(place: Path) -> None:
    mine = place / "out/models/a-model/a-model.svg"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    assert "a-model" not in make(place).read_text()
    assert mine.read_text() == "mine"
