"""Student's t: how far the mean of few numbers may lie from the truth."""

from __future__ import annotations

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
