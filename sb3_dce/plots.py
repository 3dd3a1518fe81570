"""Learning curves. matplotlib is an extra: without it nothing is drawn and nothing fails."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sb3_dce.evaluation import Evaluation
from sb3_dce.student import mean_interval

# Names of more lines than this stand beside the picture.
MOST_INSIDE = 5


def plot_learning_curves(
    curves: dict[str, list[list[Evaluation]]],
    path: Path,
    title: str,
    levels: dict[str, float] | None = None,
    confidence: bool = False,
) -> Path | None:
    """
    Normalised score (or return, without reference scores) against gradient steps: mean over seeds, each seed thin.

    :param curves: per agent, per seed, the evaluations
    :param path: picture to write
    :param title: heading
    :param levels: horizontal lines in the same units, by name
    :param confidence: shade the 95 % confidence interval of the mean (Student's t) from three seeds on, instead of the range
    :return: ``path``, or ``None`` without matplotlib or without any evaluation
    """
    if not any(seed for seeds in curves.values() for seed in seeds):
        return None
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return None
    wide = len(curves) + len(levels or {}) > MOST_INSIDE
    figure = Figure(figsize=(9.0 if wide else 7.0, 4.2), layout="constrained")  # no pyplot: no window system is touched
    axes = figure.add_subplot()
    scored = all(e.score is not None for seeds in curves.values() for seed in seeds for e in seed)
    for number, (name, seeds) in enumerate(curves.items()):
        color = f"C{number}"
        for seed in seeds:
            axes.plot([e.n_updates for e in seed], [_value(e, scored) for e in seed], color=color, alpha=0.3, linewidth=0.8)
        steps = sorted(set.intersection(*({e.n_updates for e in seed} for seed in seeds)))
        values = np.array([[_value(e, scored) for e in seed if e.n_updates in steps] for seed in seeds])
        label = f"{name} (mean of {len(seeds)} seeds)" if len(seeds) > 1 else name
        axes.plot(steps, values.mean(axis=0), color=color, linewidth=2.0, label=label)
        if len(seeds) > 1:
            low, high = mean_interval(values) if confidence and len(seeds) > 2 else (values.min(axis=0), values.max(axis=0))
            axes.fill_between(steps, low, high, color=color, alpha=0.15, linewidth=0)
    for number, (name, level) in enumerate((levels or {}).items()):
        axes.axhline(level, color="0.3", linestyle=("--", ":", "-.")[number % 3], linewidth=1.0, label=name)
    axes.set_xlabel("gradient steps")
    axes.set_ylabel("normalised score" if scored else "return")
    axes.set_title(title)
    axes.grid(alpha=0.3)
    if wide:
        figure.legend(loc="outside right upper", fontsize=8)
    else:
        axes.legend(loc="best", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    return path


def _value(evaluation: Evaluation, scored: bool) -> float:
    return evaluation.score if scored and evaluation.score is not None else evaluation.mean
