"""Choosing rows of a dataset by the episodes they belong to."""

from __future__ import annotations

import numpy as np

from sb3_dce.data.transitions import Transitions
from sb3_dce.errors import DatasetSemanticsError


def rows_of_best_episodes(transitions: Transitions, fraction: float) -> np.ndarray:
    """
    Rows of the whole episodes with the largest returns, as in "10 % behavioural cloning".

    Episodes end at terminals and at time limits. An episode that is open at the end of the data, or that lost rows, has no
    known return and is left out. Of equal returns the earlier episode counts as better.

    :param transitions: dataset
    :param fraction: share of the whole episodes in (0, 1]; their number is rounded, and at least 1
    :return: row numbers in the order of the data, shape (n,)
    :raises DatasetSemanticsError: if the data have no whole episode
    """
    info = transitions.info
    # an episode of one row that ends by a time limit may have no usable row left
    usable = np.isin(info.episode_numbers, transitions.episodes)
    numbers, returns = info.episode_numbers[usable], info.episode_returns[usable]
    if len(numbers) == 0:
        raise DatasetSemanticsError(
            f"fraction={fraction:g} chooses whole episodes, and the data have none (episode ends: {info.episode_rule})",
            where=str(info.path or info.id),
            key="fraction",
            hint="Use fraction=1.0, or data with terminals or timeouts at the ends of their episodes.",
        )
    n_best = max(1, round(fraction * len(numbers)))
    best = numbers[np.argsort(-returns, kind="stable")[:n_best]]
    return np.flatnonzero(np.isin(transitions.episodes, best))
