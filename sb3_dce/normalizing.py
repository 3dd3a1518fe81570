"""``VecNormalize`` between environment and agent: with other statistics than in training a model is not what was trained."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dce.errors import ConfigError

# Running statistics of fewer observations say nothing of a task: a reset or an episode of an untrained policy.
FEWEST_OBSERVATIONS = 2000


def is_untouched(statistics: RunningMeanStd) -> bool:
    """
    Whether running statistics are as ``VecNormalize`` makes them, and so say nothing of a task.

    :param statistics: of a ``VecNormalize``
    :return: whether they have seen nothing and nobody has set them
    """
    return statistics.count < 1.0 and bool(np.all(statistics.mean == 0.0)) and bool(np.all(statistics.var == 1.0))


def vec_normalize_of(model: Any) -> VecNormalize | None:
    """
    What stands between the environment and a model.

    :param model: agent, or anything with ``predict``
    :return: its ``VecNormalize``, if it has one
    :raises ConfigError: if it was trained behind one whose statistics are not there
    """
    found: VecNormalize | None = getattr(model, "_vec_normalize_env", None)
    known = getattr(model, "vec_normalize_statistics", None)
    if known is not None and (found is None or not found.norm_obs or not _has(found, known)):
        raise ConfigError(
            "the model was trained behind a VecNormalize whose statistics are not here: it would see other observations",
            key="env",
            hint=f"Load it with {type(model).__name__}.load(<model>, env=VecNormalize.load(<statistics>, <environment>)). "
            "Statistics that stay in the model itself: normalize_obs=True.",
        )
    return found


def _has(normalizer: VecNormalize, known: tuple[np.ndarray, np.ndarray]) -> bool:
    rms = normalizer.obs_rms
    there = (rms.mean, rms.var) if isinstance(rms, RunningMeanStd) else None
    return there is not None and all(
        a.shape == b.shape and np.allclose(a, b, rtol=1e-6) for a, b in zip(there, known, strict=True)
    )
