"""Student's t: how far the mean of few numbers may lie from the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# 97.5 % quantiles by degrees of freedom, 1 to 10.
_QUANTILES = np.array([12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228])


def student_quantile(freedom: float) -> float:
    """
    :param freedom: degrees of freedom, from 1 up; Welch's need not be whole
    :return: how many standard errors a two-sided 95 % interval reaches to each side, to three digits
    """
    if freedom > len(_QUANTILES):
        return 1.96 + 2.37 / freedom + 2.8 / freedom**2
    # nearly linear in the inverse
    known = 1.0 / np.arange(len(_QUANTILES), 0, -1)
    return float(np.interp(1.0 / freedom, known, _QUANTILES[::-1]))


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
    :param values: one number per seed along the first axis
    :return: standard deviation over them with divisor n - 1; NaN for one seed
    """
    return np.std(values, axis=0, ddof=1) if len(values) > 1 else np.full(np.shape(values)[1:], np.nan)


def mean_interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    95 % interval of the mean. Of so few seeds a bootstrap draws nothing but their range, which holds the mean in three of
    four cases only.

    :param values: one number per seed along the first axis, at least two
    :return: bounds
    """
    mean, reach = np.mean(values, axis=0), student_quantile(len(values) - 1) * sample_std(values) / np.sqrt(len(values))
    return mean - reach, mean + reach
