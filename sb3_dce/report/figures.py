"""
Plots of a dataset as SVG for a page: colours are CSS variables, so they follow the light or dark theme of the reader.

Histograms and means use all transitions; densities and everything with points use samples of a fixed size.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_dce.data.examination import share_at_bounds
from sb3_dce.data.layout import row_blocks
from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import ConfigError
from sb3_dce.report.behaviour import Behaviour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

MAX_POINTS = 2_000
MAX_SAMPLE = 50_000
MAX_STEP_BINS = 200
MAX_HISTOGRAMS = 36
N_BINS = 40
N_COLUMNS = 6
N_DENSITY_BINS = 100

# Stand-ins that matplotlib accepts; each becomes a variable of the page.
_INK, _GRID, _MAIN, _ACCENT = "#010101", "#020202", "#030303", "#040404"
_VARIABLES = {_INK: "var(--ink)", _GRID: "var(--grid)", _MAIN: "var(--main)", _ACCENT: "var(--accent)"}
_STYLE: dict[Any, Any] = {
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "axes.titlecolor": _INK,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": _INK,
    "grid.color": _GRID,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "svg.fonttype": "none",
    "image.composite_image": False,
}


class Plot(NamedTuple):
    """
    A picture of the page.

    :param title: heading
    :param svg: the picture, an ``<svg>`` element
    :param caption: how to read it
    :param wide: whether it needs the whole width
    """

    title: str
    svg: str
    caption: str
    wide: bool = False


def draw_all(transitions: Transitions, behaviour: Behaviour | None, seed: int = 0) -> list[Plot]:
    """
    All plots for which there are data.

    :param transitions: the data
    :param behaviour: estimates of the behaviour policy
    :param seed: of the samples
    :return: plots in the order of the page
    :raises ConfigError: if matplotlib is not installed
    """
    with _style():
        sample = _sample(len(transitions), seed)
        plots = []
        if len(transitions.info.episode_returns):
            plots += [_returns(transitions), _lengths(transitions), _returns_over_file(transitions)]
        plots += [_reward_by_step(transitions), _saturation(transitions)]
        if behaviour is not None:
            plots.append(_randomness(behaviour))
        plots += [
            _action_histograms(transitions),
            _coverage("States", "observation", transitions.observations[sample], len(transitions)),
            _coverage("Actions", "action", transitions.actions[sample], len(transitions)),
        ]
    return plots


@contextmanager
def _style() -> Iterator[None]:
    try:
        import matplotlib
    except ImportError as error:
        raise ConfigError(
            "the plots of a report need matplotlib, which is not installed",
            key="matplotlib",
            hint='pip install "sb3_dce[plots]"',
        ) from error
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # whatever the user's own file says
        matplotlib.rcParams.update(_STYLE)
        yield


def _figure(width: float = 5.2, height: float = 3.1) -> Figure:
    from matplotlib.figure import Figure  # no pyplot: no window system is touched

    figure = Figure(figsize=(width, height))
    # Fixed margins, wide enough for any tick label: fitting them would double the time of a page.
    figure.subplots_adjust(left=0.7 / width, right=1 - 0.1 / width, bottom=0.5 / height, top=1 - 0.1 / height, hspace=0.15)
    return figure


def _svg(figure: Figure, label: str) -> str:
    """The picture without XML header, date and creator, with its colours as variables."""
    import matplotlib

    stream = io.StringIO()
    # Names inside of the picture are hashes of this salt: distinct among the pictures of a page, and always the same.
    with matplotlib.rc_context({"svg.hashsalt": label}):
        figure.savefig(stream, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for stand_in, variable in _VARIABLES.items():
        text = text.replace(stand_in, variable)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    # The names of groups (figure_1, axes_1) are the same in every picture, and nothing refers to them.
    text = re.sub(r' id="[\w.]+_\d+"', "", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)


def _sample(n: int, seed: int) -> np.ndarray:
    if n <= MAX_SAMPLE:
        return np.arange(n)
    return np.sort(np.random.default_rng(seed).choice(n, MAX_SAMPLE, replace=False))


def _sampled(n: int) -> str:
    return f" A sample of {MAX_SAMPLE:,} of {n:,} transitions." if n > MAX_SAMPLE else ""


def _histogram(title: str, values: np.ndarray, label: str, caption: str) -> Plot:
    figure = _figure()
    axes = figure.add_subplot()
    low, high = float(values.min()), float(values.max())
    if low == high:  # one bar in the middle
        low, high = low - 0.1 * abs(low) - 1.0, high + 0.1 * abs(high) + 1.0
    axes.hist(values, bins=N_BINS, range=(low, high), color=_MAIN)
    axes.axvline(float(values.mean()), color=_ACCENT, linewidth=1.5, label=f"mean {values.mean():.4g}")
    axes.set_xlabel(label)
    axes.set_ylabel("episodes")
    axes.yaxis.set_major_locator(_integer_ticks())
    axes.legend()
    return Plot(title, _svg(figure, title), caption)


def _returns(transitions: Transitions) -> Plot:
    returns = transitions.info.episode_returns
    caption = f"Undiscounted returns of {len(returns):,} whole episodes. Several humps mean several policies or early ends."
    return _histogram("Returns", returns, "return", caption)


def _lengths(transitions: Transitions) -> Plot:
    lengths = transitions.info.episode_lengths
    span = f"{lengths.min():,} to {lengths.max():,}" if lengths.min() < lengths.max() else f"always {lengths.max():,}"
    ends = "Short ones end at a terminal" if transitions.info.n_terminals else "None ends at a true terminal"
    caption = f"Steps of the same episodes, {span}. {ends}."
    return _histogram("Episode lengths", lengths, "steps", caption)


def _returns_over_file(transitions: Transitions) -> Plot:
    returns = transitions.info.episode_returns
    every = -(-len(returns) // MAX_POINTS)
    numbers = np.arange(0, len(returns), every)
    figure = _figure()
    axes = figure.add_subplot()
    axes.plot(numbers, returns[numbers], ".", markersize=4 if len(numbers) > 300 else 7, color=_MAIN, alpha=0.5)
    window = max(5, len(returns) // 20)
    if len(returns) >= 2 * window:
        sums = np.cumsum(np.concatenate([[0.0], returns]))
        means = (sums[window:] - sums[:-window]) / window
        centres = np.arange(len(means)) + (window - 1) / 2
        step = -(-len(means) // MAX_STEP_BINS)
        axes.plot(centres[::step], means[::step], color=_ACCENT, linewidth=2, label=f"mean of {window} episodes")
        axes.legend()
    axes.set_xlabel("whole episode, in the order of the file")
    axes.set_ylabel("return")
    caption = (
        "A rising line is the replay buffer of a learning agent; steps are files joined together; a flat band is one policy."
    )
    if every > 1:
        caption += f" One point in {every} is drawn."
    return Plot("Return over the file", _svg(figure, "Return over the file"), caption)


def _reward_by_step(transitions: Transitions) -> Plot:
    starts = np.concatenate([[0], np.flatnonzero(np.diff(transitions.episodes)) + 1])
    lengths = np.diff(starts, append=len(transitions))
    steps = np.arange(len(transitions)) - np.repeat(starts, lengths)
    width = -(-int(lengths.max()) // MAX_STEP_BINS)
    bins = steps // width
    counts = np.bincount(bins)
    mean = np.bincount(bins, weights=transitions.rewards) / counts
    variance = np.bincount(bins, weights=(transitions.rewards - mean[bins]) ** 2) / counts
    std, at = np.sqrt(variance), np.arange(len(counts)) * width
    figure = _figure()
    axes, alive = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
    axes.fill_between(at, mean - std, mean + std, color=_MAIN, alpha=0.2, linewidth=0)
    axes.plot(at, mean, color=_MAIN, linewidth=1.5)
    axes.set_ylabel("reward")
    alive.fill_between(at, 0, np.minimum(100.0 * counts / (width * len(starts)), 100.0), color=_ACCENT, alpha=0.5, linewidth=0)
    alive.set_ylim(0, 100)
    alive.set_ylabel("% alive")
    alive.set_xlabel("step in the episode")
    caption = "Mean and standard deviation; below, the share of episodes that last so long: on the right only survivors count."
    if width > 1:
        caption += f" Means over {width} steps."
    return Plot("Reward by step", _svg(figure, "Reward by step"), caption)


def _saturation(transitions: Transitions) -> Plot:
    shares = 100.0 * share_at_bounds(transitions)
    entries = np.arange(transitions.act_dim)
    figure = _figure()
    axes = figure.add_subplot()
    axes.bar(entries, shares[0], color=_MAIN, label="at the lower bound")
    axes.bar(entries, shares[1], bottom=shares[0], color=_ACCENT, label="at the upper bound")
    axes.set_ylim(0, max(1.0, 1.25 * float(shares.sum(axis=0).max())))
    _integer_axis(axes)
    axes.set_xlabel("action entry")
    axes.set_ylabel("% of transitions")
    axes.legend(ncols=2, loc="upper right")
    caption = f"{shares.sum(axis=0).mean():.2g} % of all entries lie within 0.1 % of half the range from a bound."
    return Plot("Actions at the bounds", _svg(figure, "Actions at the bounds"), caption)


def _action_histograms(transitions: Transitions) -> Plot:
    from matplotlib.collections import PolyCollection

    info = transitions.info
    shown = min(transitions.act_dim, MAX_HISTOGRAMS)
    low, high = info.action_space_low.astype(np.float64), info.action_space_high.astype(np.float64)
    counts = np.zeros((shown, N_BINS))
    for block in row_blocks(len(transitions)):
        bins = ((transitions.actions[block] - low) * (N_BINS / (high - low))).astype(np.int64).clip(0, N_BINS - 1)
        for entry in range(shown):
            counts[entry] += np.bincount(bins[:, entry], minlength=N_BINS)
    heights = counts / counts.max(axis=1, keepdims=True)
    # One set of axes with a cell of width 1 and height 1 per entry: sets of axes of their own take ten times as long.
    n_columns = min(shown, N_COLUMNS)
    n_rows = -(-shown // n_columns)
    figure = _figure(1.8 * n_columns, 1.5 * n_rows)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set_xlim(-0.1, 1.2 * n_columns - 0.1)
    axes.set_ylim(1.5 - 1.5 * n_rows - 0.25, 1.25)
    outlines = []
    for entry in range(shown):
        left, bottom = 1.2 * (entry % n_columns), -1.5 * (entry // n_columns)
        edges = left + np.repeat(np.arange(N_BINS + 1) / N_BINS, 2)
        tops = bottom + np.concatenate([[0.0], np.repeat(heights[entry], 2), [0.0]])
        outlines.append(np.column_stack([edges, tops]))
        axes.plot([left, left + 1], [bottom, bottom], color=_INK, linewidth=0.8)
        axes.text(left + 0.5, bottom + 1.05, f"entry {entry}", ha="center", fontsize=8)
        axes.text(left, bottom - 0.05, f"{low[entry]:.3g}", ha="left", va="top", fontsize=7)
        axes.text(left + 1, bottom - 0.05, f"{high[entry]:.3g}", ha="right", va="top", fontsize=7)
    axes.add_collection(PolyCollection(outlines, facecolor=_MAIN, edgecolor="none"))
    caption = "Distribution of each action entry between its bounds, the highest bar at full height."
    if shown < transitions.act_dim:
        caption += f" The first {shown} of {transitions.act_dim} entries."
    return Plot("Action histograms", _svg(figure, "Action histograms"), caption, wide=n_columns > 3)


def _coverage(title: str, noun: str, rows: np.ndarray, n: int) -> Plot:
    points, explained = _principal_components(rows)
    figure = _figure(5.2, 3.6)
    axes = figure.add_subplot()
    if points.shape[1] < 2:
        axes.hist(points[:, 0], bins=N_BINS, color=_MAIN)
        axes.set_xlabel(f"the only {noun} column that varies, standardised")
        axes.set_ylabel("transitions")
        caption = f"Only one {noun} column varies.{_sampled(n)}"
        return Plot(f"{title} covered", _svg(figure, f"{title} covered"), caption)
    limits = [np.percentile(points[:, i], [0.1, 99.9]) for i in (0, 1)]
    spans = [(low, high) if low < high else (low - 0.5, high + 0.5) for low, high in limits]
    density = np.histogram2d(points[:, 0], points[:, 1], bins=N_DENSITY_BINS, range=spans)[0]
    _show_density(axes, density, spans)
    axes.set_xlabel(f"first component ({explained[0]:.0%} of the variance)")
    axes.set_ylabel(f"second component ({explained[1]:.0%})")
    caption = (
        f"Density over the two main directions of the standardised {noun} columns (logarithmic, without the outermost 0.1 % "
        f"on each side). Separate islands are separate behaviours.{_sampled(n)}"
    )
    return Plot(f"{title} covered", _svg(figure, f"{title} covered"), caption)


def _principal_components(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The first two components of standardised columns (one if only one varies).

    :param rows: shape (n, width)
    :return: points of shape (n, 2) or (n, 1), and the shares of the variance they explain
    """
    std = rows.std(axis=0, dtype=np.float64)
    varying = std > 1e-12
    if varying.sum() < 2:
        column = rows[:, [int(np.argmax(std))]].astype(np.float64)
        return (column - column.mean()) / (column.std() or 1.0), np.ones(1)
    standardised = (rows[:, varying] - rows[:, varying].mean(axis=0, dtype=np.float64)) / std[varying]
    # The right singular vectors of a matrix are those of its small square.
    _, squares, directions = np.linalg.svd(standardised.T @ standardised)
    return standardised @ directions[:2].T, squares[:2] / squares.sum()


def _show_density(axes: Axes, density: np.ndarray, spans: list[tuple[float, float]]) -> None:
    """One hue whose opacity is the density: readable on light and dark pages alike."""
    from matplotlib.colors import LinearSegmentedColormap

    hue = LinearSegmentedColormap.from_list(
        "density", [(0.35, 0.55, 0.95, 0.25), (0.3, 0.4, 0.95, 0.8), (0.75, 0.25, 0.65, 0.9), (1.0, 0.6, 0.1, 1.0)]
    )
    values = np.log1p(density.T)
    axes.grid(visible=False)
    axes.imshow(
        np.ma.masked_equal(values, 0.0),
        cmap=hue,
        origin="lower",
        extent=(*spans[0], *spans[1]),
        aspect="auto",
        interpolation="nearest",
    )


def _randomness(behaviour: Behaviour) -> Plot:
    entries = np.arange(len(behaviour.std))
    figure = _figure()
    axes = figure.add_subplot()
    axes.bar(entries - 0.2, behaviour.marginal_std, 0.4, color=_MAIN, alpha=0.35, label="over all states")
    axes.bar(entries + 0.2, behaviour.std, 0.4, color=_MAIN, label="given the state")
    above = behaviour.nearest_std - behaviour.std
    axes.errorbar(entries + 0.2, behaviour.std, [np.zeros_like(above), above], fmt="none", ecolor=_ACCENT, linewidth=1.5)
    axes.set_ylim(0, 1.25 * float(max(behaviour.marginal_std.max(), behaviour.nearest_std.max(), 1e-3)))
    _integer_axis(axes)
    axes.set_xlabel("action entry")
    axes.set_ylabel("standard deviation")
    axes.legend(ncols=2, loc="upper right")
    entropy, uniform = behaviour.entropy, len(entries) * np.log(2.0)
    caption = (
        f"Actions scaled to [-1, 1]. With these deviations the entropy given the state is at most {entropy:.3g} nats (uniform "
        f"actions: {uniform:.3g}). From {behaviour.n_queries:,} transitions and their neighbours among "
        f"{behaviour.n_references:,}; the thin line reaches to the estimate without extrapolation."
    )
    return Plot("Randomness of the behaviour policy", _svg(figure, "Randomness of the behaviour policy"), caption)


def _integer_axis(axes: Axes) -> None:
    axes.xaxis.set_major_locator(_integer_ticks())
    axes.grid(axis="x", visible=False)


def _integer_ticks() -> MaxNLocator:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(integer=True)
