"""Results as words, pictures and places in Markdown pages."""

from __future__ import annotations

import json
import os
import re
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tipl.commands.evaluate import _table, _wrapped
from tipl.commands.train import curves
from tipl.errors import EvaluateError
from tipl.evaluation.results import Results, Row, read_results, write_document
from tipl.report.figures import (
    OTHERS,
    figures,
    file_name,
    gain_figure,
    skill_figure,
    styles,
    titles,
)
from tipl.report.markdown import insert_markdown, places, render, rewrite
from tipl.report.page import write_report
from tipl.report.scores import GAIN, SKILL, row_at, shown
from tipl.report.sentences import findings, sentences
from tipl.report.tables import cell, tables
from weighttraj.errors import FormatError
from weighttraj.terminal import Output

ROOT = Path(__file__).parents[2]
DEMO = Path("tests/tipl/results.json")
SECTIONS = ("overview", "table", "findings", "tables", "figures", "source")


@pytest.fixture
def demo() -> dict[str, Any]:
    """Results of a released data set, as an earlier version wrote them."""
    document: dict[str, Any] = json.loads((ROOT / DEMO).read_text())
    for scores in document["forecasters"].values():
        scores.pop("repw_ratio", None)
    return document


def typed(document: dict[str, Any]) -> Results:
    return msgspec.convert(document, Results)


@pytest.mark.parametrize("width", [80, 100, 250])
def test_the_overview_cuts_nothing_off(width: int, capsys: pytest.CaptureFixture[str]) -> None:
    """In a terminal, with the long names of the zoo."""
    results = read_results(ROOT / "docs/results/inverted-pendulum-v4-ppo-v1.json")
    console = Output(width=width)
    console.print(_table(results, console))
    said = capsys.readouterr().out
    assert "…" not in said
    assert max(map(len, said.splitlines())) <= width
    gate = next(line for line in said.splitlines() if "tipl-gate-" in line)
    rows = results.forecasters["tipl-gate-inverted-pendulum-v4"]
    for measure, h in ((SKILL, 1), (SKILL, 50), (GAIN, 50)):
        assert cell(row_at(rows, measure, h), interval=width == 250) in gate
    assert ("the report has more columns" in said) == (width < 120)


def shifted(found: Any, by: float) -> Any:
    """All figures of a forecaster, so much larger, with intervals of 0.02."""
    if isinstance(found, list):
        return [shifted(each, by) for each in found]
    if not isinstance(found, dict):
        return found
    if "h" not in found:
        return {key: shifted(each, by) for key, each in found.items()}
    value = (found["value"] or 0) + by
    return found | {"value": value, "low": value - 0.01, "high": value + 0.01}


@pytest.fixture
def many(demo: dict[str, Any]) -> dict[str, Any]:
    """Twenty more forecasters: baseline n has skill n / 100; one model has 0.5."""
    forecasters = demo["forecasters"]
    copy = {key: forecasters["persistence"][key] for key in ("wpe", "repw", "scatter")}
    for number in range(20):
        moved = shifted({"skill": forecasters["persistence"]["skill"]}, number / 100)
        gain = shifted({"gain": forecasters["persistence"]["gain"]}, -number / 100)
        forecasters[f"base-{number}"] = {"causal": True} | copy | moved | gain
    forecasters["tipl-2"] = shifted(forecasters["persistence"], 0.5)
    ratio = {"value": 0.5, "low": 0.4, "high": 0.6}
    forecasters["tipl-2"]["repw_ratio"] = dict.fromkeys(demo["modes"], ratio)
    return demo


# Who matters


def test_models_the_copy_and_the_best_baselines_matter(many: dict[str, Any]) -> None:
    best = ["base-19", "base-18", "base-17", "base-0"]  # three by skill, one by gain
    assert shown(typed(many)) == ["tipl", "tipl-2", "persistence", *best]


def test_the_others_are_grey_and_share_an_entry(many: dict[str, Any]) -> None:
    drawn = styles(typed(many))
    coloured = {name: style["color"] for name, style in drawn.items() if "marker" in style}
    assert set(coloured) == set(shown(typed(many)))
    assert len(set(coloured.values())) == len(coloured)
    assert drawn["reconstruction-32"]["ls"] == "--"
    assert {drawn[f"base-{n}"]["label"] for n in range(1, 17)} == {OTHERS}
    (legend,) = skill_figure(typed(many)).legends
    said = [text.get_text() for text in legend.get_texts()]
    named = [name for name in said if name.startswith("base-")]
    assert sorted(named) == ["base-0", "base-17", "base-18", "base-19"]
    assert {*said} - {*named} == {
        "TIPL",
        "tipl-2",
        "persistence",
        "reconstruction (oracle), rank 32",
        OTHERS,
    }
    assert len(said) == 9


def test_a_line_below_the_frame_is_named(demo: dict[str, Any]) -> None:
    (text,) = skill_figure(typed(demo)).axes[0].texts
    lowest = min(row.value or 0 for row in SKILL(typed(demo).forecasters["tipl"]))
    assert text.get_text() == f"below the frame:\nTIPL (down to {lowest:.3g})"


def test_a_line_above_the_frame_is_named(many: dict[str, Any]) -> None:
    rows = many["forecasters"]["tipl-2"]["gain"]["held"]
    rows[0] |= {"value": 2.5, "low": 2, "high": 3}
    said = [text.get_text() for axes in gain_figure(typed(many)).axes for text in axes.texts]
    assert any("above the frame" in each and "tipl-2 (up to 2.5)" in each for each in said)


def test_titles_are_those_of_the_figures(demo: dict[str, Any]) -> None:
    assert titles(typed(demo)) == list(figures(typed(demo)))
    assert len(titles(typed(demo))) == 5
    assert titles(typed(demo | {"modes": []})) == ["Skill against horizon"]


# The sentences


def test_sentences_say_what_was_done_found_and_how_sure_it_is(many: dict[str, Any]) -> None:
    first, tipl, second, weights, returns, bound, last = sentences(typed(many))
    assert first.startswith("The models forecast the weights of 10 runs that they were not")
    assert "gain is what the forecast adds" in first
    far = row_at(typed(many).forecasters["tipl"], SKILL, 10)
    assert tipl.startswith("TIPL, which uses the future of the run, has skill ")
    assert f" and {cell(far)} at h = 10; its gain is " in tipl
    assert second == (
        "tipl-2 has skill 0.50 [0.49, 0.51] at h = 1 and 0.50 [0.49, 0.51] at h = 10; its gain is "
        "0.50 [0.49, 0.51] at h = 50."
    )
    assert weights.startswith("base-19 has the highest skill of 20 baselines: ")
    assert returns == (
        "base-0 has the highest gain of these baselines: 0.00 [-0.01, 0.01] at h = 50."
    )
    assert bound.startswith("reconstruction (oracle), rank 32 is not a forecast")
    assert last.startswith("This is a quick evaluation")


@pytest.mark.parametrize(
    ("name", "shift", "said"),
    [
        ("base", 0.495, "these runs do not show which one gains more."),
        ("base-stretched", 0.495, "these runs do not show which one gains more."),
        ("base-stretched", 0.2, None),
    ],
)
def test_a_baseline_that_gains_as_much_is_named(
    many: dict[str, Any], name: str, shift: float, said: str | None
) -> None:
    others = many["forecasters"]
    found = findings(
        typed(many | {"forecasters": others | {name: shifted(others["persistence"], shift)}})
    )
    both = [sentence for sentence in found if "overlap" in sentence]
    assert both == ([f"The intervals of tipl-2 and {name} overlap: {said}"] if said else [])


def test_results_without_returns_speak_of_weights_only(demo: dict[str, Any]) -> None:
    for scores in demo["forecasters"].values():
        for key in ("repw", "gain", "scatter"):
            del scores[key]
    (said,) = findings(typed(demo | {"modes": []}))
    assert said.endswith(" at h = 10.")
    assert "gain" not in said


@pytest.mark.parametrize(
    ("skills", "said"),
    [
        ((0.1, 0.2), "TIPL has skill 0.10 at h = 1 and 0.20 at h = 10."),
        ((-1, -2.5), "TIPL has skill -1.00 at h = 1 and -2.50 at h = 10."),
    ],
)
def test_a_finding_is_plain(demo: dict[str, Any], skills: tuple[float, float], said: str) -> None:
    rows = [{"h": h, "value": v} for h, v in zip((1, 10), skills, strict=True)]
    scores = {"causal": True, "skill": {"ratio_of_sums": {"all": rows}}}
    forecasters = {"persistence": scores, "tipl": scores}
    assert findings(typed(demo | {"forecasters": forecasters})) == [said]


def test_sentences_about_baselines_alone_or_one_run(demo: dict[str, Any]) -> None:
    alone = {"persistence": demo["forecasters"]["persistence"]}
    alone["ema-0.9"] = shifted(alone["persistence"], 0.005)
    one = typed(demo | {"forecasters": alone, "runs": ["seed0040"], "split": "train"})
    first, finding, last = sentences(one)
    assert first.startswith("The baselines forecast the weights of 1 run that they may have been")
    assert finding.startswith("ema-0.9 has skill ")
    assert findings(one) == [finding]
    assert last.endswith("with one run there are no intervals.")


@pytest.mark.parametrize(
    ("value", "said"),
    [(0.123, "0.12"), (12.345, "12.35"), (-123.4, "-123"), (-22134.0, "-22100"), (None, "-")],
)
def test_numbers_have_three_digits(value: float | None, said: str) -> None:
    assert cell(Row(h=1, value=value)) == said


# Places


def page_of(*sections: str, source: Path = DEMO) -> str:
    return "# A page\n\nProse.\n" + "".join(
        f"\n<!-- results of {source}, {section}: rewrite -->\n<!-- end of results -->\n\nMore.\n"
        for section in sections
    )


def test_every_section_is_written_in_its_place(demo: dict[str, Any], tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    other = page_of("findings", source=Path("other.json"))
    page.write_text(page_of(*SECTIONS) + other)
    assert all(place.empty for place in places(page.read_text()))
    insert_markdown(typed(demo), DEMO, page)
    text = page.read_text()
    assert text.endswith(other)
    assert [place.section for place in places(text) if not place.empty] == list(SECTIONS)
    assert text.startswith("# A page\n\nProse.\n")
    assert text.count("\nMore.\n") == len(SECTIONS) + 1
    pictures = sorted(path.name for path in (tmp_path / "results").iterdir())
    assert len(pictures) == 5
    assert all(f"](results/{name})" in text for name in pictures)
    assert rewrite(text, "results", str(DEMO), partial(render, typed(demo), DEMO)) == text
    changed = demo | {"command": "tipl evaluate something else"}
    again = rewrite(text, "results", str(DEMO), partial(render, typed(changed), DEMO))
    assert again == text.replace(demo["command"], changed["command"]) != text


def test_without_a_section_it_is_the_overview(demo: dict[str, Any]) -> None:
    bare = f"<!-- results of {DEMO} -->\n<!-- end of results -->\n"
    text = rewrite(bare, "results", str(DEMO), lambda section: render(typed(demo), DEMO, section))
    value = cell(row_at(typed(demo).forecasters["tipl"], SKILL, 1), interval=False)
    assert f"| TIPL | {value} |" in text
    assert all(sentence in text for sentence in sentences(typed(demo)))


def test_important_tables_are_open_and_the_others_folded(demo: dict[str, Any]) -> None:
    text = render(typed(demo), DEMO, "tables")
    main = [table.title for table in tables(typed(demo)) if table.main]
    assert main == [
        "Skill: ratio of sums, all starts",
        "Function skill: divergence of policies",
        "Inference gain, sampled actions, log_std of the start",
    ]
    before, _, folded = text.partition("<details>")
    assert all(f"**{title}**" in before for title in main)
    assert "Skill: mean of the ratios" in folded
    assert text.count("<summary>") == len(tables(typed(demo))) - len(main)
    assert "future of the run: TIPL, reconstruction (oracle), rank 32." in folded


def test_the_source_says_how_it_was_judged(demo: dict[str, Any]) -> None:
    text = render(typed(demo), DEMO, "source")
    for said in (
        "version 1; 10 runs of its test split: seed0040",
        "3,000 for weights",
        "5 episodes",
    ):
        assert said in text
    assert f"`{demo['command']}`" in text


def test_a_page_without_a_place_is_refused(demo: dict[str, Any], tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    unclosed = f"<!-- results of {DEMO} -->\n"
    for text in ("# Nothing\n", page_of("findings", source=Path("other.json")), unclosed):
        page.write_text(text)
        with pytest.raises(EvaluateError, match="no place for these results"):
            insert_markdown(typed(demo), DEMO, page)
        assert page.read_text() == text


def test_an_unknown_section_is_refused(demo: dict[str, Any], tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(page_of("poem"))
    with pytest.raises(
        EvaluateError, match=r"no such section of results(.|\n)*overview, table, findings"
    ):
        insert_markdown(typed(demo), DEMO, page)


def test_a_report_is_not_written_through_a_link(demo: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "theirs").mkdir()
    results = typed(demo)
    for name in ("report.html", file_name(titles(results)[0]), "results.json"):
        (tmp_path / "theirs" / name).unlink(missing_ok=True)
        (tmp_path / "theirs" / name).symlink_to(tmp_path / "mine")
        with pytest.raises(FormatError, match="link"):
            write_document(tmp_path / "theirs/results.json", results)
            write_report(results, tmp_path / "theirs")
        (tmp_path / "theirs" / name).unlink()
    assert (tmp_path / "mine").read_text() == "mine"
    assert write_report(results, tmp_path / "theirs").read_text().startswith("<!")


def test_results_that_are_no_file_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "results.json")
    with pytest.raises(EvaluateError, match="no results"):
        read_results(tmp_path / "results.json")
    with pytest.raises(FileNotFoundError, match="no results at"):
        read_results(tmp_path / "others.json")


STRANGE = "<img src=x>`|[x](https://x.org)\n# head\x1b[2J"


@pytest.mark.parametrize("section", SECTIONS)
def test_a_strangers_result_file_adds_no_markup_to_a_page(
    section: str, demo: dict[str, Any]
) -> None:
    """Names, runs, reasons and commands are quoted: no HTML, link, heading or end of code."""
    changed = demo | {
        "data": STRANGE,
        "command": STRANGE,
        "runs": [STRANGE],
        "left_out": {STRANGE: STRANGE},
        "failed": {STRANGE: STRANGE},
        "forecasters": demo["forecasters"] | {STRANGE: demo["forecasters"]["tipl"]},
    }
    said = render(typed(changed), DEMO, section)
    plain = render(typed(demo), DEMO, section)
    outside = re.sub("`[^`\n]*`", "", re.sub(r"\\.", "", said))
    assert "<img" not in outside
    assert not re.search(r"\[x\]\(", outside)
    assert "\n# head" not in said
    assert "\x1b" not in said
    assert said.count("|---|") == plain.count("|---|")


# The terminal


def test_wrapped_sentences_break_no_figure(demo: dict[str, Any]) -> None:
    for sentence in sentences(typed(demo)):
        for width in (30, 40, 79, 80):
            lines = _wrapped(sentence, width).split("\n")
            assert max(map(len, lines)) <= width
            assert " ".join(line[2:] for line in lines) == sentence
            assert not any(line.endswith("=") or line.lstrip().startswith("=") for line in lines)


def test_a_curve_has_a_bar_for_each_line_of_the_log() -> None:
    log = [{"batch": 50.0 * n, "wpe": 10.0**-n} for n in range(1, 9)]
    log[0]["validation_wpe"] = 1.0  # one value is no curve
    (line,) = curves(log)
    assert line == "WPE on training runs █▇▆▅▄▃▂▁ 0.1 at batch 50, 1e-08 at batch 400"
    assert len(curves([line | {"validation_wpe": 1.0} for line in log])) == 2
    assert curves([]) == []
