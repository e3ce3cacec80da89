"""The card of a released model: prose by hand, and what ``metrics.json`` says between markers.

A card is made once from a template of the model's kind. After that ``tipl card`` only rewrites the
places that begin with ``<!-- facts of NAME, SECTION: ... -->``, from the template ``facts.md``. A
section has its own heading, so that what was not measured leaves no empty one.

| section | what it says |
|---|---|
| ``summary`` | data, cadence, runs that it was trained and evaluated on |
| ``baselines`` | its figures beside those of persistence, the oracle and the best baselines |
| ``checks`` | the six checks |
| ``training`` | settings and the error while it was trained |
| ``commands`` | how the results were made |
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
from matplotlib.figure import Figure

from tipl import registry
from tipl.checks.results import CheckResults
from tipl.errors import ModelError
from tipl.report.figures import svg
from tipl.report.markdown import code, rewrite, section_of, table_lines, templates
from tipl.report.scores import PERSISTENCE, oracles, row_at, wpe
from tipl.report.sentences import STRETCHED, findings
from tipl.report.tables import cell, headline, label
from tipl.zoo.metrics import Metrics, read_metrics

_TESTS = {
    "null": "random walks: skill is 0",
    "causality": "another future: the same forecast, bit for bit",
    "permutation": "hidden units in another order: the forecast follows",
    "sign": "hidden units with the other sign: the forecast follows",
    "scale": "steps twice as long: the forecast follows",
    "drift": "a straight line: the forecast continues it",
}


SECTIONS = ("summary", "baselines", "checks", "training", "commands")


def write_card(name: str, out: Path) -> Path:
    """Write a model's card into a folder, or rewrite the places of the card that is there.

    Raises:
        ModelError: there is no such model, or it was not evaluated.
    """
    metrics = metrics_of(name)
    out.mkdir(parents=True, exist_ok=True)
    card = out / f"{name}.md"
    text = card.read_text(encoding="utf-8") if card.exists() else new_card(metrics)
    card.write_text(refreshed(text, metrics), encoding="utf-8")
    if metrics.log and metrics.kind != "drift":
        (out / f"{name}.svg").write_text(svg(training_figure(metrics)), encoding="utf-8")
    return card


def metrics_of(name: str) -> Metrics:
    """Return what is known of a released model.

    Raises:
        ModelError: there is no such model, or it was not evaluated.
    """
    metrics = read_metrics(registry.MODELS / name) if name in registry.names() else None
    if metrics is None:
        raise ModelError(
            "there is no released model of this name with results",
            expected=", ".join(registry.names()) or "a released model",
            got=name,
            do="release it: `tipl release FOLDER --name NAME --results RESULTS`",
        )
    return metrics


def new_card(metrics: Metrics) -> str:
    """Return a card from the template of its kind, or the one for all; its places are empty."""
    wanted = [f"card-{metrics.kind}.md", "card.md"]
    return templates().select_template(wanted).render(metrics=metrics)


def refreshed(card: str, metrics: Metrics) -> str:
    """Return the card with its places rewritten."""
    return rewrite(card, "facts", metrics.name, lambda section: facts(metrics, section))


def facts(metrics: Metrics, section: str) -> str:
    """Return one section as Markdown, empty if there is nothing to say.

    Raises:
        ModelError: there is no such section.
    """
    if section not in SECTIONS:
        raise ModelError(
            "there is no such section of a card",
            expected=", ".join(SECTIONS),
            got=section,
            where=metrics.name,
            do="change the marker in the card",
        )
    if section == "commands":
        return _commands(metrics)
    results = metrics.results
    own = {name: results.forecasters[name] for name in (PERSISTENCE, metrics.evaluated_as)}
    context = {
        "metrics": metrics,
        "results": results,
        "alone": msgspec.structs.replace(results, forecasters=own),
        "is_model": registry.is_model(metrics.kind),
        "all_settings": _settings(metrics),
        "tests": _TESTS,
        "headline": headline,
        "measured": _measured,
        "ranges": ranges,
        "cell": cell,
        "table_lines": table_lines,
        "findings": findings,
    }
    return section_of("facts.md", section, context)


def ranges(runs: Sequence[str]) -> str:
    """Return ids of runs, in order, with three or more successive numbers as first to last."""
    found: list[list[str]] = []
    for run in runs:
        if found and run == _successor(found[-1][-1]):
            found[-1].append(run)
        else:
            found.append([run])
    texts = [f"{some[0]} to {some[-1]}" if len(some) > 2 else ", ".join(some) for some in found]
    return ", ".join(texts)


def _successor(run: str) -> str | None:
    """Return the id with the next number: seed0009, seed0010; None: it ends without a number."""
    number = re.search(r"\d+$", run)
    if number is None:
        return None
    return f"{run[: number.start()]}{int(number[0]) + 1:0{len(number[0])}d}"


def training_figure(metrics: Metrics) -> Figure:
    """Return a figure of errors against batches; WPE beside persistence and the oracle at h = 1."""
    fig = Figure(figsize=(7, 3.6), layout="constrained")
    axes = fig.subplots()
    for key, name, color in (
        ("wpe", "training runs, with dropout", "#2471a3"),
        ("validation_wpe", "validation runs", "#c0392b"),
        ("error", "training runs", "#2471a3"),
        ("validation_error", "validation runs", "#c0392b"),
    ):
        lines = [line for line in metrics.log if key in line]
        if lines:
            x, y = ([line[k] for line in lines] for k in ("batch", key))
            axes.plot(x, y, label=name, color=color, lw=1.5)
    measured = "wpe" if "wpe" in metrics.log[-1] else "error over that of persistence"
    beside = ((PERSISTENCE, "-"), *((oracle, "--") for oracle in oracles(metrics.results)))
    for name, style in beside if measured == "wpe" else ():
        row = row_at(metrics.results.forecasters[name], wpe, 1)
        if row is not None and row.value:
            text = f"{label(name)}, h = 1, evaluated runs"
            axes.axhline(row.value, ls=style, color="#7f8c8d", lw=1, label=text)
    axes.set_xscale("log")
    if measured == "wpe":
        axes.set_yscale("log")
    axes.set_xlabel("batches")
    axes.set_ylabel(measured.replace("wpe", "WPE"))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return fig


def _measured(checks: CheckResults, name: str) -> str:
    """Return what a check found, as text."""
    value = getattr(checks, name)
    if name == "null":
        return "skill " + ", ".join(f"{skill:.2g} at h = {h}" for h, skill in value.items())
    if value is None:
        return "its basis needs more directions" if name == "drift" else "no such units"
    if isinstance(value, bool):
        return "the same bits" if value else "other bits"
    return f"error {value:.2g}"


def _settings(metrics: Metrics) -> dict[str, dict[str, Any]]:
    """Return the settings of the training, and of that of the network before it."""
    own = {k: value for k, value in metrics.settings.items() if value not in ([], None)}
    before = own.pop("of_gate", {})
    return {" of the network": before, " of the amplitudes": own} if before else {"": own}


def _commands(metrics: Metrics) -> str:
    commands = []
    given = {what: " ".join(map(_option, x.items())) for what, x in _settings(metrics).items()}
    data = " ".join(trained.data for trained in metrics.trained_on)
    kind = registry.kinds().get(metrics.kind)
    if metrics.trained_on and metrics.kind == "drift":
        of_network, of_amplitudes = given.values()
        commands += [
            f"tipl train gate --data {data} --out GATE {of_network}",
            f"tipl train stretched --along GATE --data {data} --out FOLDER {of_amplitudes}",
        ]
    elif metrics.trained_on and kind is not None and kind.command:
        commands.append(f"tipl train {kind.command} --data {data} --out FOLDER {given['']}")
    commands += _fits(metrics)
    return "\n".join(["```bash", *map(code, (*commands, metrics.results.command)), "```"])


def _fits(metrics: Metrics) -> Iterator[str]:
    """Yield the commands that make the baselines, in the folders that the evaluation reads."""
    words = metrics.results.command.split()
    read = [Path(word) for word in words[2 : words.index("--data")]] if "--data" in words else []
    data = metrics.results.data
    # Every folder of fitted baselines has both of these.
    fitted = [f for f in read if f.name in (PERSISTENCE, "ar-20-phase") and str(f) != f.name]
    folders = list(dict.fromkeys(folder.parent for folder in fitted))
    yield from (f"tipl train baselines --data {data} --out {made}" for made in folders)
    for folder in read:
        along = folder.name.rpartition("-")[0]
        if folder.name.endswith(STRETCHED) and folders:
            yield f"tipl train stretched --along {folders[0] / along} --data {data} --out {folder}"


def _option(setting: tuple[str, Any]) -> str:
    key, value = setting
    if isinstance(value, bool):
        return f"--{'' if value else 'no-'}{key.replace('_', '-')}"
    values = value if isinstance(value, list) else [value]
    return f"--{key.replace('_', '-')} {' '.join(map(str, values))}"
