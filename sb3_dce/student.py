"""Student's t: how far the mean of few numbers may lie from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

# Points by which densities are integrated.
_POINTS = 20_001


@lru_cache(maxsize=1024)
def student_quantile(freedom: float, level: float = 0.95) -> float:
    """
    Quantile of Student's t for a two-sided interval, by integration of the density.

    :param freedom: degrees of freedom, from 1 up; Welch's need not be whole
    :param level: probability inside of a two-sided interval
    :return: how many standard errors the interval reaches to each side
    """
    # With sqrt(freedom) tan(angle) for t the density is a power of the cosine, on a bounded interval.
    angles = np.linspace(0.0, np.pi / 2.0, _POINTS)
    return float(np.sqrt(freedom) * np.tan(_inverse(angles, np.cos(angles) ** (freedom - 1.0), level)))


@lru_cache(maxsize=1024)
def std_factors(n: int, level: float = 0.95) -> tuple[float, float]:
    """
    Interval of a standard deviation (chi-square), as factors of the sample's.

    :param n: numbers of the sample, at least two
    :param level: probability inside
    :return: factors of the lower and the upper bound
    """
    freedom = n - 1
    roots = np.linspace(0.0, np.sqrt(freedom) + 10.0, _POINTS)  # of chi-square, whose own density may be infinite at 0
    density = roots ** (freedom - 1.0) * np.exp(-(roots**2) / 2.0)
    low, high = (_inverse(roots, density, share) for share in ((1.0 - level) / 2.0, (1.0 + level) / 2.0))
    return float(np.sqrt(freedom) / high), float(np.sqrt(freedom) / low)


def _inverse(points: np.ndarray, density: np.ndarray, share: float) -> float:
    """Where this share of the area below a density is reached."""
    area = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2.0)])
    return float(np.interp(share * area[-1], area, points))


def welch_freedom(errors: Sequence[float], freedoms: Sequence[float]) -> float:
    """
    Degrees of freedom of the standard error of a difference of two means (Welch 1947).

    :param errors: standard errors of the means, not all zero
    :param freedoms: degrees of freedom of each
    :return: of ``sqrt`` of the sum of the squared errors
    """
    squares = [error**2 for error in errors]
    return sum(squares) ** 2 / sum(square**2 / freedom for square, freedom in zip(squares, freedoms, strict=True))


def sample_std(values: np.ndarray) -> np.ndarray:
    """
    Standard deviation over seeds with divisor n - 1.

    :param values: one number per seed along the first axis
    :return: shape of ``values`` without the first axis; NaN for one seed
    """
    return np.std(values, axis=0, ddof=1) if len(values) > 1 else np.full(np.shape(values)[1:], np.nan)


def mean_interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    95 % interval of the mean by Student's t. A bootstrap of few seeds draws nothing but their range, and that holds the
    median, or the mean of a symmetric distribution, in ``1 - 2^(1 - n)`` of the cases only: three of four for three seeds.

    :param values: one number per seed along the first axis, at least two
    :return: bounds
    """
    mean, reach = np.mean(values, axis=0), student_quantile(len(values) - 1) * sample_std(values) / np.sqrt(len(values))
    return mean - reach, mean + reach
