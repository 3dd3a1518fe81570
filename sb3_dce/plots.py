"""Learning curves. matplotlib is an extra: without it nothing is drawn and nothing fails."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_dce.evaluation import Evaluation
from sb3_dce.student import mean_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = [f"C{i}" for i in range(10) if i != 7]  # that one is grey
# Of more agents each has a panel of its own.
MOST_TOGETHER = 5


def plot_learning_curves(
    curves: dict[str, list[list[Evaluation]]],
    path: Path,
    title: str,
    levels: dict[str, float] | None = None,
    confidence: bool = False,
) -> Path | None:
    """
    Normalised score (or return, without reference scores) against gradient steps: mean over seeds, each seed thin.

    :param curves: per agent, per seed, the evaluations; a seed without any is left out
    :param path: picture to write
    :param title: heading
    :param levels: horizontal lines in the same units, by name
    :param confidence: shade the 95 % confidence interval of the mean (Student's t) from three seeds on, instead of the range
    :return: ``path``, or ``None`` without matplotlib or without any evaluation
    """
    # the mean goes as far as the shortest
    curves = {name: evaluated for name, seeds in curves.items() if (evaluated := [seed for seed in seeds if seed])}
    if not curves:
        return None
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return None
    scored = all(e.score is not None for seeds in curves.values() for seed in seeds for e in seed)
    agents = [_Agent(name, COLORS[i % len(COLORS)], seeds, scored) for i, (name, seeds) in enumerate(curves.items())]
    together = len(agents) <= MOST_TOGETHER
    columns = 1 if together else min(MOST_TOGETHER, -(-len(agents) // 2))
    lines = 1 if together else -(-len(agents) // columns)
    # no pyplot: no window system is touched
    figure = Figure(figsize=(7.0, 4.2) if together else (2.9 * columns, 2.8 * lines), layout="constrained")
    first = None
    for number in range(1 if together else len(agents)):
        axes = first = figure.add_subplot(lines, columns, number + 1, sharex=first, sharey=first)
        if not together:  # all bands in one picture would hide each other
            for agent in agents:
                axes.plot(agent.steps, agent.mean, color="0.8", linewidth=0.8)
        for agent in agents if together else [agents[number]]:
            agent.draw(axes, confidence)
        for style, (name, level) in zip(cycle(("--", ":", "-.")), (levels or {}).items(), strict=False):
            axes.axhline(level, color="0.3", linestyle=style, linewidth=1.0, label=name)
        axes.grid(alpha=0.3)
        axes.label_outer()
        if together:
            axes.legend(loc="best", fontsize=8)
        else:
            axes.set_title(agents[number].label, fontsize=9, color=agents[number].color)
    figure.supxlabel("gradient steps", fontsize=10)
    figure.supylabel("normalised score" if scored else "return", fontsize=10)
    others = ", ".join(["grey: the other agents", *([f"dashed: {', '.join(levels)}"] if levels else [])])
    figure.suptitle(title if together else f"{title} ({others})", fontsize=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    return path


class _Agent:
    """Curves of one agent."""

    def __init__(self, name: str, color: str, seeds: list[list[Evaluation]], scored: bool) -> None:
        self.color = color
        self.seeds = [([e.n_updates for e in seed], [_value(e, scored) for e in seed]) for seed in seeds]
        self.steps = sorted(set.intersection(*(set(steps) for steps, _ in self.seeds)))
        common = [[value for step, value in zip(*seed, strict=True) if step in self.steps] for seed in self.seeds]
        self.values = np.array(common)
        self.mean = self.values.mean(axis=0)
        self.label = f"{name} (mean of {len(seeds)} seeds)" if len(seeds) > 1 else name

    def draw(self, axes: Axes, confidence: bool) -> None:
        n = len(self.seeds)
        for steps, values in self.seeds:
            axes.plot(steps, values, color=self.color, alpha=0.3, linewidth=0.8)
        axes.plot(self.steps, self.mean, color=self.color, linewidth=2.0, label=self.label)
        if n > 1:
            inside = confidence and n > 2
            low, high = mean_interval(self.values) if inside else (self.values.min(axis=0), self.values.max(axis=0))
            axes.fill_between(self.steps, low, high, color=self.color, alpha=0.15, linewidth=0)


def _value(evaluation: Evaluation, scored: bool) -> float:
    return evaluation.score if scored and evaluation.score is not None else evaluation.mean
