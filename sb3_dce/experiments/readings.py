"""Numbers read off rows of runs: their ends, courses, lengths, whatever experiment they belong to."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pandas as pd

from sb3_dce.experiments.results import RUN_KEY

TAIL = 0.1  # share of a run, from its end, that stands for what it has become
N_LATE = 10  # last evaluations, whose mean stands beside the last score of a run


def runs_in(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Runs that rows belong to, whatever their steps and metrics.

    :param rows: any
    :return: one line per run, with the columns ``RUN_KEY``
    """
    return rows[RUN_KEY].drop_duplicates()


def at_end(rows: pd.DataFrame, metric: str) -> np.ndarray:
    """
    Value of a metric at the last step of each run; a run that has none there is left out.

    :param rows: of runs of one agent
    :param metric: name
    :return: values in the order of the seeds
    """
    rows = rows[(rows["metric"] == metric) & (rows["step"] == rows["n_updates"])]
    return rows.sort_values("seed")["value"].to_numpy(dtype=float)


def curve_of(rows: pd.DataFrame, metric: str) -> pd.DataFrame:
    """
    Values of a metric as a table of steps by seeds, without step 0, where facts about the data stand.

    :param rows: of runs of one agent and length
    :param metric: name
    :return: one column per seed, indexed by gradient steps
    """
    rows = rows[(rows["metric"] == metric) & (rows["step"] > 0)]
    return rows.pivot(index="step", columns="seed", values="value").sort_index()


def last_tenth(curve: pd.DataFrame, n_updates: int) -> pd.DataFrame:
    """
    The part of a curve that stands for what a run has become.

    :param curve: one column per seed, indexed by gradient steps
    :param n_updates: length of the runs
    :return: its points in the last tenth; none if the runs ended before
    """
    return curve[curve.index > (1.0 - TAIL) * n_updates]


def mean_over_seeds(curve: pd.DataFrame) -> float | None:
    """
    Mean of a curve or of a part of one; each seed counts the same, however often it was evaluated.

    :param curve: one column per seed, indexed by gradient steps
    :return: in the metric's units; ``None`` without values
    """
    return float(curve.mean().mean()) if curve.notna().any(axis=None) else None


def of_seeds_that_ended(curve: pd.DataFrame, n_updates: int) -> pd.DataFrame:
    """
    The part of a curve that is of the same seeds at every step; those that diverged would move a mean where they leave it.

    :param curve: one column per seed, indexed by gradient steps
    :param n_updates: length of the runs
    :return: columns of the seeds with a value at the end; empty without any
    """
    return curve.loc[:, curve.reindex([n_updates]).notna().iloc[0]].dropna(how="all")


def last_of_each(curve: pd.DataFrame, n: int) -> pd.DataFrame:
    """
    The last values of each seed; seeds that were evaluated at other steps do not cut one another's short.

    :param curve: one column per seed, indexed by gradient steps
    :param n: number of values
    :return: columns of the seeds that have as many, indexed by their number; empty without any
    """
    tails = {seed: values.dropna().tail(n).to_numpy() for seed, values in curve.items()}
    return pd.DataFrame({seed: values for seed, values in tails.items() if len(values) == n})


def mean_line(curve: pd.DataFrame) -> pd.Series:
    """
    Mean curve over seeds, at the steps at which all have a value that have one there or later.

    :param curve: one column per seed, indexed by gradient steps
    :return: mean by step; it goes on when a seed has diverged
    """
    here = curve.notna()
    here_or_later = here[::-1].cummax()[::-1]
    complete = here.any(axis=1) & (here == here_or_later).all(axis=1)
    return curve[complete].mean(axis=1)


def ended_scores(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Course of the score of the seeds that did not diverge.

    :param rows: of runs of one agent and length
    :return: one column per seed, indexed by gradient steps; empty without any
    """
    return of_seeds_that_ended(curve_of(rows, "score"), int(rows["n_updates"].max() if len(rows) else 0))


def late_mean(rows: pd.DataFrame) -> float | None:
    """
    Mean of the last ten evaluations, beside which the last one is seen to be a jump or not.

    :param rows: of runs of one agent and length
    :return: normalised score, over the seeds that have not diverged; ``None`` without runs, or if ten evaluations are all that
        one of them has
    """
    curve = ended_scores(rows)
    return mean_over_seeds(last_of_each(curve, N_LATE)) if len(curve) and (curve.count() > N_LATE).all() else None


def n_diverged_in(rows: pd.DataFrame) -> int:
    """
    Number of runs among rows that diverged.

    :param rows: of one agent and data
    :return: runs; 0 without any
    """
    return int((rows["metric"] == "diverged").sum())


def devices_in(rows: pd.DataFrame) -> str:
    """
    What runs were trained on, and in which precision.

    :param rows: any
    :return: such as "cpu and cpu bf16-matmul"
    """
    return " and ".join(sorted(rows["device"].unique()))


def _n_agents_by_length(runs: pd.DataFrame) -> pd.Series:
    return runs.drop_duplicates(["dataset", "agent", "config_hash", "n_updates"])["n_updates"].value_counts()


def usual_length(runs: pd.DataFrame) -> int:
    """
    The length that most agents have, the longest of several.

    :param runs: one line per run, at least one
    :return: gradient steps
    """
    counts = _n_agents_by_length(runs)
    return int(max(counts.index, key=lambda n: (counts[n], n)))


def longest_of_most(runs: pd.DataFrame) -> int | None:
    """
    The longest length that more than half of the agents have.

    :param runs: one line per run
    :return: gradient steps; ``None`` if there is no such length
    """
    counts, n_agents = _n_agents_by_length(runs), len(runs.drop_duplicates(["agent", "config_hash"]))
    return max((int(n) for n in counts.index[2 * counts > n_agents]), default=None)


def scores_and_length(rows: pd.DataFrame) -> tuple[np.ndarray, int] | None:
    """
    Last scores of runs of one length.

    :param rows: of runs of one agent
    :return: one per seed, in their order, and the gradient steps of the runs; ``None`` without scores
    """
    scores = at_end(rows, "score")
    return (scores, int(rows["n_updates"].iloc[0])) if len(scores) else None


def commonest(values: pd.Series) -> str:
    """
    The value that stands there most often, the first in alphabetical order of several.

    :param values: at least one
    :return: the value as a text
    """
    counts = values.value_counts()
    return str(min(counts.index, key=lambda value: (-counts[value], value)))


def span(numbers: Iterable[int]) -> str:
    """
    Numbers of seeds, steps or episodes as they stand in a caption: "3", "1 to 5", "-" without any.

    :param numbers: in order
    :return: the only one, or the first and the last, thousands with commas
    """
    found = [f"{int(n):,}" for n in numbers]
    return found[0] if len(found) == 1 else f"{found[0]} to {found[-1]}" if found else "-"
