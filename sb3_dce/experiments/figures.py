"""Figures made from rows, with the paper's axes: epochs (1000 gradient steps) against return, Q, gap or alpha."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sb3_dce.data.catalog import resolve
from sb3_dce.errors import ConfigError
from sb3_dce.experiments.curves import panel_curves, variants_of, view_of
from sb3_dce.experiments.evidence import UPDATES_PER_EPOCH, Evidence
from sb3_dce.experiments.grid import Panel, planned_id
from sb3_dce.experiments.readings import mean_line
from sb3_dce.experiments.statistics import performance_profile
from sb3_dce.experiments.tables import common_rows, compared, n_diverged

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LABELS = {
    "score": "normalised score",
    "q_data": "mean Q on the data",
    "gap_td": r"Q - (r + $\gamma$V - $\beta_{eff}$): gap_td",
    "gap_ref": r"$Q_\beta$ - $Q_0$ + F(n) $\beta_{eff}$: gap_ref",
    "ent_coef": r"$\alpha$",
    "q_shift": r"$Q_0$ - $Q_\beta$ on the data",
    "v_shift": r"$V_0$ - $V_\beta$ on the data",
    "probe_policy": r"$Q_\beta(s, a_\pi)$ - $Q_0(s, a_\pi)$",
    "probe_max": "max OOD Q - in-data Q",
    "probe_min": "min OOD Q - in-data Q",
    "probe_rank": r"rank correlation of $Q_\beta - V_\beta$ with another $Q_0 - V_0$",
}
WIDTH, HEIGHT, COLUMNS = 4.6, 4.2, 3
SMALLEST_RANGE = 10.0  # of an axis of scores


def draw(evidence: Evidence, folder: Path, name: str) -> list[Path]:
    """
    One picture of all panels of a figure; at smoke scale those of other sets than the grid's first are left out.

    :param evidence: of an experiment with panels
    :param folder: where the pictures are written
    :param name: of the files, without ending
    :return: PNG and SVG file
    :raises ConfigError: without matplotlib
    """
    panels = evidence.experiment.panels
    if evidence.scale.source == "embedded":
        first = evidence.experiment.datasets[0].paper
        panels = tuple(p for p in panels if p.dataset in (None, first))
    columns = {4: 2, 7: 4, 8: 4}.get(len(panels), min(COLUMNS, len(panels)))
    lines = -(-len(panels) // columns)
    figure = _figure(WIDTH * columns, HEIGHT * lines)
    for number, panel in enumerate(panels):
        _panel(evidence, panel, figure.add_subplot(lines, columns, number + 1))
    return _save(figure, folder, name)


def draw_profile(evidence: Evidence, part: str, folder: Path, name: str) -> list[Path]:
    """
    Performance profile: the share of runs above a score, mean over the data sets on which all agents have runs.

    :param evidence: of a table
    :param part: of the table, one of :func:`~sb3_dce.experiments.tables.parts_of`
    :param folder: where the pictures are written
    :param name: of the files, without ending
    :return: PNG and SVG file; none if every agent diverged on a seed
    :raises ConfigError: without matplotlib
    """
    ids = common_rows(evidence, part)
    whole = [v for v in compared(evidence, ids) if not n_diverged(evidence, v, ids)]
    if not whole:
        return []
    figure = _figure(1.5 * WIDTH, HEIGHT)
    axes = figure.add_subplot()
    scores = {v.name: [evidence.last(v, i) for i in ids] for v in whole}
    every = np.concatenate([task for tasks in scores.values() for task in tasks])
    thresholds = np.linspace(min(0.0, every.min()), max(100.0, every.max()), 201)
    for number, (agent, tasks) in enumerate(scores.items()):
        share = performance_profile(tasks, thresholds)
        axes.step(thresholds, share, color=f"C{number}", linewidth=1.4, label=agent)
    axes.set(xlabel="normalised score", ylabel="share of runs above it (mean over data)", ylim=(-0.02, 1.02))
    axes.set_title(
        f"{len(ids)} data set{'s' if len(ids) > 1 else ''}, {'D4RL' if part.startswith('D4RL') else 'made with this package'}",
        fontsize=10,
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return _save(figure, folder, name)


def _figure(width: float, height: float) -> Figure:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError("figures need matplotlib", key="matplotlib", hint='pip install "sb3_dce[plots]"') from None
    return Figure(figsize=(width, height), layout="constrained")  # no pyplot: no window system is touched


def _save(figure: Figure, folder: Path, name: str) -> list[Path]:
    from matplotlib import rc_context

    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.{ending}" for ending in ("png", "svg")]
    with rc_context({"svg.hashsalt": name}):  # fixed identifiers: the same rows give the same file
        for path in paths:
            metadata = {"Software": None} if path.suffix == ".png" else {"Date": None, "Creator": None}
            figure.savefig(path, dpi=110, metadata=metadata)
    return paths


def _panel(evidence: Evidence, panel: Panel, axes: Axes) -> None:
    curves = panel_curves(evidence, panel)
    colors = _colors(evidence, panel, list(curves))
    evidence = view_of(evidence, panel)
    for number, (name, (curve, theory)) in enumerate(curves.items()):
        color = colors[name]
        if curve.shape[1] > 1:
            for _, seed in curve.items():
                _plot(axes, seed.dropna(), color=color, alpha=0.25, linewidth=0.7)
        label = f"{name} ({curve.shape[1]} seeds)" if curve.shape[1] > 1 else name
        width = 2.4 - 1.2 * number / max(1, len(curves) - 1)  # what lies below another line can be seen
        _plot(axes, mean_line(curve), color=color, linewidth=width, label=label)
        if theory is not None:
            _plot(axes, theory, color=color, linestyle="--", linewidth=1.0, label=f"{name}, theory")
    axes.set_xlabel("epoch (1000 gradient steps)")
    axes.set_ylabel(LABELS[panel.metric], fontsize=9)
    axes.set_title(", ".join(part for part in (_data_title(evidence, panel), panel.title) if part), fontsize=10)
    if panel.metric in ("gap_td", "gap_ref"):
        axes.axhline(0.0, color="0.4", linewidth=0.8)
    if panel.scale != "linear":
        axes.set_yscale(panel.scale)
    axes.grid(alpha=0.3)
    if panel.metric == "score" and curves:
        _keep_failures_small(axes)
        if (dataset_id := evidence.id_of(panel.dataset)) is not None:
            _add_returns(axes, dataset_id)
    if curves:
        for name in _missing(evidence, panel, curves):
            axes.plot([], [], linestyle="none", label=f"{name}: no curve")
        # below: inside, it would hide the beginning of a curve
        axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, frameon=False)
    else:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, _absence(evidence, panel), ha="center", va="center", transform=axes.transAxes, color="0.4")


def _plot(axes: Axes, line: pd.Series, **settings: Any) -> None:
    axes.plot(np.asarray(line.index) / UPDATES_PER_EPOCH, line.to_numpy(), **settings)


def _keep_failures_small(axes: Axes) -> None:
    """Scores of agents that fail, stretched over the whole axis, would look like those of agents that learn."""
    low, high = axes.get_ylim()
    if high - low < SMALLEST_RANGE:
        middle = (low + high) / 2.0
        axes.set_ylim(middle - SMALLEST_RANGE / 2.0, middle + SMALLEST_RANGE / 2.0)


def _add_returns(axes: Axes, dataset_id: str) -> None:
    """The paper's axis, on the right of the scores."""
    spec = resolve(dataset_id)
    low, span = spec.ref_min_score, spec.ref_max_score - spec.ref_min_score

    def to_return(score: Any) -> Any:
        return low + span * score / 100.0

    def to_score(value: Any) -> Any:
        return 100.0 * (value - low) / span

    axes.secondary_yaxis("right", functions=(to_return, to_score)).set_ylabel("return", fontsize=9)


def _colors(evidence: Evidence, panel: Panel, lines: list[str]) -> dict[str, str]:
    """A variant has one colour in all panels, and so has a beta of the probe."""
    betas = sorted({beta for other in evidence.experiment.panels for beta in other.lines})
    order = lines if panel.over else [f"beta {beta:g}" for beta in betas] if panel.lines else []
    order = order or [v.name for v in evidence.experiment.variants]
    return {name: f"C{order.index(name) % 10}" for name in lines}


def _data_title(evidence: Evidence, panel: Panel) -> str | None:
    """Id of the data shown; without runs that of those the scale would take."""
    if panel.over:
        return None
    return evidence.id_of(panel.dataset) or planned_id(evidence.entry(panel.dataset), evidence.scale.source)


def _missing(evidence: Evidence, panel: Panel, curves: dict[str, tuple[pd.DataFrame, pd.Series | None]]) -> list[str]:
    """Lines that belong to a panel and have no runs of its length."""
    if panel.over:
        entries = [evidence.entry(paper) for paper in panel.over if evidence.id_of(paper) not in curves]
        planned = dict.fromkeys(planned_id(entry, evidence.scale.source) for entry in entries)
        return [name for name in planned if name not in curves]  # at smoke scale one file stands for all
    if panel.lines:
        return []
    return [name for name in variants_of(evidence, panel) if name not in curves]


def _absence(evidence: Evidence, panel: Panel) -> str:
    experiment = evidence.experiment
    shown = [experiment.dataset(name) for name in panel.over or (panel.dataset or experiment.datasets[0].paper,)]
    return " / ".join(dict.fromkeys(dataset.absence for dataset in shown))
