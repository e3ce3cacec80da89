"""The card of a released model: prose by hand, and what ``metrics.json`` says between markers.

A card is made once from a template of the model's kind. From then on its prose is its author's, and
``tipl card`` rewrites only the places that begin with ``<!-- facts of NAME, SECTION: ... -->``. A
section brings its heading, so that what was not measured leaves no empty one.

| section | what it says |
|---|---|
| ``summary`` | data, cadence, runs that it was trained and evaluated on |
| ``baselines`` | its figures beside those of persistence, the oracle and the best baselines |
| ``checks`` | the five checks |
| ``training`` | settings and the error while it was trained |
| ``commands`` | how the results were made |
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2
import msgspec
from matplotlib.figure import Figure

from tipl import registry
from tipl.errors import ModelError
from tipl.report.figures import svg
from tipl.report.markdown import rewrite, table_lines
from tipl.report.scores import PERSISTENCE, oracles, row_at, wpe
from tipl.report.tables import headline, label
from tipl.report.verdict import verdict
from tipl.zoo.metrics import Metrics, read_metrics

_TESTS = {
    "null": "random walks: skill is 0",
    "causality": "the future moves no bit",
    "permutation": "hidden units in another order",
    "sign": "hidden units with the other sign",
    "scale": "steps twice as long",
    "drift": "a straight line",
}


def write_card(name: str, out: Path) -> Path:
    """Write a model's card, or what comes from its figures into the card that is there.

    Args:
        name: in the zoo.
        out: folder of the cards.

    Returns:
        The card.

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
    """What is known of a released model.

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
    """A card from the template of its kind, or from the one for all; its places are empty."""
    loader = jinja2.PackageLoader("tipl", "templates")
    environment = jinja2.Environment(  # noqa: S701  Markdown, from our own templates
        loader=loader, trim_blocks=True, keep_trailing_newline=True
    )
    wanted = [f"card-{metrics.kind}.md", "card.md"]
    return environment.select_template(wanted).render(metrics=metrics)


def refreshed(card: str, metrics: Metrics) -> str:
    """Return the card with its places rewritten."""
    return rewrite(card, "facts", metrics.name, lambda section: facts(metrics, section))


def facts(metrics: Metrics, section: str) -> str:
    """One section as Markdown, empty if there is nothing to say.

    Raises:
        ModelError: there is no such section.
    """
    if section not in _SECTIONS:
        raise ModelError(
            "there is no such section of a card",
            expected=", ".join(_SECTIONS),
            got=section,
            where=metrics.name,
            do="change the marker in the card",
        )
    return _SECTIONS[section](metrics)


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


def _summary(metrics: Metrics) -> str:
    results = metrics.results
    causal = "yes" if metrics.causal else "**no**: it has seen the future of the run"
    lines = [f"- kind: `{metrics.kind}`; causal: {causal}"]
    for trained in metrics.trained_on:
        made = " by ".join(x for x in (trained.environment, trained.algorithm) if x)
        lines += [
            f"- trained on: `{trained.data}`, version {trained.version}, "
            f"{len(trained.runs)} runs: {', '.join(trained.runs)}",
            f"- policies: {trained.parameters:,} parameters{f', {made}' if made else ''}",
        ]
        if trained.every is not None:
            lines.append(f"- cadence: a snapshot every {trained.every} gradient steps")
    return "\n".join(
        [
            *lines,
            f"- evaluated on: `{results.data}`, version {results.version}, "
            f"{len(results.runs)} {results.split} runs: {', '.join(results.runs)}",
        ]
    )


def _baselines(metrics: Metrics) -> str:
    table, results = headline(metrics.results), metrics.results
    own = {name: results.forecasters[name] for name in (PERSISTENCE, metrics.evaluated_as)}
    alone = msgspec.structs.replace(results, forecasters=own)
    told = verdict(alone) if registry.is_model(metrics.kind) else ""
    note = (
        "95 % intervals: bootstrap over runs; what another training would give is not in them. "
        "Skill: 0 is persistence, 1 the truth. Of the baselines the best ones are shown."
    )
    if results.modes:
        note += (
            " Gain: of the return that training earns in h snapshots, with the exploration noise "
            "of the start."
        )
    text = "\n".join(["## How well", "", *table_lines(table), "", note])
    return f"{text}\n\n{told}" if told else text


def _checks(metrics: Metrics) -> str:
    checks = metrics.checks
    if checks is None:
        return ""
    null = ", ".join(f"{skill:.2g} at h = {h}" for h, skill in checks.null.items())
    lines = ["## Five checks", "", "| check | measured | passes |", "|---|---|---|"]
    for name, meaning in _TESTS.items():
        shown = f"skill {null}" if name == "null" else _measured(name, getattr(checks, name))
        lines.append(f"| {meaning} | {shown} | {'yes' if checks.passed[name] else 'no'} |")
    limits = checks.largest
    batches = "" if metrics.kind == "regression" else f", for {checks.batches:,} batches"
    again = (
        f"For the random walks one like it was fitted to {checks.walks - 2} others{batches}. "
        if checks.fitted_to_walks
        else ""
    )
    lines += [
        "",
        f"{again}A skill passes below {limits.null} either way, an error, relative to the "
        f"displacement, below {limits.error}. On run `{checks.run}`: `{checks.command}`",
    ]
    return "\n".join(lines)


def _measured(name: str, value: object) -> str:
    if value is None:
        return "its basis needs more directions" if name == "drift" else "no such units"
    if isinstance(value, bool):
        return "the same bits" if value else "other bits"
    return f"error {value:.2g}"


def _training(metrics: Metrics) -> str:
    if not metrics.settings and not metrics.log:
        return ""
    lines = ["## Training"]
    for what, settings in _settings(metrics).items():
        if settings:
            told = ", ".join(f"{k} {v}" for k, v in settings.items())
            lines += ["", f"Settings{what}: {told}"]
    if metrics.kind == "drift":
        lines += ["", *_amplitudes(metrics)]
    elif metrics.log:
        lines += ["", _errors(metrics), "", f"![error against batches]({metrics.name}.svg)"]
    return "\n".join(lines)


def _settings(metrics: Metrics) -> dict[str, dict[str, Any]]:
    """Of the training, and of that of the network before it."""
    own = {k: value for k, value in metrics.settings.items() if value not in ([], None)}
    before = own.pop("of_gate", {})
    return {" of the network": before, " of the amplitudes": own} if before else {"": own}


def _amplitudes(metrics: Metrics) -> list[str]:
    """Gains on validation runs, of each amplitude at each horizon; the highest are bold."""
    horizons = [key.removeprefix("gain_") for key in metrics.log[0] if key.startswith("gain_")]
    best = {h: max(line[f"gain_{h}"] for line in metrics.log) for h in horizons}
    lines = [
        "Inference gain on validation runs, with the exploration noise of the start:",
        "",
        "| amplitude | " + " | ".join(f"h = {h}" for h in horizons) + " |",
        "|---:|" + "---:|" * len(horizons),
    ]
    for line in metrics.log:
        cells = (
            f"**{gain:.2f}**" if (gain := line[f"gain_{h}"]) == best[h] else f"{gain:.2f}"
            for h in horizons
        )
        lines.append(f"| {line['amplitude']:g} | {' | '.join(cells)} |")
    return lines


def _errors(metrics: Metrics) -> str:
    """Where the training ended."""
    last = metrics.log[-1]
    key = "wpe" if "wpe" in last else "error"
    found = [f"{last[key]:.3g} on training runs"]
    if (held_out := f"validation_{key}") in last:
        found.append(f"{last[held_out]:.3g} on validation runs")
    after = f"After {last['batch']:,.0f} batches, "
    if key == "error":
        return after + (
            "the squared error over that of persistence, a mean over starts and horizons, is "
            f"{' and '.join(found)}. The state that is best on validation runs is kept."
        )
    first = metrics.results.forecasters[PERSISTENCE].wpe[0]
    return after + (
        f"WPE is {' and '.join(found)}; that of persistence, h = {first.h}, on the evaluated "
        f"runs, is {first.value or 0:.3g}."
    )


def _commands(metrics: Metrics) -> str:
    commands = []
    given = {what: " ".join(map(_option, x.items())) for what, x in _settings(metrics).items()}
    data = " ".join(trained.data for trained in metrics.trained_on)
    kind = registry.kinds().get(metrics.kind)
    if metrics.trained_on and metrics.kind == "drift":
        of_network, of_amplitudes = given.values()
        commands += [
            f"tipl train gate --data {data} --out GATE {of_network}",
            f"tipl train scaled --along GATE --data {data} --out FOLDER {of_amplitudes}",
        ]
    elif metrics.trained_on and kind is not None and kind.command:
        commands.append(f"tipl train {kind.command} --data {data} --out FOLDER {given['']}")
    return "\n".join(["```bash", *commands, metrics.results.command, "```"])


def _option(setting: tuple[str, Any]) -> str:
    key, value = setting
    if isinstance(value, bool):
        return f"--{'' if value else 'no-'}{key.replace('_', '-')}"
    values = value if isinstance(value, list) else [value]
    return f"--{key.replace('_', '-')} {' '.join(map(str, values))}"


_SECTIONS: dict[str, Callable[[Metrics], str]] = {
    "summary": _summary,
    "baselines": _baselines,
    "checks": _checks,
    "training": _training,
    "commands": _commands,
}
