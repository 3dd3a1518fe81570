"""
Where in an episode does a policy leave the data? Distance of its actions from the data's, by step of the episode.

    python scripts/imitation_error.py walker2d-medium-sb3 runs/a/model.zip runs/b/model.zip

First steps of episodes are few among the rows (one in a thousand where episodes are long), but every evaluation begins with
them: a policy that is close to the data on average and far from them there falls at once. Prints a Markdown table: mean
absolute difference over all entries of the action, and the entry with the largest mean difference, on at most 4,000 rows per
line.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from sb3_dce.data import load_transitions
from sb3_dce.training import load_any

N_ROWS = 4000
STAGES = ((0, 1), (1, 20), (20, 100), (100, None))


def steps_in_episode(ends: np.ndarray) -> np.ndarray:
    """
    :param ends: bool per row, true at the last row of an episode
    :return: number of each row within its episode, from 0
    """
    starts = np.concatenate([[0], np.flatnonzero(ends[:-1]) + 1])  # the last row begins none
    first = np.zeros(len(ends), dtype=int)
    first[starts] = starts
    return np.arange(len(ends)) - np.maximum.accumulate(first)


def main(dataset: str, models: list[str]) -> None:
    """
    :param dataset: id or file
    :param models: zip files of agents
    """
    data = load_transitions(dataset)
    step = steps_in_episode((np.asarray(data.terminals) > 0) | (np.asarray(data.timeouts) > 0))
    rng = np.random.default_rng(0)
    print("| agent | steps | rows | mean absolute difference | largest mean difference of an entry |")
    print("| --- | --- | --- | --- | --- |")
    for path in models:
        model = load_any(Path(path))
        for low, high in STAGES:
            rows = np.flatnonzero((step >= low) & (step < (np.inf if high is None else high)))
            if not len(rows):
                continue
            chosen = rng.choice(rows, min(N_ROWS, len(rows)), replace=False)
            actions, _ = model.predict(np.asarray(data.observations)[chosen], deterministic=True)
            difference = actions - np.asarray(data.actions)[chosen]
            bias = difference.mean(axis=0)
            name = f"{low} and later" if high is None else str(low) if high == low + 1 else f"{low} to {high - 1}"
            cells = (model.algo_name, name, f"{len(rows):,}", f"{np.abs(difference).mean():.3f}")
            print(f"| {' | '.join(cells)} | {bias[np.abs(bias).argmax()]:+.3f} |")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
