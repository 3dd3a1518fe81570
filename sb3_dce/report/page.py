"""The page: one HTML file without scripts, styles or pictures from elsewhere. Every text from a file is escaped."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

import sb3_dce
from sb3_dce.data.catalog import is_id, normalized_score
from sb3_dce.data.examination import VERDICTS, Check, Examination, examine, file_hash
from sb3_dce.data.hdf5 import D4RLFile
from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import ConfigError, DatasetError
from sb3_dce.files import write_text
from sb3_dce.report.advice import Advice, advise
from sb3_dce.report.behaviour import Behaviour, estimate_behaviour
from sb3_dce.report.figures import Plot, draw_all

# By this line a file is known for a report, which may be replaced without asking.
MARKER = '<meta name="generator" content="sb3-dce datasets report">'
MARKER_WITHIN = 1_000
MAX_ATTRIBUTES, MAX_ATTRIBUTE_LENGTH = 30, 300

_CSS = """
:root { color-scheme: light dark; --page: #ffffff; --card: #f6f7f9; --ink: #1d2430; --soft: #5a6575; --grid: #dde1e7;
  --main: #2f6fde; --accent: #d9730d; --ok: #1a7f37; --note: #0969a8; --warning: #9a6200; --error: #c2261c; }
@media (prefers-color-scheme: dark) { :root { --page: #14181f; --card: #1d232d; --ink: #e4e8ee; --soft: #a0abba;
  --grid: #343c49; --main: #6ea0ff; --accent: #f0a04b; --ok: #56c271; --note: #5cb3ee; --warning: #e0b040;
  --error: #ff8077; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1rem 3rem; max-width: 72rem; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif; }
h1 { margin: 0 0 .25rem; font-size: 1.6rem; overflow-wrap: anywhere; }
h2 { margin: 2rem 0 .75rem; font-size: 1.2rem; }
h3 { margin: 0 0 .25rem; font-size: 1rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(10.5rem, 1fr)); gap: .5rem; margin: 1rem 0 0; }
.facts div { background: var(--card); border-radius: 8px; padding: .5rem .75rem; }
.facts dt { color: var(--soft); font-size: .8rem; }
.facts dd { margin: 0; font-weight: 600; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
.source, figcaption, footer { color: var(--soft); font-size: .85rem; overflow-wrap: anywhere; }
.source { margin-top: .75rem; }
.source p { margin: .2rem 0; }
a { color: var(--main); }
.advice { margin: 0; padding: 0; list-style: none; }
.advice li { display: grid; grid-template-columns: 9.5rem 1fr; gap: .75rem; padding: .5rem 0;
  border-top: 1px solid var(--grid); }
.advice b { font-family: ui-monospace, "Liberation Mono", monospace; font-size: .9rem; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(25rem, 100%), 1fr)); gap: 1rem; }
figure { margin: 0; padding: .75rem; background: var(--card); border-radius: 8px; }
figure.wide { grid-column: 1 / -1; }
figure svg { display: block; width: 100%; height: auto; }
figure svg text { font-family: inherit !important; }
.scroll { overflow-x: auto; }
table { width: 100%; border-collapse: collapse; font-size: .9rem; }
th, td { padding: .4rem .6rem .4rem 0; border-top: 1px solid var(--grid); text-align: left; vertical-align: top; }
th { color: var(--soft); font-weight: 600; }
td { overflow-wrap: anywhere; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
.verdict { font-weight: 700; }
.verdict, .name { white-space: nowrap; }
.ok { color: var(--ok); } .note { color: var(--note); } .warning { color: var(--warning); } .error { color: var(--error); }
.remedy { color: var(--soft); }
@media (max-width: 40rem) { .advice li { grid-template-columns: 1fr; gap: 0; } }
"""


def write_report(
    name_or_path: str | PathLike[str],
    out: Path | None = None,
    *,
    force: bool = False,
    beta: float | None = None,
    **options: Any,
) -> tuple[Path, Examination]:
    """
    Examine a dataset and write the page about it.

    :param name_or_path: see :func:`~sb3_dce.data.loading.load_transitions`
    :param out: file to write, default ``<name>-report.html`` in the current folder
    :param force: replace a file that is no report
    :param beta: penalty weight of the survival condition, default that of the dataset's row
    :param options: see :func:`~sb3_dce.data.loading.load_transitions`
    :return: the file, and the examination
    :raises DatasetError: if the data cannot be used as asked for; nothing is written
    :raises ConfigError: if the file exists and is no report, or matplotlib is not installed
    """
    if out is not None:
        _require_replaceable(out, force)
    examination = examine(name_or_path, beta=beta, **options)
    if examination.error is not None:
        raise examination.error
    assert examination.transitions is not None
    if out is None:
        name = re.sub(r"[^\w.-]+", "-", examination.transitions.info.id)  # ids of Minari have slashes
        out = Path(f"{name}-report.html")
        _require_replaceable(out, force)
    page = build_page(examination)
    write_text(out, page)
    return out, examination


def build_page(examination: Examination) -> str:
    """
    Facts, advice, plots and checks of a dataset as one HTML text; the behaviour policy is estimated here.

    :param examination: of data that can be used
    :return: the HTML page
    :raises ConfigError: if matplotlib is not installed
    """
    transitions = examination.transitions
    assert transitions is not None
    behaviour = estimate_behaviour(transitions)
    plots = draw_all(transitions, behaviour)
    title = escape(transitions.info.id)
    sections = (
        _header(transitions),
        _source(transitions),
        _verdict(examination, advise(transitions, examination.penalty, behaviour)),
        _plots(plots),
        _checks(examination.checks),
        _footer(behaviour),
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n{MARKER}\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}: dataset report</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        + "\n".join(sections)
        + "\n</body>\n</html>\n"
    )


def _require_replaceable(out: Path, force: bool) -> None:
    if out.is_dir():
        raise ConfigError("is a folder", where=str(out), hint="Name a file, such as report.html.", key="--out")
    if out.exists() and not force:
        with out.open("rb") as stream:
            head = stream.read(MARKER_WITHIN).decode("utf-8", errors="replace")
        if MARKER not in head:
            raise ConfigError(
                "this file exists and is not a dataset report",
                where=str(out),
                hint="Choose another name with --out, or replace it with --force.",
                key="--out",
            )


def _header(transitions: Transitions) -> str:
    info = transitions.info
    returns, lengths = info.episode_returns, info.episode_lengths
    facts: dict[str, str] = {
        "transitions": f"{info.rows:,}",
        "rows of the file": f"{info.file_rows:,}",
        "whole episodes": f"{info.episodes:,}",
        "observation / action": f"{transitions.obs_shape[0]} / {transitions.act_dim}",
        "true terminals": f"{info.n_terminals:,}",
        "ends without one": f"{info.n_timeouts:,}",
        "reward per step": f"{info.reward_mean:.4g} ({info.reward_min:.3g} to {info.reward_max:.3g})",
    }
    if len(returns):
        facts["return, mean"] = f"{returns.mean():,.1f}"
        facts["return, range"] = f"{returns.min():,.1f} to {returns.max():,.1f}"
        span = f" ({lengths.min():,} to {lengths.max():,})" if lengths.min() < lengths.max() else ""
        facts["episode length"] = f"{lengths.mean():,.0f}{span}"
        score = _score(info.id, float(returns.mean()))
        if score is not None:
            facts["mean score (D4RL)"] = f"{score:.1f}"
    items = "\n".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in facts.items())
    return f'<h1>{escape(info.id)}</h1>\n<dl class="facts">\n{items}\n</dl>'


def _score(dataset_id: str, value: float) -> float | None:
    return float(normalized_score(dataset_id, value)) if is_id(dataset_id) else None  # an alias is no claim


def _source(transitions: Transitions) -> str:
    info = transitions.info
    lines = [f"Ends of episodes: {info.episode_rule}."]
    if info.path is not None:
        lines = [f"File: {info.path}", f"SHA-256: {file_hash(info) or 'none, the file has gone'}", *lines]
    text = "\n".join(f"<p>{escape(line)}</p>" for line in lines)
    attributes = _attributes(info.path)
    if attributes:
        rows = "\n".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in attributes.items())
        table = f'<div class="scroll"><table>{rows}</table></div>'
        text += f"\n<details><summary>What the file says of itself</summary>{table}</details>"
    return f'<div class="source">\n{text}\n</div>'


def _attributes(path: Path | None) -> Mapping[str, str]:
    """Attributes of the root of an HDF5 file as short texts."""
    if path is None or not path.is_file() or path.suffix.lower() in (".npz", ".csv", ".parquet"):
        return {}
    try:
        with D4RLFile(path) as file:
            found = file.attributes()
    except DatasetError:  # a file of another layout, such as Minari's, whose groups can be many
        return {}
    texts = {}
    for name, value in list(found.items())[:MAX_ATTRIBUTES]:
        text = value.decode("utf-8", errors="replace") if isinstance(value, bytes) else str(value)
        texts[name] = text if len(text) <= MAX_ATTRIBUTE_LENGTH else text[:MAX_ATTRIBUTE_LENGTH] + " ..."
    return texts


def _verdict(examination: Examination, advice: Iterable[Advice]) -> str:
    counts = {verdict: sum(check.verdict == verdict for check in examination.checks) for verdict in VERDICTS}
    parts = [
        f"{counts[v]} {v if v == 'ok' or counts[v] == 1 else v + 's'}"
        for v in reversed(VERDICTS)
        if counts[v] or v == "warning"
    ]
    items = "\n".join(f"<li><b>{escape(item.topic)}</b><span>{escape(item.text)}</span></li>" for item in advice)
    return (
        f'<h2>What these data ask for</h2>\n<ul class="advice">\n{items}\n</ul>\n'
        f'<p>Checks: <span class="verdict {examination.verdict}">{escape(", ".join(parts))}</span> '
        '(<a href="#checks">table below</a>)</p>'
    )


def _plots(plots: Iterable[Plot]) -> str:
    figures = "\n".join(
        f"<figure{' class=wide' if plot.wide else ''}><h3>{escape(plot.title)}</h3>\n{plot.svg}\n"
        f"<figcaption>{escape(plot.caption)}</figcaption></figure>"
        for plot in plots
    )
    return f'<h2>Plots</h2>\n<div class="plots">\n{figures}\n</div>'


def _checks(checks: Iterable[Check]) -> str:
    worst_first = sorted(checks, key=lambda check: -VERDICTS.index(check.verdict))
    rows = "\n".join(
        f'<tr><td class="verdict {check.verdict}">{check.verdict}</td><td class="name">{escape(check.name)}</td>'
        f'<td>{_details(check)}</td><td class="number">{"" if check.count is None else f"{check.count:,}"}</td></tr>'
        for check in worst_first
    )
    return (
        '<h2 id="checks">All checks, the worst first</h2>\n<div class="scroll"><table>\n'
        f"<tr><th>verdict</th><th>check</th><th>what was found</th><th>number</th></tr>\n{rows}\n</table></div>"
    )


def _details(check: Check) -> str:
    text = escape(check.what)
    if check.where:
        text += f"<br>Where: {escape(check.where)}"
    if check.remedy:
        text += f'<br><span class="remedy">Remedy: {escape(check.remedy)}</span>'
    return text


def _footer(behaviour: Behaviour | None) -> str:
    limits = (
        "Randomness and mixing of the behaviour policy come from pairs of near states of different episodes, extrapolated to "
        "distance 0 (gamma test). In many dimensions near states are far, which makes the estimate somewhat high, and what "
        "the observation does not show counts as randomness. "
        if behaviour is not None
        else ""
    )
    return f"<footer><p>{escape(limits)}Made by sb3_dce {escape(sb3_dce.__version__)}. No scripts, no network.</p></footer>"
