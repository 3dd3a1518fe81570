"""
Statistics of result tables, as functions of plain arrays.

Scores come as one array per task (dataset), each with one number per seed; tasks may have different numbers of seeds.
Interquartile mean, stratified bootstrap, probability of improvement and performance profile follow Agarwal et al. (2021),
"Deep Reinforcement Learning at the Edge of the Statistical Precipice".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sb3_dce import student

Scores = Sequence[np.ndarray]

N_RESAMPLES = 2000
BOOTSTRAP_SEED = 0


class Interval(NamedTuple):
    """Bounds of a 95 % confidence interval, in the units of the scores."""

    low: float
    high: float

    def overlaps(self, other: Interval) -> bool:
        """
        Whether two intervals have a point in common; ends that touch are one.

        :param other: another interval
        :return: the same whichever of the two is asked
        """
        return self.low <= other.high and other.low <= self.high


def sample_std(values: np.ndarray) -> float:
    """
    Standard deviation over seeds with divisor n - 1, the ± of the tables.

    :param values: one number per seed, shape (n,)
    :return: in the units of the values; NaN for one seed
    """
    return float(student.sample_std(values))


def mean_interval(scores: np.ndarray) -> Interval:
    """
    95 % interval of the mean over seeds by Student's t with n - 1 degrees of freedom.

    :param scores: of one task, one number per seed, at least two
    :return: bounds
    """
    low, high = student.mean_interval(scores)
    return Interval(float(low), float(high))


def trimmed_mean(values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """
    Mean of the middle half of the weight along the last axis. Scores at its edges count with the part of theirs inside.

    :param values: shape (..., n)
    :param weights: positive, shape (n,); ``None`` for equal ones
    :return: shape (...)
    """
    weights = np.ones(values.shape[-1]) if weights is None else weights
    order = np.argsort(values, axis=-1)
    sizes = (weights / weights.sum())[order]
    ends = np.cumsum(sizes, axis=-1)
    inside = np.clip(np.minimum(ends, 0.75) - np.maximum(ends - sizes, 0.25), 0.0, None)
    return (np.take_along_axis(values, order, axis=-1) * inside).sum(axis=-1) / inside.sum(axis=-1)


def iqm(scores: Scores) -> np.ndarray:
    """
    Interquartile mean over all runs, in which every task has the same weight, whatever its number of seeds.

    :param scores: one array per task, each of shape (..., seeds)
    :return: mean of the middle half, shape (...)
    """
    tasks = [np.asarray(task, dtype=float) for task in scores]
    weights = np.concatenate([np.full(task.shape[-1], 1.0 / task.shape[-1]) for task in tasks])
    return trimmed_mean(np.concatenate(tasks, axis=-1), weights)


def mean_of_tasks(scores: Scores) -> np.ndarray:
    """
    Mean over tasks of the mean over seeds: each task has the same weight, whatever its number of seeds.

    :param scores: one array per task, each of shape (..., seeds)
    :return: shape (...)
    """
    return np.mean([np.mean(task, axis=-1) for task in scores], axis=0)


def bootstrap_interval(
    scores: Scores,
    aggregate: Callable[[Scores], np.ndarray] = mean_of_tasks,
) -> Interval:
    """
    Stratified bootstrap: seeds are drawn anew with replacement within each task, the aggregate is computed again.

    :param scores: one array per task
    :param aggregate: number of interest, computed along the last axis
    :return: percentiles 2.5 and 97.5
    """
    generator = np.random.default_rng(BOOTSTRAP_SEED)
    tasks = [np.asarray(task, dtype=float) for task in scores]
    draws = [task[generator.integers(len(task), size=(N_RESAMPLES, len(task)))] for task in tasks]
    low, high = np.percentile(aggregate(draws), [2.5, 97.5])
    return Interval(float(low), float(high))


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """
    P(X > Y): per task the share of pairs in which X is larger, ties half, then the mean over tasks.

    :param scores: X, one array per task
    :param others: Y, for the same tasks in the same order
    :return: in [0, 1]
    """
    shares = []
    for x, y in zip(scores, others, strict=True):
        difference = np.asarray(x, dtype=float)[:, None] - np.asarray(y, dtype=float)[None, :]
        shares.append(np.mean((difference > 0) + 0.5 * (difference == 0)))
    return float(np.mean(shares))


def performance_profile(scores: Scores, thresholds: np.ndarray) -> np.ndarray:
    """
    Fraction of the runs above each threshold, equal to it not counted; mean over tasks (Agarwal et al. 2021).

    :param scores: one array per task
    :param thresholds: scores, shape (n,)
    :return: in [0, 1], shape (n,)
    """
    limits = np.asarray(thresholds, dtype=float)[None, :]
    shares = [(np.asarray(task, dtype=float)[:, None] > limits).mean(axis=0) for task in scores]
    return np.mean(shares, axis=0)


class Total(NamedTuple):
    """
    Sum over the rows of a table.

    :param mean: sum of the row means
    :param paper_std: plain sum of the row deviations, which the paper prints; no standard deviation of the total
    :param std: root of the sum of squares, the deviation of the total if the rows are independent
    """

    mean: float
    paper_std: float
    std: float


def total(means: Sequence[float], stds: Sequence[float]) -> Total:
    """
    Total of a table's rows with two deviations: the paper's plain sum, and that of a sum of independent rows.

    :param means: of the rows
    :param stds: sample standard deviations of the rows; NaN (one seed, or none printed) counts as 0
    :return: sums
    """
    known = np.nan_to_num(np.asarray(stds, dtype=float))
    return Total(float(np.sum(means)), float(known.sum()), float(np.sqrt(np.square(known).sum())))
